//! EuRoC's `sensor.yaml` in, where the camera sits in the body whose poses are the truth out.

use super::file_error::{FileError, read_text};
use super::trajectory::pose_of_matrix;
use nalgebra::Isometry3;
use std::path::Path;

/// Reads `T_BS` of a `sensor.yaml`: maps a point of the camera into the body frame, m.
///
/// # Errors
/// The file cannot be read or has no `T_BS` of 16 numbers that is a rigid motion.
pub fn read_body_from_camera(path: &Path) -> Result<Isometry3<f64>, FileError> {
    let text = read_text(path)?;
    let lines_to = |end: usize| text[..end].lines().count() + 1;
    let begin = text
        .find("T_BS:")
        .ok_or_else(|| FileError::new(path, None, "has no T_BS"))?;
    let fail = |cause: String| FileError::new(path, Some(lines_to(begin)), cause);
    let rest = &text[begin..];
    let list = rest
        .find("data:")
        .and_then(|data| rest[data..].split_once('['))
        .and_then(|(_, list)| list.split_once(']'))
        .map(|(list, _)| list)
        .ok_or_else(|| fail("T_BS has no data: [ … ]".into()))?;
    let numbers: Vec<f64> = list
        .split(',')
        .map(|number| number.trim().parse())
        .collect::<Result<_, _>>()
        .map_err(|_| fail("T_BS holds what is not a number".into()))?;
    let [upper @ .., _, _, _, _] = numbers.as_slice() else {
        return Err(fail("T_BS must have 16 numbers".into()));
    };
    let upper: &[f64; 12] = upper.try_into().map_err(|_| {
        fail(format!(
            "T_BS must have 16 numbers, but has {}",
            numbers.len()
        ))
    })?;
    pose_of_matrix(upper).map_err(|cause| fail(format!("T_BS: {cause}")))
}
