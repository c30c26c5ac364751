//! For tests: features of two stereo pairs whose correspondences are known.
//!
//! A rig with toe and roll sees points of a scene before and after a small motion. Each image shows
//! every point once, among features of nothing that only this image shows, in an order of its own.

use super::{Settings, StereoMatch};
use crate::features::{Features, Keypoint};
use crate::geometry::{StereoRig, parse_rig};
use nalgebra::{Isometry3, Point3, Vector3, Vector4};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

const WIDTH_PX: f32 = 1280.0;
const HEIGHT_PX: f32 = 960.0;
const DESCRIPTOR_LEN: usize = 64;

/// A keypoint, its descriptor, and the point that it shows, if any.
type Sight = (Keypoint, Vec<f32>, Option<u32>);

const TOED_AND_ROLLED: &str = r#"
    [left]
    width = 1280
    height = 960
    focal = [1772.0, 1768.0]
    principal_point = [626.0, 487.0]
    distortion = { model = "radtan", coefficients = [-0.25, 0.10, 0.0005, -0.0003, 0.0] }
    [right]
    width = 1280
    height = 960
    focal = [1766.0, 1762.0]
    principal_point = [600.0, 493.0]
    distortion = { model = "radtan", coefficients = [-0.24, 0.09, -0.0002, 0.0001, 0.0] }
    [right_from_left]
    translation_m = [-0.3857, -0.0072, 0.0001]
    rotation_vector_rad = [0.04, 0.016, 0.014]
"#;

pub(crate) fn rig() -> StereoRig {
    parse_rig(TOED_AND_ROLLED).expect("a valid rig")
}

/// One image's features, and which point each of them shows.
#[derive(Clone, Debug, Default)]
pub(crate) struct View {
    pub(crate) features: Features,
    pub(crate) points: Vec<Option<u32>>,
}

impl View {
    /// The feature that shows a point.
    pub(crate) fn of_point(&self, point: u32) -> u32 {
        let at = self.points.iter().position(|&p| p == Some(point));
        at.expect("each point is shown") as u32
    }
}

/// Two stereo pairs, and what is true of them.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) points: u32,
    /// Left and right.
    pub(crate) before: [View; 2],
    /// Left and right.
    pub(crate) now: [View; 2],
    /// Where each point should be seen now: (ul, vl, ur, vr), px.
    pub(crate) seen_now: Vec<Vector4<f64>>,
}

impl Scene {
    /// `points` that all images show, and `clutter` in each that no other shows.
    pub(crate) fn new(seed: u64, points: u32, clutter: u32) -> Self {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let rig = rig();
        let now_from_before = Isometry3::new(
            Vector3::new(0.01, -0.005, -0.05),
            Vector3::new(0.002, 0.004, 0.001),
        );
        let mut images: [Vec<Sight>; 4] = Default::default();
        let mut seen_now = Vec::new();
        for point in 0..points {
            let z = 3.0 * 15_f64.powf(random.random());
            let [x, y] = [0.2, 0.15].map(|half: f64| random.random_range(-half..half));
            let at = Point3::new(x * z, y * z, z);
            let before = rig.project(&at).expect("in front");
            let now = rig.project(&(now_from_before * at)).expect("in front");
            let look = Look::random(&mut random);
            let seen = [before.xy(), right(&before), now.xy(), right(&now)];
            for (image, seen) in images.iter_mut().zip(seen) {
                let (keypoint, descriptor) =
                    look.seen_at([seen.x as f32, seen.y as f32], &mut random);
                image.push((keypoint, descriptor, Some(point)));
            }
            seen_now.push(now);
        }
        for image in &mut images {
            for _ in 0..clutter {
                let at = [WIDTH_PX, HEIGHT_PX].map(|size| random.random_range(0.0..size));
                let (keypoint, descriptor) = Look::random(&mut random).seen_at(at, &mut random);
                image.push((keypoint, descriptor, None));
            }
        }
        let [left_before, right_before, left, right] =
            images.map(|image| shuffled(image, &mut random));
        Self {
            points,
            before: [left_before, right_before],
            now: [left, right],
            seen_now,
        }
    }

    /// The true matches of the earlier pair, by point.
    pub(crate) fn matches_before(&self) -> Vec<StereoMatch> {
        self.true_matches(&self.before)
    }

    /// The true matches of the later pair, by point.
    pub(crate) fn matches_now(&self) -> Vec<StereoMatch> {
        self.true_matches(&self.now)
    }

    fn true_matches(&self, [left, right]: &[View; 2]) -> Vec<StereoMatch> {
        (0..self.points)
            .map(|point| StereoMatch {
                left: left.of_point(point),
                right: right.of_point(point),
            })
            .collect()
    }
}

/// Left and right features anywhere, many of them looking much alike.
pub(crate) fn lookalikes(seed: u64, count: u32) -> [Features; 2] {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let looks: Vec<Look> = (0..8).map(|_| Look::random(&mut random)).collect();
    [(); 2].map(|()| {
        let image = (0..count)
            .map(|_| {
                let at = [
                    random.random_range(0.0..WIDTH_PX),
                    random.random_range(300.0..400.0),
                ];
                let mut look = looks[random.random_range(0..looks.len())].clone();
                look.size_px = random.random_range(8.0..30.0);
                look.sigma_px = random.random_range(0.1..3.0);
                let (keypoint, descriptor) = look.seen_at(at, &mut random);
                (keypoint, descriptor, None)
            })
            .collect();
        shuffled(image, &mut random).features
    })
}

/// All settings a test of matching should hold for.
pub(crate) fn each_matcher() -> Vec<Settings> {
    vec![
        Settings::default(),
        #[cfg(feature = "opencv")]
        Settings {
            matcher: super::MatcherName::Flann,
            ..Settings::default()
        },
    ]
}

/// What makes a point known again.
#[derive(Clone, Debug)]
struct Look {
    descriptor: Vec<f32>,
    size_px: f32,
    sigma_px: f32,
    laplacian: i8,
}

impl Look {
    fn random(random: &mut Xoshiro256PlusPlus) -> Self {
        Self {
            descriptor: unit((0..DESCRIPTOR_LEN).map(|_| random.random_range(-1.0..1.0))),
            size_px: random.random_range(8.0..40.0),
            sigma_px: 0.4,
            laplacian: if random.random() { 1 } else { -1 },
        }
    }

    /// The same with noise: two of them are some 0.3 from each other, random ones 1.4.
    fn seen_at(&self, at: [f32; 2], random: &mut Xoshiro256PlusPlus) -> (Keypoint, Vec<f32>) {
        let [x_px, y_px] = at.map(|v| v + self.sigma_px * random.random_range(-1.0..1.0));
        let keypoint = Keypoint {
            x_px,
            y_px,
            size_px: self.size_px * random.random_range(0.9..1.1),
            laplacian: self.laplacian,
            sigma_px: self.sigma_px,
            ..Keypoint::default()
        };
        let noisy = self
            .descriptor
            .iter()
            .map(|v| v + random.random_range(-0.05..0.05));
        (keypoint, unit(noisy))
    }
}

fn unit(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let values: Vec<f32> = values.collect();
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    values.into_iter().map(|v| v / norm).collect()
}

fn right(px: &Vector4<f64>) -> nalgebra::Vector2<f64> {
    px.fixed_rows::<2>(2).into_owned()
}

fn shuffled(
    mut image: Vec<(Keypoint, Vec<f32>, Option<u32>)>,
    random: &mut Xoshiro256PlusPlus,
) -> View {
    image.sort_by_cached_key(|_| random.random::<u64>());
    let mut view = View::default();
    view.features.descriptor_len = DESCRIPTOR_LEN;
    for (keypoint, descriptor, point) in image {
        view.features.keypoints.push(keypoint);
        view.features.descriptors.extend(descriptor);
        view.points.push(point);
    }
    view
}
