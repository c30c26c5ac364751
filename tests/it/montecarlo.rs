//! `visod montecarlo` as a user runs it.

use super::replay::{stderr_of, visod};

fn small(more: &[&str]) -> std::process::Output {
    visod()
        .args([
            "montecarlo",
            "--runs",
            "20",
            "--steps",
            "4",
            "--features",
            "20",
        ])
        .args(more)
        .output()
        .unwrap()
}

#[test]
fn it_prints_a_table_and_writes_numbers_and_figures() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("deep/er");
    let output = small(&["-o", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr_of(&output));
    assert_eq!(stderr_of(&output), "");
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        text.contains("pose after 4 motions") && text.contains("point at 40 m"),
        "{text}"
    );
    let csv = std::fs::read_to_string(out.join("montecarlo.csv")).unwrap();
    let header = csv.lines().next().unwrap();
    assert!(header.starts_with(
        "stage,at,runs,failed,degrees_of_freedom,anees,anees_low,anees_high,coverage"
    ));
    let columns = header.split(',').count();
    assert!(
        csv.lines().all(|line| line.split(',').count() == columns),
        "{csv}"
    );
    // Fourteen or fifteen points, a motion, all increments, four poses.
    assert!((20..=21).contains(&(csv.lines().count() - 1)), "{csv}");
    for figure in [
        "points",
        "point-errors",
        "motion",
        "path",
        "growth",
        "anees",
    ] {
        let svg = std::fs::read_to_string(out.join(format!("{figure}.svg"))).unwrap();
        assert!(
            svg.starts_with("<svg xmlns=") && svg.ends_with("</svg>\n"),
            "{figure}"
        );
    }
    let html = std::fs::read_to_string(out.join("montecarlo.html")).unwrap();
    assert_eq!(html.matches("<figure>").count(), 6);
}

#[test]
fn the_same_seed_prints_the_same_bits_with_any_number_of_threads() {
    let json = |threads: &str| small(&["--json", "--seed", "7", "--threads", threads]).stdout;
    let one = json("1");
    assert_eq!(one, json("3"));
    let verdicts: serde_json::Value = serde_json::from_slice(&one).unwrap();
    let last = verdicts.as_array().unwrap().last().unwrap();
    assert_eq!(last["stage"], "pose");
    assert!(last["anees"].as_f64().unwrap() > 0.0);
    assert!(last["translation_m"]["ratio_to_bound"].as_f64().unwrap() > 0.3);
}

#[test]
fn a_stage_a_model_and_a_method_can_be_chosen() {
    let output = small(&[
        "--stage", "motion", "--model", "planar", "--method", "weighted", "--json",
    ]);
    let verdicts: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(verdicts.as_array().unwrap().len(), 1);
    assert_eq!(verdicts[0]["degrees_of_freedom"], 3);
}

#[test]
fn mistakes_are_told_in_a_sentence() {
    for (args, code, says) in [
        (
            &["--survival", "1.5"][..],
            2,
            "--survival: must be from 0 to 1, but is 1.5",
        ),
        (
            &["--depth", "5,2"],
            2,
            "--depth: must be from 5 to 10000, but is 2",
        ),
        (
            &["--depth", "5"],
            2,
            "--depth must be two numbers, NEAR,FAR",
        ),
        (&["--threads", "0"], 2, "--threads must be at least 1"),
        (
            &["--rig-error", "considered"],
            2,
            "the rig states no uncertainty of its parameters",
        ),
        (&["--rig", "no.toml"], 2, "no.toml: cannot be read"),
        (
            &["--noise", "student", "--freedom", "1"],
            2,
            "--freedom: must be from 2.01 to 1000000, but is 1",
        ),
        (
            &["--json", "-o", "/dev/null/nowhere"],
            1,
            "/dev/null/nowhere: cannot be written",
        ),
    ] {
        let output = small(args);
        let said = stderr_of(&output);
        assert_eq!(output.status.code(), Some(code), "{args:?} {said}");
        assert!(
            said.contains(says) && said.lines().count() == 1,
            "{args:?} {said}"
        );
    }
}

/// The short form of `cargo bench --bench corrupted`.
#[test]
fn of_corrupted_pairs_no_pose_that_is_called_tracking_is_wrong() {
    use visod::config::Config;
    use visod::geometry::RigUncertainty;
    use visod::simulation::corruption::Corruption;
    let rig = visod::geometry::StereoRig {
        uncertainty: Some(RigUncertainty::Sigmas {
            focal_px: 0.3,
            principal_point_px: 0.3,
            rotation_rad: 1e-4,
            translation_m: 2e-4,
        }),
        ..visod::simulation::small_rig()
    };
    let outcome =
        visod::montecarlo::run_corrupted(&rig, &Config::default(), &Corruption::ALL, 2, 1, &|_| {})
            .unwrap();
    println!("{}", outcome.to_table());
    assert!(outcome.total().corrupted > 500);
    for (kind, tally) in &outcome.kinds {
        assert_eq!(tally.invalid, 0, "{kind}");
        // After five corrupted pairs in a row what was seen before them may be out of view until the odometry begins
        // anew; of eighty pairs of two sequences that leaves enough.
        assert!(tally.tracking > 30, "{kind} {}", tally.tracking);
        assert_eq!(tally.wrong_poses, 0, "{kind}");
        // A motion to or from images that are smeared, or shown in two parts, is wrong now and then: there the bench
        // counts.
        if ![Corruption::HalfLate, Corruption::Blur].contains(kind) {
            assert_eq!(tally.wrong_motions, 0, "{kind}");
        }
    }
}
