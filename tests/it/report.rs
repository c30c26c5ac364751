//! `visod report` as a user runs it.

use nalgebra::{Isometry3, Matrix6};
use std::path::Path;
use std::process::{Command, Output};
use visod::estimation::{Counts, Status};
use visod::output::csv::OdometryCsvWriter;
use visod::output::row::OdometryRow;

fn write_odometry(path: &Path, count: u64) {
    let mut writer = OdometryCsvWriter::create(path).unwrap();
    for sequence in 0..count {
        let row = OdometryRow {
            sequence,
            timestamp_ns: sequence as i64 * 100_000_000,
            status: match sequence {
                0 => Status::Initializing,
                _ => Status::Tracking,
            },
            odom_from_camera: Isometry3::translation(0.0, 0.0, sequence as f64),
            cov_pose: Matrix6::identity() * (1e-4 * sequence as f64),
            prev_from_now: Isometry3::translation(0.0, 0.0, 1.0),
            cov_motion: Matrix6::identity() * 1e-4,
            counts: Counts::default(),
            variance_factor: f64::NAN,
            latency_ms: None,
            epoch: 0,
            innovation_ratio: f64::NAN,
            budget_sigmas: [0.0; 24],
            is_first_order: true,
        };
        writer.write_row(&row).unwrap();
    }
    writer.finish().unwrap();
}

fn report(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_visod"))
        .current_dir(folder)
        .arg("report")
        .args(args)
        .output()
        .unwrap()
}

#[test]
fn a_page_is_written_with_and_without_truth() {
    let folder = tempfile::tempdir().unwrap();
    write_odometry(&folder.path().join("drive <1>.csv"), 40);
    let truth: String = (0..40)
        .map(|i| format!("1 0 0 0.01 0 1 0 0 0 0 1 {i}\n"))
        .collect();
    std::fs::write(folder.path().join("truth.txt"), truth).unwrap();
    for truth in [&[][..], &["--ground-truth", "truth.txt"]] {
        let args = [&["drive <1>.csv", "-o", "page.html"], truth].concat();
        let output = report(folder.path(), &args);
        assert!(
            output.status.success() && output.stdout.is_empty(),
            "{output:?}"
        );
        let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
        assert!(page.contains("<h1>Odometry drive &lt;1&gt;</h1>"));
        assert_eq!(page.contains("Error of the pose"), !truth.is_empty());
    }
}

#[test]
fn what_cannot_be_reported_on_gets_one_clear_sentence() {
    let folder = tempfile::tempdir().unwrap();
    write_odometry(&folder.path().join("empty.csv"), 0);
    write_odometry(&folder.path().join("good.csv"), 5);
    std::fs::write(folder.path().join("plain.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
    for (args, code, said) in [
        (
            &["empty.csv", "-o", "x.html"][..],
            1,
            "empty.csv: holds a header but no row",
        ),
        (
            &["plain.txt", "-o", "x.html"],
            1,
            "plain.txt: is a plain trajectory",
        ),
        (&["none.csv", "-o", "x.html"], 1, "none.csv: cannot be read"),
        (
            &["good.csv", "-o", "none/x.html"],
            1,
            "none/x.html: cannot be written",
        ),
        (
            &["good.csv", "-o", "x.html", "--ground-truth", "good.csv"],
            1,
            "good.csv:1: ",
        ),
        (
            &["good.csv", "-o", "x.html", "--max-difference", "nan"],
            2,
            "--max-difference",
        ),
    ] {
        let output = report(folder.path(), args);
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert!(
            error.lines().count() == 1 && error.contains(said),
            "{error}"
        );
        assert!(!folder.path().join("x.html").exists());
    }
}
