//! Estimates in, a trajectory in the TUM format out: `timestamp tx ty tz qx qy qz qw` a line.

use super::number::{push_f64, push_seconds};
use super::row::canonical_xyzw;
use nalgebra::Isometry3;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Writes a trajectory; [`finish`](Self::finish) says whether all of it arrived.
pub struct TumWriter<W: Write> {
    out: BufWriter<W>,
    line: String,
}

impl TumWriter<File> {
    /// Creates or empties a file.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn create(path: &Path) -> io::Result<Self> {
        Ok(Self::new(File::create(path)?))
    }
}

impl<W: Write> TumWriter<W> {
    /// Writes to `out`.
    pub fn new(out: W) -> Self {
        Self {
            out: BufWriter::new(out),
            line: String::with_capacity(256),
        }
    }

    /// Writes a pose, m: seconds with nine decimals, exactly those of `timestamp_ns`.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn write(
        &mut self,
        timestamp_ns: i64,
        odom_from_camera: &Isometry3<f64>,
    ) -> io::Result<()> {
        let t = &odom_from_camera.translation.vector;
        let [qx, qy, qz, qw] = canonical_xyzw(&odom_from_camera.rotation);
        self.line.clear();
        push_seconds(&mut self.line, timestamp_ns);
        for value in [t.x, t.y, t.z, qx, qy, qz, qw] {
            self.line.push(' ');
            push_f64(&mut self.line, value);
        }
        self.line.push('\n');
        self.out.write_all(self.line.as_bytes())
    }

    /// Ends the file.
    ///
    /// # Errors
    /// What was still buffered cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Quaternion, UnitQuaternion};

    #[test]
    fn a_line_holds_the_pose_with_exact_seconds() {
        let pose = Isometry3::from_parts(
            nalgebra::Translation3::new(1.5, -0.1, 1e-7),
            UnitQuaternion::new_unchecked(Quaternion::new(-0.8, 0.0, 0.6, 0.0)),
        );
        let mut bytes = Vec::new();
        let mut writer = TumWriter::new(&mut bytes);
        writer.write(1_403_636_579_763_555_584, &pose).unwrap();
        writer.finish().unwrap();
        assert_eq!(
            String::from_utf8(bytes).unwrap(),
            "1403636579.763555584 1.5 -0.1 1e-7 -0.0 -0.6 -0.0 0.8\n"
        );
    }
}
