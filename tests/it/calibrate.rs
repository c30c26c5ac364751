//! `visod calibrate` and `visod rig` as a user runs them.

use super::recordings::test_recording as data;
use super::replay::{stderr_of, visod};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Output;
use visod::calibration::simulated::{placements, views};
use visod::calibration::{Board, Pattern, views_to_csv};
use visod::geometry::rig_parameters::EXTRINSICS;
use visod::geometry::{StereoRig, check_rig, load_rig, rig_to_toml};
use visod::simulation::{small_rig, thesis_rig};

const BOARD: Board = Board {
    pattern: Pattern::Chessboard,
    columns: 9,
    rows: 6,
    square_m: 0.04,
    sigma_square_m: 0.0,
};

fn run(folder: &Path, args: &[&str]) -> Output {
    visod().current_dir(folder).args(args).output().unwrap()
}

fn succeed(folder: &Path, args: &[&str]) -> String {
    let output = run(folder, args);
    assert!(output.status.success(), "{args:?}: {}", stderr_of(&output));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn points_from_a_file_give_rig_covariance_and_report() {
    let folder = tempfile::tempdir().unwrap();
    let rig = small_rig();
    let placed = placements(&rig, &BOARD, 14, 5);
    let seen = views(&rig, &BOARD, &placed, 0.1, 9);
    std::fs::write(folder.path().join("corners.csv"), views_to_csv(&seen)).unwrap();
    let args = "calibrate --corners corners.csv --size 320x240 --pattern 9x6 --square 0.04 --square-sigma 0.00004 --lens none -o rig.toml --report page.html --json";
    let args: Vec<&str> = args.split(' ').collect();
    let said: Value = serde_json::from_str(&succeed(folder.path(), &args)).unwrap();
    assert_eq!(said["views"].as_array().unwrap().len(), 14);
    let found = load_rig(&folder.path().join("rig.toml")).unwrap();
    let covariance = found.covariance().unwrap();
    let error =
        found.right_from_left.translation.vector.x - rig.right_from_left.translation.vector.x;
    assert!(
        error.abs() < 3.5 * covariance[(EXTRINSICS, EXTRINSICS)].sqrt(),
        "{error}"
    );
    let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
    assert!(page.contains("Calibration of a stereo rig"));
    // The same command gives the same bytes.
    let first = std::fs::read(folder.path().join("rig.cov.csv")).unwrap();
    succeed(folder.path(), &args);
    assert_eq!(
        std::fs::read(folder.path().join("rig.cov.csv")).unwrap(),
        first
    );
}

#[test]
fn mistakes_are_refused_in_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("corners.csv"),
        "view,side,point,x_px,y_px\na,left,99,1,2\n",
    )
    .unwrap();
    for (args, says) in [
        (
            "calibrate --corners corners.csv --size 320x240 --pattern 9x6 --square 0.04 -o rig.toml",
            "corners.csv:2: \"99\" is no point of a board",
        ),
        (
            "calibrate --corners none.csv --size 320x240 --pattern 9x6 --square 0.04 -o rig.toml",
            "none.csv: cannot be read",
        ),
        (
            "calibrate --corners corners.csv --size 320x240 --pattern 9x2 --square 0.04 -o rig.toml",
            "--pattern: must be from 3 to 100",
        ),
        (
            "calibrate --corners corners.csv --size 320x240 --pattern 9x6 --square -1 -o rig.toml",
            "--square",
        ),
        (
            "rig convert corners.csv -o rig.toml",
            "no format that is known",
        ),
    ] {
        let output = run(folder.path(), &args.split(' ').collect::<Vec<_>>());
        assert_eq!(
            output.status.code(),
            Some(2),
            "{args}: {}",
            stderr_of(&output)
        );
        assert!(
            stderr_of(&output).contains(says),
            "{says}: {}",
            stderr_of(&output)
        );
    }
}

#[cfg(not(feature = "opencv"))]
#[test]
fn without_opencv_images_are_a_clear_configuration_error() {
    let folder = tempfile::tempdir().unwrap();
    let args = "calibrate --left l --right r --pattern 9x6 --square 0.04 -o rig.toml";
    let output = run(folder.path(), &args.split(' ').collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(2));
    assert!(
        stderr_of(&output).contains("without the feature opencv"),
        "{}",
        stderr_of(&output)
    );
}

#[cfg(feature = "opencv")]
#[test]
fn the_published_chessboards_give_the_published_rig() {
    let Some(boards) = data("chessboard_640x480") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (left, right) = (boards.join("left"), boards.join("right"));
    let args = [
        "calibrate",
        "--left",
        left.to_str().unwrap(),
        "--right",
        right.to_str().unwrap(),
        "--pattern",
        "9x6",
        "--square",
        "1",
        "-o",
        "rig.toml",
        "--json",
    ];
    let said: Value = serde_json::from_str(&succeed(folder.path(), &args)).unwrap();
    assert_eq!(said["views"].as_array().unwrap().len(), 13, "{said}");
    // OpenCV's own joint result; hardly a point may be left out on the way to it.
    assert!(said["rms_px"].as_f64().unwrap() <= 0.215, "{said}");
    assert!(
        said["points_left_out"].as_array().unwrap().len() <= 3,
        "{said}"
    );
    let rig = load_rig(&folder.path().join("rig.toml")).unwrap();
    let sigma = rig.covariance().unwrap()[(EXTRINSICS, EXTRINSICS)].sqrt();
    let apart = rig.right_from_left.translation.vector.x + 3.33;
    assert!(apart.abs() < 2.0 * sigma && sigma < 0.02, "{apart} {sigma}");
}

#[cfg(feature = "opencv")]
mod rendered {
    use super::*;
    use visod::calibration::detect::detect_pair;
    use visod::calibration::simulated::image;
    use visod::calibration::{Lens, calibrate};

    /// In images this small, about every second board is too far or too tilted to be found.
    const PLACED: usize = 28;

    #[test]
    fn rendered_boards_of_either_kind_give_the_rig_that_they_were_rendered_with() {
        let rig = small_rig();
        let circles = Board {
            pattern: Pattern::AsymmetricCircles,
            columns: 4,
            rows: 9,
            square_m: 0.04,
            sigma_square_m: 0.0,
        };
        for (board, sigmas) in [(BOARD, 4.0), (circles, 6.0)] {
            let placed = placements(&rig, &board, PLACED, 21);
            let seen: Vec<_> = placed
                .iter()
                .enumerate()
                .map(|(i, left_from_board)| {
                    let seed = i as u64;
                    let left = image(&rig.left, left_from_board, &board, 1.0, seed);
                    let right = image(
                        &rig.right,
                        &(rig.right_from_left * left_from_board),
                        &board,
                        1.0,
                        100 + seed,
                    );
                    detect_pair(&i.to_string(), [&left, &right], &board).unwrap()
                })
                .filter(|view| view.count(0) > 0 && view.count(1) > 0)
                .collect();
            assert!(
                seen.len() >= 8,
                "{:?}: only {} of {PLACED} were found",
                board.pattern,
                seen.len()
            );
            let found = calibrate(&board, &seen, (320, 240), Lens::None, &mut |_| {}).unwrap();
            assert!(
                found.rms_px[2] < 0.25,
                "{:?}: {:?}",
                board.pattern,
                found.rms_px
            );
            let error = found.rig.baseline_m() - rig.baseline_m();
            assert!(
                error.abs() < sigmas * found.sigma(EXTRINSICS),
                "{:?}: {error} {}",
                board.pattern,
                found.sigma(EXTRINSICS)
            );
            let error_px = found.rig.left.focal_px.x - rig.left.focal_px.x;
            assert!(
                error_px.abs() < sigmas * found.sigma(0),
                "{:?}: {error_px} {}",
                board.pattern,
                found.sigma(0)
            );
        }
    }
}

/// Rigs of published recordings, as this program reads them, with their images.
fn good_rigs() -> Vec<(&'static str, StereoRig, PathBuf)> {
    ["kitti_straight", "euroc_standstill"]
        .into_iter()
        .filter_map(|name| {
            let folder = data(name)?;
            let rig = visod::capture::Dataset::open(&folder, None).unwrap().rig;
            Some((name, rig, folder))
        })
        .collect()
}

#[test]
fn good_rigs_raise_no_alarm_with_images_or_without() {
    assert_eq!(check_rig(&thesis_rig()), []);
    for (name, rig, folder) in good_rigs() {
        assert_eq!(check_rig(&rig), [], "{name}");
        let own = tempfile::tempdir().unwrap();
        std::fs::write(own.path().join("rig.toml"), rig_to_toml(&rig)).unwrap();
        let said = succeed(
            own.path(),
            &[
                "rig",
                "check",
                "rig.toml",
                "--images",
                folder.to_str().unwrap(),
            ],
        );
        assert!(
            said.contains("plausible") && said.contains("matches agree"),
            "{name}: {said}"
        );
    }
}

#[test]
fn the_sample_rig_in_full_size_raises_no_alarm_on_its_own_images() {
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let rig = rig.to_str().unwrap();
    let own = tempfile::tempdir().unwrap();
    let way = "simulate --scene hall --trajectory slalom --frames 3 --rig";
    let args: Vec<&str> = way.split(' ').chain([rig, "recording"]).collect();
    succeed(own.path(), &args);
    let said = succeed(own.path(), &["rig", "check", rig, "--images", "recording"]);
    assert!(
        said.contains("plausible") && said.contains("matches agree"),
        "{said}"
    );
    assert!(
        !said.contains("warning") && !said.contains("error"),
        "{said}"
    );
}

#[test]
fn images_that_do_not_belong_to_the_rig_are_found() {
    let rigs = good_rigs();
    let Some((_, raw, folder)) = rigs.iter().find(|(name, ..)| *name == "euroc_standstill") else {
        return;
    };
    let own = tempfile::tempdir().unwrap();
    let mut inverse = raw.clone();
    inverse.right_from_left = raw.right_from_left.inverse();
    std::fs::write(own.path().join("rig.toml"), rig_to_toml(&inverse)).unwrap();
    let output = run(
        own.path(),
        &[
            "rig",
            "check",
            "rig.toml",
            "--images",
            folder.to_str().unwrap(),
            "--json",
        ],
    );
    assert_eq!(output.status.code(), Some(2));
    let findings: Value = serde_json::from_slice(&output.stdout).unwrap();
    let words = findings.to_string();
    assert!(
        words.contains("invert") || words.contains("swap"),
        "{words}"
    );
    // Rectified images with a rig that is not: those of KITTI are.
    let Some((_, kitti, folder)) = rigs.iter().find(|(name, ..)| *name == "kitti_straight") else {
        return;
    };
    let mut bent = kitti.clone();
    bent.right_from_left.rotation =
        visod::geometry::so3::exp(&nalgebra::Vector3::new(0.03, 0.01, 0.02));
    std::fs::write(own.path().join("rig.toml"), rig_to_toml(&bent)).unwrap();
    let output = run(
        own.path(),
        &[
            "rig",
            "check",
            "rig.toml",
            "--images",
            folder.to_str().unwrap(),
        ],
    );
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("rectified images"), "{said}");
}

#[test]
fn opencvs_own_files_are_converted() {
    let Some(boards) = data("chessboard_640x480") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| boards.join(name).to_str().unwrap().to_owned();
    let (intrinsics, extrinsics) = (
        file("published_intrinsics.yml"),
        file("published_extrinsics.yml"),
    );
    succeed(
        folder.path(),
        &[
            "rig",
            "convert",
            &intrinsics,
            &extrinsics,
            "--size",
            "640x480",
            "-o",
            "rig.toml",
        ],
    );
    let rig = load_rig(&folder.path().join("rig.toml")).unwrap();
    assert!((rig.right_from_left.translation.vector.x + 3.342_708_681_661_723_5).abs() < 1e-15);
    // There and back through another tool's format.
    succeed(
        folder.path(),
        &[
            "rig",
            "convert",
            "rig.toml",
            "--to",
            "kalibr",
            "-o",
            "camchain.yaml",
        ],
    );
    succeed(
        folder.path(),
        &["rig", "convert", "camchain.yaml", "-o", "again.toml"],
    );
    let again = load_rig(&folder.path().join("again.toml")).unwrap();
    assert_eq!(again.left, rig.left);
    assert!((again.right_from_left.to_matrix() - rig.right_from_left.to_matrix()).amax() < 1e-14);
}
