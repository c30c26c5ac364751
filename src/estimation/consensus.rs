//! Consensus: tracks in, a motion that most of them share out, and which ones.
//!
//! RANSAC over samples of three points: closed form on the triangulated points, then a few steps on
//! the sample's reprojection, for depth noise makes the closed form coarse. Tracks are judged in
//! the image, in units of the σ that is predicted for each (theory: a gate in 3D would truncate the
//! error's distribution and spoil the covariance).

use super::bundle::TrackedPoint;
use super::sight::Viewpoint;
use super::{StereoMeasurement, closed_form};
use crate::geometry::definite;
use crate::geometry::product::{product, product_transposed, transposed_product};
use crate::geometry::{StereoRig, se3};
use nalgebra::{
    Isometry3, Matrix2, Matrix3, Matrix4, Matrix4x3, Matrix6, Point3, Vector3, Vector6,
};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// How a consensus is sought.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    /// Samples at most.
    pub max_samples: u32,
    /// Squared distance, in σ², up to which a track agrees with a motion (χ², four degrees of
    /// freedom), for a variance factor of 1.
    pub gate: f64,
    /// The variance factor that is expected.
    pub variance_factor: f64,
    /// Seed of the samples.
    pub seed: u64,
}

/// A motion and the tracks that agree with it.
#[derive(Clone, Debug)]
pub struct Consensus {
    /// Maps a point of the left camera now into the left camera before.
    pub prev_from_now: Isometry3<f64>,
    /// Indices of the tracks that agree, ascending.
    pub inliers: Vec<u32>,
}

/// The probability, at most, that no sample was free of outliers.
const MISS_PROBABILITY: f64 = 1e-4;
/// Samples drawn even where the first ones agree with everything.
const MIN_SAMPLES: u32 = 12;
/// A sample's motion has errors of its own: its gate is wider by this factor in σ².
const SAMPLE_SLACK: f64 = 4.0;
/// Gauss–Newton steps on a sample, and on all inliers of the best one.
const SAMPLE_STEPS: usize = 3;
const FINAL_ROUNDS: usize = 3;
/// A lasting error of the right camera below this share of the noise's variance changes nothing.
const NEGLIGIBLE: f64 = 1e-2;

/// A point that is known with some uncertainty, and where it is seen now.
#[derive(Clone, Copy, Debug)]
pub struct Sighting {
    /// (x, y, ρ) in the left camera before.
    pub inverse_depth: Vector3<f64>,
    /// Its covariance.
    pub cov: Matrix3<f64>,
    /// Where it is seen now.
    pub now: StereoMeasurement,
    /// Covariance, px², of an error that the right camera has made at both sights.
    pub displacement_px2: Matrix2<f64>,
    /// How much its agreement counts.
    pub weight: f64,
}

impl Sighting {
    /// The sighting of a track whose point is known from the earlier pair alone. `None` where that
    /// does not determine it.
    #[must_use]
    pub fn of(rig: &StereoRig, p: &TrackedPoint) -> Option<Self> {
        let before = Viewpoint::unmoved(rig);
        let by_point = before.linearise(rig, &p.inverse_depth)?.by_point;
        let info = Matrix4::from_diagonal(&p.prev.sigma_px.map(|s| 1.0 / (s * s)));
        Some(Self {
            inverse_depth: p.inverse_depth,
            cov: (by_point.transpose() * info * by_point)
                .cholesky()?
                .inverse(),
            now: p.now,
            displacement_px2: Matrix2::zeros(),
            weight: 1.0,
        })
    }

    fn is_displaced(&self) -> bool {
        let noise_px2 = self.now.sigma_px[3] * self.now.sigma_px[3];
        self.displacement_px2.trace() > NEGLIGIBLE * noise_px2
    }
}

/// What is left of a change of the four pixels once the point has followed it, for a point that moves them by
/// `by_point`: I − A (Aᵀ S⁻¹ A)⁻¹ Aᵀ S⁻¹.
fn unexplained(by_point: &Matrix4x3<f64>, now: &StereoMeasurement) -> Option<Matrix4<f64>> {
    let info = Matrix4::from_diagonal(&now.sigma_px.map(|s| 1.0 / (s * s)));
    let weighted = product(&info, by_point);
    let normal: Matrix3<f64> = transposed_product(&weighted, by_point);
    let follow = product_transposed(&definite::inverse(&normal)?, &weighted);
    Some(Matrix4::identity() - product(by_point, &follow))
}

/// Working memory of a search, and the tracks that agree with what it found last.
#[derive(Clone, Debug, Default)]
pub struct Room {
    candidates: Vec<Candidate>,
    samplable: Vec<usize>,
    inliers: Vec<u32>,
}

impl Room {
    /// Indices of the tracks that agree with the motion found last, ascending.
    #[must_use]
    pub fn inliers(&self) -> &[u32] {
        &self.inliers
    }
}

/// Finds the consensus of `points`. `guess`, where there is one, is tried before any sample.
///
/// `None` if fewer than three tracks agree on anything.
#[must_use]
pub fn find(
    rig: &StereoRig,
    points: &[Sighting],
    guess: Option<&Isometry3<f64>>,
    search: &Search,
) -> Option<Consensus> {
    let mut room = Room::default();
    let prev_from_now = find_in(&mut room, rig, points, guess, search)?;
    Some(Consensus {
        prev_from_now,
        inliers: room.inliers,
    })
}

/// The motion that [`find`] finds, in working memory that is used again; who agrees is left there.
#[must_use]
pub fn find_in(
    room: &mut Room,
    rig: &StereoRig,
    points: &[Sighting],
    guess: Option<&Isometry3<f64>>,
    search: &Search,
) -> Option<Isometry3<f64>> {
    let Room {
        candidates,
        samplable,
        inliers,
    } = room;
    inliers.clear();
    candidates.clear();
    let there = guess.map_or_else(Isometry3::identity, Isometry3::inverse);
    let there = Viewpoint::new(rig, &there);
    candidates.extend(points.iter().map(|p| Candidate::new(rig, p, &there)));
    samplable.clear();
    samplable.extend((0..candidates.len()).filter(|&i| candidates[i].has_depth()));
    let gate = search.gate * search.variance_factor;
    let motion = best_motion(rig, candidates, samplable, guess, gate, search)?;
    let now = Viewpoint::new(rig, &motion.inverse());
    inliers.extend(
        (0..candidates.len() as u32)
            .filter(|&i| candidates[i as usize].squared_sigmas(rig, &now) <= gate),
    );
    (inliers.len() >= 3).then_some(motion)
}

/// The best of the guess and of as many samples as it takes, refined on all that agree with it.
fn best_motion(
    rig: &StereoRig,
    candidates: &[Candidate],
    samplable: &[usize],
    guess: Option<&Isometry3<f64>>,
    gate: f64,
    search: &Search,
) -> Option<Isometry3<f64>> {
    let mut best = Best::default();
    if let Some(guess) = guess {
        let refined = refine_on_agreeing(rig, candidates, guess, gate * SAMPLE_SLACK);
        best.offer(
            rig,
            candidates,
            &refined.unwrap_or(*guess),
            gate * SAMPLE_SLACK,
        );
    }
    if samplable.len() >= 3 {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(search.seed);
        let mut drawn = 0;
        while drawn
            < search
                .max_samples
                .min(best.samples_needed(candidates.len()))
        {
            drawn += 1;
            let sample = draw_three(&mut rng, samplable);
            if let Some(motion) = motion_of_sample(rig, candidates, &sample) {
                best.offer(rig, candidates, &motion, gate * SAMPLE_SLACK);
            }
        }
    }
    let mut motion = best.motion?;
    for round in 0..FINAL_ROUNDS {
        let slack = if round + 1 < FINAL_ROUNDS {
            SAMPLE_SLACK
        } else {
            1.0
        };
        if let Some(refined) = refine_on_agreeing(rig, candidates, &motion, gate * slack) {
            motion = refined;
        }
    }
    Some(motion)
}

/// A track prepared for being judged many times.
#[derive(Clone, Debug)]
struct Candidate {
    now: StereoMeasurement,
    /// (x, y, ρ) of the earlier measurement alone.
    inverse_depth: Vector3<f64>,
    /// Inverse of the covariance predicted for the residual of the present measurement.
    info: Matrix4<f64>,
    weight: f64,
}

impl Candidate {
    fn new(rig: &StereoRig, p: &Sighting, there: &Viewpoint) -> Self {
        let info = Self::predicted_info(rig, p, there).unwrap_or_else(|| {
            let var = p.now.sigma_px.component_mul(&p.now.sigma_px) * 4.0;
            Matrix4::from_diagonal(&var.map(|v| 1.0 / v))
        });
        Self {
            now: p.now,
            inverse_depth: p.inverse_depth,
            info,
            weight: p.weight,
        }
    }

    /// Whether its point is near enough to have a depth.
    fn has_depth(&self) -> bool {
        self.inverse_depth.z >= 1e-4
    }

    /// Both triangulated points. `None` where the present one lies behind, or nowhere.
    fn euclidean(&self, rig: &StereoRig) -> Option<(Point3<f64>, Point3<f64>)> {
        let now = super::triangulate(rig, &self.now)?;
        let y = self.inverse_depth;
        now.point.z.is_finite().then(|| {
            let before = Vector3::new(y.x, y.y, 1.0) / y.z;
            (Point3::from(before), now.point)
        })
    }

    /// Residual now = its own noise, what the uncertainty of the point carries over, and the lasting error of
    /// the right camera, as far as the point has not taken it up.
    fn predicted_info(rig: &StereoRig, p: &Sighting, there: &Viewpoint) -> Option<Matrix4<f64>> {
        let by_point = there.linearise(rig, &p.inverse_depth)?.by_point;
        let carried = product_transposed(&product(&by_point, &p.cov), &by_point);
        let mut cov = p.now.cov_px2() + carried;
        if p.is_displaced() {
            let left_over = unexplained(&by_point, &p.now)?;
            let by_right = left_over.fixed_columns::<2>(2).into_owned();
            cov += product_transposed(&product(&by_right, &p.displacement_px2), &by_right);
        }
        definite::inverse(&cov)
    }

    /// Squared Mahalanobis distance of the present measurement from what a motion predicts.
    fn squared_sigmas(&self, rig: &StereoRig, now: &Viewpoint) -> f64 {
        let Some(seen) = now.seen_at(rig, &self.inverse_depth) else {
            return f64::INFINITY;
        };
        let e = self.now.px - seen;
        e.dot(&product(&self.info, &e))
    }
}

fn draw_three(rng: &mut Xoshiro256PlusPlus, among: &[usize]) -> [usize; 3] {
    let n = among.len();
    let a = rng.random_range(0..n);
    let b = (a + rng.random_range(1..n)) % n;
    loop {
        let c = rng.random_range(0..n);
        if c != a && c != b {
            return [among[a], among[b], among[c]];
        }
    }
}

fn motion_of_sample(
    rig: &StereoRig,
    candidates: &[Candidate],
    sample: &[usize; 3],
) -> Option<Isometry3<f64>> {
    let [a, b, c] = sample.map(|i| candidates[i].euclidean(rig));
    let points = [a?, b?, c?];
    let coarse = closed_form::align(points.iter().copied())?;
    let mut motion = coarse;
    for _ in 0..SAMPLE_STEPS {
        match step(rig, sample.iter().map(|&i| &candidates[i]), &motion) {
            Some(xi) => motion *= se3::exp(&xi),
            None => return Some(coarse),
        }
    }
    Some(motion)
}

/// One Gauss–Newton step on the tracks that agree with `motion`.
fn refine_on_agreeing(
    rig: &StereoRig,
    candidates: &[Candidate],
    motion: &Isometry3<f64>,
    gate: f64,
) -> Option<Isometry3<f64>> {
    let now = Viewpoint::new(rig, &motion.inverse());
    let agreeing = candidates
        .iter()
        .filter(|c| c.squared_sigmas(rig, &now) <= gate);
    if agreeing.clone().count() < 3 {
        return None;
    }
    Some(motion * se3::exp(&step(rig, agreeing, motion)?))
}

/// The Gauss–Newton step of the motion on some tracks, each weighted by its predicted covariance.
fn step<'a>(
    rig: &StereoRig,
    candidates: impl Iterator<Item = &'a Candidate>,
    prev_from_now: &Isometry3<f64>,
) -> Option<Vector6<f64>> {
    let now = Viewpoint::new(rig, &prev_from_now.inverse());
    let mut hessian = Matrix6::zeros();
    let mut gradient = Vector6::zeros();
    for c in candidates {
        let Some(seen) = now.linearise(rig, &c.inverse_depth) else {
            continue;
        };
        let weighted = transposed_product(&seen.by_motion, &c.info);
        hessian += product(&weighted, &seen.by_motion);
        gradient += product(&weighted, &(c.now.px - seen.px));
    }
    let xi = hessian.cholesky()?.solve(&gradient);
    xi.iter().all(|v| v.is_finite()).then_some(xi)
}

/// The best motion so far, by the sum of squared distances cut off at the gate.
#[derive(Default)]
struct Best {
    motion: Option<Isometry3<f64>>,
    score: f64,
    agreeing: f64,
}

impl Best {
    fn offer(
        &mut self,
        rig: &StereoRig,
        candidates: &[Candidate],
        motion: &Isometry3<f64>,
        gate: f64,
    ) {
        let now = Viewpoint::new(rig, &motion.inverse());
        let mut score = 0.0;
        let mut agreeing = 0.0;
        let mut ahead: f64 = candidates.iter().map(|c| c.weight).sum();
        for c in candidates {
            ahead -= c.weight;
            let gain = gate - c.squared_sigmas(rig, &now);
            if gain > 0.0 {
                score += c.weight * gain / gate;
                agreeing += 1.0;
            }
            // Even full marks for the rest would not win.
            if score + ahead < self.score {
                return;
            }
        }
        if score > self.score {
            *self = Self {
                motion: Some(*motion),
                score,
                agreeing,
            };
        }
    }

    /// How many samples make it sure enough that one was free of outliers.
    fn samples_needed(&self, total: usize) -> u32 {
        let share = self.agreeing / total.max(1) as f64;
        let good = share.powi(3);
        if good >= 1.0 {
            return MIN_SAMPLES;
        }
        if good <= 0.0 {
            return u32::MAX;
        }
        let needed = (MISS_PROBABILITY.ln() / (1.0 - good).ln()).ceil();
        (needed as u32).max(MIN_SAMPLES)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::synthetic::{random, rig, step, tracks};
    use nalgebra::{Vector2, Vector4};
    use rand_distr::{Distribution, StandardNormal};

    const TRACKS: usize = 4000;
    /// 1 σ of the right camera's lasting error, px: large beside the noise of 0.5 px.
    const DISPLACEMENT_PX: Vector2<f64> = Vector2::new(0.3, 2.0);

    /// The sighting of a track, its points between 5 and 40 m, by a right camera that is off by `off_px` for good.
    fn displaced(mut track: TrackedPoint, off_px: &Vector2<f64>) -> Option<Sighting> {
        let off_px = Vector4::new(0.0, 0.0, off_px.x, off_px.y);
        track.prev.px += off_px;
        track.now.px += off_px;
        track.inverse_depth = crate::estimation::inverse_depth(&rig(), &track.prev)?;
        Some(Sighting {
            displacement_px2: Matrix2::from_diagonal(
                &DISPLACEMENT_PX.component_mul(&DISPLACEMENT_PX),
            ),
            ..Sighting::of(&rig(), &track)?
        })
    }

    fn mean_squared_sigmas(sightings: &[Sighting]) -> f64 {
        let rig = rig();
        let now = Viewpoint::new(&rig, &step().inverse());
        let of = |s: &Sighting| Candidate::new(&rig, s, &now).squared_sigmas(&rig, &now);
        sightings.iter().map(of).sum::<f64>() / sightings.len() as f64
    }

    #[test]
    fn a_right_camera_that_is_off_as_it_may_be_is_what_the_gate_expects() {
        let mut rng = random(71);
        let tracks = tracks(&rig(), &step(), TRACKS, [5.0, 40.0], 0.5, &mut rng);
        // Every track by a draw of its own.
        let sightings: Vec<Sighting> = tracks
            .into_iter()
            .filter_map(|track| {
                let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
                let drawn = Vector2::new(normal(), normal());
                displaced(track, &DISPLACEMENT_PX.component_mul(&drawn))
            })
            .collect();
        assert!(sightings.len() > TRACKS * 9 / 10);
        // χ² with four degrees of freedom, within 4 σ of its mean.
        let tolerance = 4.0 * (8.0 / sightings.len() as f64).sqrt();
        let mean = mean_squared_sigmas(&sightings);
        assert!((mean - 4.0).abs() < tolerance, "{mean} ± {tolerance}");
        let mut exact = sightings;
        for s in &mut exact {
            s.displacement_px2.fill(0.0);
        }
        assert!(mean_squared_sigmas(&exact) > 10.0);
    }

    #[test]
    fn all_agree_on_the_motion_though_the_right_camera_is_off_by_more_than_the_noise() {
        let rig = rig();
        // One displacement for all, of 2 σ across the baseline.
        let off_px = Vector2::new(0.0, 2.0 * DISPLACEMENT_PX.y);
        let mut rng = random(72);
        let sightings: Vec<Sighting> = tracks(&rig, &step(), 200, [5.0, 40.0], 0.5, &mut rng)
            .into_iter()
            .filter_map(|track| displaced(track, &off_px))
            .collect();
        let search = Search {
            max_samples: 500,
            gate: 13.3,
            variance_factor: 1.0,
            seed: 1,
        };
        let found = find(&rig, &sightings, None, &search).expect("found");
        assert!(found.inliers.len() > 180, "{}", found.inliers.len());
        let apart = se3::log(&(found.prev_from_now.inverse() * step()));
        assert!(apart.norm() < 0.02, "{apart}");
    }
}
