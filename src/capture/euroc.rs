//! The EuRoC (ASL) layout: `mav0/cam0`, `mav0/cam1`, each with `sensor.yaml` and stamped images.

use super::dataset::{DatasetError, ImageFiles, Layout, PairFiles, Parts, Settings};
use super::own::images_in;
use super::text;
use super::yaml::{Node, YamlFile};
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::{
    Isometry3, Matrix3, Matrix4, Rotation3, RowVector4, Translation3, UnitQuaternion, Vector2,
};
use std::path::{Component, Path, PathBuf};

/// Farthest that a matrix stated as a rotation may be from one: files with four digits pass.
const MAX_ROTATION_FAULT: f64 = 1e-3;

pub(super) fn open(
    mav0: &Path,
    rig_override: Option<StereoRig>,
    settings: &Settings,
) -> Result<Parts, DatasetError> {
    let [left, right] = [mav0.join("cam0"), mav0.join("cam1")];
    if !right.is_dir() {
        return Err(DatasetError::file(
            &right,
            "is missing, while cam0 is there",
        ));
    }
    let rig = match rig_override {
        Some(rig) => rig,
        None => rig(&left, &right)?,
    };
    let pairs = paired_by_stamp(
        &Frames::read(&left)?,
        &Frames::read(&right)?,
        settings.pairing_tolerance_ns(),
    );
    let ground_truth = [
        mav0.join("state_groundtruth_estimate0").join("data.csv"),
        mav0.join("..").join("poses.txt"),
        mav0.join("poses.txt"),
    ];
    Ok(Parts {
        layout: Layout::Euroc,
        rig,
        pairs,
        nominal_times: false,
        ground_truth: ground_truth.into_iter().find(|file| file.is_file()),
    })
}

fn rig(left: &Path, right: &Path) -> Result<StereoRig, DatasetError> {
    let (left, body_from_left) = sensor(&left.join("sensor.yaml"))?;
    let right_file = right.join("sensor.yaml");
    let (right, body_from_right) = sensor(&right_file)?;
    let right_from_left = body_from_right.inverse() * body_from_left;
    if right_from_left.translation.vector.norm() < 1e-6 {
        return Err(DatasetError {
            key: Some("T_BS".to_owned()),
            ..DatasetError::file(
                &right_file,
                "the cameras must stand apart, but the baseline is zero",
            )
        });
    }
    Ok(StereoRig {
        left,
        right,
        right_from_left,
        base_from_camera: None,
        uncertainty: None,
    })
}

/// A camera and where it stands, body_from_camera (`T_BS`).
fn sensor(file: &Path) -> Result<(Camera, Isometry3<f64>), DatasetError> {
    let yaml = YamlFile::read(file)?;
    if let Some(node) = yaml.get("camera_model") {
        let model = yaml.word("camera_model")?;
        if model != "pinhole" {
            return Err(yaml.wrong(
                node,
                "camera_model",
                format!(
                    "only \"pinhole\" is read, but it is \"{}\"",
                    text::shown(model)
                ),
            ));
        }
    }
    let (node, resolution) = list::<2>(&yaml, "resolution")?;
    let mut size_px = [0_u32; 2];
    for (side, value) in size_px.iter_mut().zip(resolution) {
        let max = f64::from(super::decode::MAX_SIDE_PX);
        if !(1.0..=max).contains(&value) || value.fract() != 0.0 {
            return Err(yaml.wrong(
                node,
                "resolution",
                format!("sides must be whole numbers from 1 to {max} px, but hold {value}"),
            ));
        }
        *side = value as u32;
    }
    let (node, [fu, fv, cu, cv]) = list::<4>(&yaml, "intrinsics")?;
    if fu <= 0.0 || fv <= 0.0 {
        return Err(yaml.wrong(
            node,
            "intrinsics",
            format!("focal lengths must be above 0 px, but are {fu} and {fv}"),
        ));
    }
    let camera = Camera::new(
        size_px[0],
        size_px[1],
        Vector2::new(fu, fv),
        Vector2::new(cu, cv),
        distortion(&yaml)?,
    );
    Ok((camera, body_from_sensor(&yaml)?))
}

/// A list of exactly `N` numbers.
fn list<'a, const N: usize>(
    yaml: &'a YamlFile,
    key: &str,
) -> Result<(&'a Node, [f64; N]), DatasetError> {
    let node = yaml.need(key)?;
    let numbers = yaml.numbers(node, key)?;
    let count = numbers.len();
    let numbers = numbers
        .try_into()
        .map_err(|_| yaml.wrong(node, key, format!("has {N} numbers, but there are {count}")))?;
    Ok((node, numbers))
}

fn distortion(yaml: &YamlFile) -> Result<Distortion, DatasetError> {
    const MODEL: &str = "distortion_model";
    const COEFFICIENTS: &str = "distortion_coefficients";
    let model = yaml.word(MODEL)?;
    if model == "none" {
        return Ok(Distortion::None);
    }
    let node = yaml.need(COEFFICIENTS)?;
    let k = yaml.numbers(node, COEFFICIENTS)?;
    let wrong_count = |wants: &str| {
        yaml.wrong(
            node,
            COEFFICIENTS,
            format!(
                "\"{model}\" takes {wants} coefficients, but there are {}",
                k.len()
            ),
        )
    };
    match model {
        "radial-tangential" | "radtan" | "plumb_bob" => {
            if !matches!(k.len(), 4 | 5 | 8) {
                return Err(wrong_count("4, 5 or 8"));
            }
            let mut all = [0.0; 8];
            all[..k.len()].copy_from_slice(&k);
            Ok(Distortion::Radtan(all))
        }
        "equidistant" => match <[f64; 4]>::try_from(k.as_slice()) {
            Ok(k) => Ok(Distortion::Equidistant(k)),
            Err(_) => Err(wrong_count("4")),
        },
        other => Err(yaml.wrong(
            yaml.need(MODEL)?,
            MODEL,
            format!(
                "\"radial-tangential\", \"equidistant\" and \"none\" are read, but it is \"{}\"",
                text::shown(other)
            ),
        )),
    }
}

/// `T_BS`: a map with `data`, as the data set has it, or the sixteen numbers themselves.
fn body_from_sensor(yaml: &YamlFile) -> Result<Isometry3<f64>, DatasetError> {
    const KEY: &str = "T_BS";
    let outer = yaml.need(KEY)?;
    let node = outer.get("data").unwrap_or(outer);
    let numbers = yaml.numbers(node, KEY)?;
    if numbers.len() != 16 {
        return Err(yaml.wrong(
            node,
            KEY,
            format!(
                "a 4×4 matrix has 16 numbers, but there are {}",
                numbers.len()
            ),
        ));
    }
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let fault = (rotation.transpose() * rotation - Matrix3::identity()).amax();
    if matrix.row(3) != RowVector4::new(0.0, 0.0, 0.0, 1.0)
        || fault > MAX_ROTATION_FAULT
        || rotation.determinant() < 0.0
    {
        return Err(yaml.wrong(node, KEY, "is not a rigid motion, [R t; 0 0 0 1]"));
    }
    let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    // The nearest rotation takes out the rounding of the file's digits.
    let nearest = Rotation3::from_matrix_eps(&rotation, 1e-15, 100, Rotation3::identity());
    Ok(Isometry3::from_parts(
        Translation3::from(translation),
        UnitQuaternion::from_rotation_matrix(&nearest),
    ))
}

/// The stamped images of one camera, stamps strictly rising.
struct Frames(Vec<(i64, PathBuf)>);

impl Frames {
    fn read(camera: &Path) -> Result<Self, DatasetError> {
        let (data, csv) = (camera.join("data"), camera.join("data.csv"));
        if !data.is_dir() {
            return Err(DatasetError::file(&data, "the folder of images is missing"));
        }
        if csv.try_exists().unwrap_or(true) {
            Self::from_csv(&csv, &data)
        } else {
            Self::from_names(&data)
        }
    }

    /// Lines of `stamp in ns,file name`.
    fn from_csv(csv: &Path, data: &Path) -> Result<Self, DatasetError> {
        let text = text::read(csv)?;
        let mut frames: Vec<(i64, PathBuf)> = Vec::new();
        for (line, row) in text::lines(&text) {
            let wrong = |cause: String| DatasetError::line(csv, line, cause);
            let (stamp, name) = row.split_once(',').ok_or_else(|| {
                wrong("a stamp in ns, a comma and a file name were expected".to_owned())
            })?;
            let stamp_ns = stamp_ns(stamp.trim()).ok_or_else(|| {
                let shown = text::shown(stamp);
                wrong(format!(
                    "a stamp in ns was expected, but it reads \"{shown}\""
                ))
            })?;
            let name = name.split(',').next().unwrap_or_default().trim();
            if !is_plain_name(name) {
                let shown = text::shown(name);
                return Err(wrong(format!(
                    "the name of a file in data/ was expected, but it reads \"{shown}\""
                )));
            }
            if frames.last().is_some_and(|&(last, _)| stamp_ns <= last) {
                return Err(wrong(format!(
                    "the stamp {stamp_ns} does not lie after the one before"
                )));
            }
            frames.push((stamp_ns, data.join(name)));
        }
        if frames.is_empty() {
            return Err(DatasetError::file(csv, "lists no image"));
        }
        Ok(Self(frames))
    }

    /// Without a list the file names are the stamps.
    fn from_names(data: &Path) -> Result<Self, DatasetError> {
        let mut frames = Vec::new();
        for file in images_in(data)?.into_values() {
            let stamp = file.file_stem().and_then(|stem| stamp_ns(stem.to_str()?));
            let stamp = stamp.ok_or_else(|| {
                DatasetError::file(&file, "without data.csv the name must be the stamp in ns")
            })?;
            frames.push((stamp, file));
        }
        frames.sort();
        if frames.is_empty() {
            return Err(DatasetError::file(
                data,
                "holds no PNG, JPEG, PGM or PPM image",
            ));
        }
        match frames.windows(2).find(|two| two[0].0 == two[1].0) {
            Some(two) => Err(DatasetError::file(
                &two[1].1,
                format!("has the same stamp as {}", two[0].1.display()),
            )),
            None => Ok(Self(frames)),
        }
    }
}

/// A stamp within ±2^62 ns, so that differences of two fit as well.
fn stamp_ns(word: &str) -> Option<i64> {
    word.parse().ok().filter(|ns: &i64| ns.abs() < 1 << 62)
}

/// One name that stays in its folder: no separator, no `..`, no root.
fn is_plain_name(name: &str) -> bool {
    let mut parts = Path::new(name).components();
    let single = matches!(
        (parts.next(), parts.next()),
        (Some(Component::Normal(_)), None)
    );
    single && !name.contains(['/', '\\', '\0'])
}

/// Pairs the images whose stamps are nearest to each other, both ways, within the tolerance.
fn paired_by_stamp(left: &Frames, right: &Frames, tolerance_ns: i64) -> Vec<PairFiles> {
    let apart_ns = |l: usize, r: usize| match (left.0.get(l), right.0.get(r)) {
        (Some((left_ns, _)), Some((right_ns, _))) => (left_ns - right_ns).abs(),
        _ => i64::MAX,
    };
    let stamp_ns = |frames: &Frames, at: usize| frames.0.get(at).map_or(i64::MAX, |frame| frame.0);
    let (mut l, mut r) = (0, 0);
    let mut pairs = Vec::with_capacity(left.0.len());
    while l < left.0.len() || r < right.0.len() {
        let apart = apart_ns(l, r);
        if apart <= tolerance_ns && apart <= apart_ns(l + 1, r) && apart <= apart_ns(l, r + 1) {
            pairs.push(both(&left.0[l], &right.0[r]));
            l += 1;
            r += 1;
        } else if stamp_ns(left, l) < stamp_ns(right, r) {
            pairs.push(alone(&left.0[l], "right", tolerance_ns));
            l += 1;
        } else {
            pairs.push(alone(&right.0[r], "left", tolerance_ns));
            r += 1;
        }
    }
    pairs
}

fn both(left: &(i64, PathBuf), right: &(i64, PathBuf)) -> PairFiles {
    PairFiles {
        timestamp_ns: left.0,
        images: ImageFiles::Both {
            left: left.1.clone(),
            right: right.1.clone(),
        },
    }
}

fn alone((timestamp_ns, file): &(i64, PathBuf), other: &str, tolerance_ns: i64) -> PairFiles {
    PairFiles {
        timestamp_ns: *timestamp_ns,
        images: ImageFiles::Unpaired {
            why: format!(
                "{}: has no {other} image within {} ms",
                file.display(),
                tolerance_ns as f64 * 1e-6
            ),
        },
    }
}
