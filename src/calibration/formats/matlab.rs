//! Values of the camera calibration toolbox for MATLAB (Bouguet), as its result files and printouts have them:
//! `fc_left`, `cc_left`, `kc_left`, the same `_right`, `om` and `T`, lengths in mm.
//!
//! Where the toolbox' uncertainties are there as well (`…_error`, three standard deviations), the rig's are made of
//! the largest of each kind.

use super::numbers::{camera, coefficients, list, radtan, rig};
use crate::geometry::{Camera, Distortion, RigUncertainty, StereoRig, so3};
use nalgebra::{Isometry3, Translation3, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

/// The toolbox states three standard deviations.
const ERRORS_ARE_SIGMAS: f64 = 3.0;

pub(super) fn import(
    file: &Path,
    text: &str,
    size_px: Option<(u32, u32)>,
) -> Result<StereoRig, String> {
    let fail = |cause: String| format!("{}: {cause}", file.display());
    let values = assignments(text).map_err(fail)?;
    let need = |name: &str, count: usize| -> Result<&[f64], String> {
        match values.get(name) {
            None => Err(fail(format!("holds no {name}"))),
            Some(numbers) if numbers.len() != count => Err(fail(format!(
                "{name}: has {count} numbers, but there are {}",
                numbers.len()
            ))),
            Some(numbers) => Ok(numbers),
        }
    };
    let stated = || {
        let side = |name: &str| super::numbers::pixels(&values.get(name)?.first()?.to_string());
        Some((side("nx")?, side("ny")?))
    };
    let size_px = stated()
        .or(size_px)
        .ok_or_else(|| fail("does not state the images' size (nx, ny); --size does".to_owned()))?;
    let one = |side: &str| -> Result<Camera, String> {
        let (fc, cc) = (
            need(&format!("fc_{side}"), 2)?,
            need(&format!("cc_{side}"), 2)?,
        );
        if let Some(skew) = values
            .get(&format!("alpha_c_{side}"))
            .and_then(|a| a.first())
            .filter(|a| **a != 0.0)
        {
            return Err(fail(format!(
                "alpha_c_{side}: pixels must be rectangular, but have a skew of {skew}"
            )));
        }
        let lens = match values.get(&format!("kc_{side}")) {
            None => Distortion::None,
            Some(kc) => radtan(kc).map_err(|e| fail(format!("kc_{side}: {e}")))?,
        };
        camera(size_px, [fc[0], fc[1]], [cc[0], cc[1]], lens)
            .map_err(|e| fail(format!("fc_{side}: {e}")))
    };
    let (om, t) = (need("om", 3)?, need("T", 3)?);
    let right_from_left = Isometry3::from_parts(
        Translation3::new(t[0], t[1], t[2]),
        so3::exp(&Vector3::new(om[0], om[1], om[2])),
    );
    let mut stereo = rig(one("left")?, one("right")?, right_from_left);
    stereo.uncertainty = sigmas(&values);
    Ok(stereo)
}

/// The largest uncertainty of each kind; `None` unless all kinds are stated.
fn sigmas(values: &BTreeMap<String, Vec<f64>>) -> Option<RigUncertainty> {
    let largest = |names: &[&str]| -> Option<f64> {
        let mut most: f64 = 0.0;
        for name in names {
            most = values
                .get(*name)?
                .iter()
                .fold(most, |most, v| most.max(v.abs()));
        }
        Some(most / ERRORS_ARE_SIGMAS)
    };
    Some(RigUncertainty::Sigmas {
        focal_px: largest(&["fc_left_error", "fc_right_error"])?,
        principal_point_px: largest(&["cc_left_error", "cc_right_error"])?,
        rotation_rad: largest(&["om_error"])?,
        translation_m: largest(&["T_error"])?,
    })
}

/// `name = number;` and `name = [ numbers ];`, whatever else there is.
fn assignments(text: &str) -> Result<BTreeMap<String, Vec<f64>>, String> {
    let mut values = BTreeMap::new();
    // Comments end with their line.
    let code: String = text
        .lines()
        .map(|line| line.split('%').next().unwrap_or("").to_owned() + "\n")
        .collect();
    let mut rest = code.as_str();
    while let Some(equals) = rest.find('=') {
        let (before, after) = (&rest[..equals], &rest[equals + 1..]);
        let name = before
            .rsplit(|c: char| !(c.is_alphanumeric() || c == '_'))
            .find(|w| !w.is_empty());
        let after = after.trim_start_matches([' ', '\t']);
        let (numbers, tail) = match after.strip_prefix('[') {
            Some(inside) => inside.split_once(']').ok_or("a [ has no ]")?,
            None => {
                let end = after.find([';', '\n']).unwrap_or(after.len());
                after.split_at(end)
            }
        };
        rest = tail;
        // Sums and the like (`x = [ a ] ± [ b ]`) and text are passed over; so is what is not asked for.
        let words = numbers
            .split([' ', '\t', ',', ';', '\n'])
            .filter(|w| !w.is_empty());
        let parsed: Result<Vec<f64>, _> = words.map(str::parse::<f64>).collect();
        if let (Some(name), Ok(numbers)) = (name, parsed)
            && !numbers.is_empty()
            && numbers.iter().all(|n| n.is_finite())
        {
            values.insert(name.to_owned(), numbers);
        }
    }
    Ok(values)
}

pub(super) fn export(stereo: &StereoRig) -> Result<String, String> {
    let mut out = format!(
        "nx = {};\nny = {};\n",
        stereo.left.width, stereo.left.height
    );
    for (side, camera) in [("left", &stereo.left), ("right", &stereo.right)] {
        let kc = match camera.distortion() {
            Distortion::Equidistant(_) => {
                return Err("the toolbox' kc cannot state a fisheye".to_owned());
            }
            lens => coefficients(lens, 5),
        };
        if kc.len() > 5 {
            return Err(
                "the toolbox' kc has five coefficients, but this lens takes eight".to_owned(),
            );
        }
        let semicolons = |numbers: &[f64]| list(numbers).replace(", ", " ; ");
        let (f, c) = (camera.focal_px, camera.principal_point_px);
        out += &format!(
            "fc_{side} = [ {} ];\ncc_{side} = [ {} ];\nalpha_c_{side} = 0;\nkc_{side} = [ {} ];\n",
            semicolons(&[f.x, f.y]),
            semicolons(&[c.x, c.y]),
            semicolons(&kc)
        );
    }
    let om = so3::log(&stereo.right_from_left.rotation);
    let t_mm = stereo.right_from_left.translation.vector / 1e-3;
    let semicolons = |v: &Vector3<f64>| list(v.as_slice()).replace(", ", " ; ");
    out += &format!(
        "om = [ {} ];\nT = [ {} ];\n",
        semicolons(&om),
        semicolons(&t_mm)
    );
    Ok(out)
}
