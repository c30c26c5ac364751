//! `visod evaluate` as a user runs it, beside evo, the tool that most papers evaluate with.

use nalgebra::{Isometry3, Vector6};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};
use visod::geometry::se3;

/// What evo 1.38.1 says of [`drive`] and [`odometry`]: `evo_ape kitti` plain, `-a` and `-as`,
/// `evo_rpe kitti --delta 1 --delta_unit f`, each with `-r trans_part` and `-r angle_deg`; in the
/// order rmse, mean, median, std, min, max, sse.
#[rustfmt::skip]
const EVO: [(&str, [f64; 7]); 8] = [
    ("ate none translation_m", [0.236414316819, 0.205943040398, 0.202813079121, 0.116099928118, 0.0, 0.40879383475, 6.70700750366]),
    ("ate none rotation_deg", [0.0257629040805, 0.0239861893474, 0.0227191693779, 0.0094015928041, 0.0, 0.0426633615059, 0.0796472671994]),
    ("ate se3 translation_m", [0.122724809246, 0.11063091049, 0.106729243952, 0.0531241983337, 0.0310474103564, 0.209431036544, 1.80736545653]),
    ("ate se3 rotation_deg", [0.0224817712258, 0.0212436454191, 0.0225136044577, 0.00735782350692, 0.00550291132661, 0.0349943258558, 0.060651604494]),
    ("ate sim3 translation_m", [0.00361247874131, 0.00347781420227, 0.00358099556077, 0.000977144324488, 0.000870677001449, 0.00525837041775, 0.00156600031877]),
    ("ate sim3 rotation_deg", [0.0224817712258, 0.0212436454191, 0.0225136044577, 0.00735782350692, 0.00550291132661, 0.0349943258558, 0.060651604494]),
    ("rpe translation_m", [0.00669038015274, 0.0061458586714, 0.00513308824834, 0.00264378663649, 0.00319204370133, 0.0128472626614, 0.00532658120399]),
    ("rpe rotation_deg", [0.0271632936391, 0.0260020178477, 0.026741881169, 0.00785745436992, 0.00201781477449, 0.0382878162643, 0.0878034980377]),
];

/// A drive of 120 poses that winds in all three dimensions.
fn drive() -> Vec<Isometry3<f64>> {
    chain(|i| {
        let phase = i / 15.0;
        Vector6::new(
            0.02,
            -0.01 * phase.cos(),
            1.0,
            0.004,
            0.05 * phase.sin(),
            0.003,
        )
    })
}

/// The same with errors of each step.
fn odometry() -> Vec<Isometry3<f64>> {
    chain(|i| {
        let phase = i / 15.0;
        let (a, b) = ((3.7 * i).sin(), (5.3 * i).cos());
        Vector6::new(
            0.02 + 0.004 * a,
            -0.01 * phase.cos() + 0.003 * b,
            1.004 + 0.008 * a * b,
            0.004 + 4e-4 * b,
            0.05 * phase.sin() + 5e-4 * a,
            0.003 - 2e-4 * b,
        )
    })
}

fn chain(step: impl Fn(f64) -> Vector6<f64>) -> Vec<Isometry3<f64>> {
    let mut pose = Isometry3::identity();
    (0..120)
        .map(|i| {
            let now = pose;
            pose *= se3::exp(&step(f64::from(i)));
            now
        })
        .collect()
}

fn kitti(poses: &[Isometry3<f64>]) -> String {
    let mut text = String::new();
    for pose in poses {
        let m = pose.to_matrix();
        let row: Vec<String> = (0..12)
            .map(|k| format!("{:e}", m[(k / 4, k % 4)]))
            .collect();
        writeln!(text, "{}", row.join(" ")).unwrap();
    }
    text
}

fn visod(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_visod"))
        .args(args)
        .output()
        .unwrap()
}

fn evaluate_json(truth: &Path, odometry: &Path) -> Value {
    let output = visod(&[
        "evaluate",
        "--json",
        "--ground-truth",
        truth.to_str().unwrap(),
        "--odometry",
        odometry.to_str().unwrap(),
    ]);
    assert!(output.status.success(), "{output:?}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The statistics under a JSON object, in the order of [`EVO`].
fn statistics(of: &Value) -> [f64; 7] {
    ["rmse", "mean", "median", "std", "min", "max", "sse"].map(|name| of[name].as_f64().unwrap())
}

/// The statistics of an evaluation under the names of [`EVO`].
fn by_name(evaluation: &Value) -> Vec<(String, [f64; 7])> {
    let mut found = Vec::new();
    for ate in evaluation["ate"].as_array().unwrap() {
        let how = ate["alignment"].as_str().unwrap();
        for part in ["translation_m", "rotation_deg"] {
            found.push((format!("ate {how} {part}"), statistics(&ate[part])));
        }
    }
    for part in ["translation_m", "rotation_deg"] {
        found.push((format!("rpe {part}"), statistics(&evaluation["rpe"][part])));
    }
    found
}

fn assert_agree(found: &[(String, [f64; 7])], name: &str, expected: &[f64; 7], tolerance: f64) {
    let (_, ours) = found.iter().find(|(n, _)| n == name).unwrap();
    for (ours, evo) in ours.iter().zip(expected) {
        let limit = tolerance * evo.abs().max(1.0);
        assert!((ours - evo).abs() <= limit, "{name}: {ours} {evo}");
    }
}

#[test]
fn errors_are_those_that_evo_finds() {
    let folder = tempfile::tempdir().unwrap();
    let (truth, estimate) = (
        folder.path().join("truth.txt"),
        folder.path().join("odometry.txt"),
    );
    std::fs::write(&truth, kitti(&drive())).unwrap();
    std::fs::write(&estimate, kitti(&odometry())).unwrap();
    let found = by_name(&evaluate_json(&truth, &estimate));
    for (name, expected) in &EVO {
        // Golden to the twelve digits noted down.
        assert_agree(&found, name, expected, 1e-10);
    }
}

/// Asks evo for the same statistics.
const ASK_EVO: &str = r#"
import copy, json, sys
from evo.core import metrics
from evo.tools import file_interface
R = metrics.PoseRelation
truth, plain = (file_interface.read_kitti_poses_file(path) for path in sys.argv[1:3])
answer = {}
for name, align, scale in (("none", 0.0, 0), ("se3", 1, 0), ("sim3", 1, 1)):
    estimate = copy.deepcopy(plain)
    if align:
        estimate.align(truth, correct_scale=bool(scale))
    for part, relation in (("translation_m", R.translation_part), ("rotation_deg", R.rotation_angle_deg)):
        metric = metrics.APE(relation)
        metric.process_data((truth, estimate))
        answer[f"ate {name} {part}"] = metric.get_all_statistics()
for part, relation in (("translation_m", R.translation_part), ("rotation_deg", R.rotation_angle_deg)):
    metric = metrics.RPE(relation, 1, metrics.Unit.frames)
    metric.process_data((truth, plain))
    answer[f"rpe {part}"] = metric.get_all_statistics()
print(json.dumps({k: {n: float(x) for n, x in v.items()} for k, v in answer.items()}))
"#;

#[test]
fn evo_agrees_on_recordings() {
    let data = std::env::var("VISOD_TEST_DATA").map_or_else(
        |_| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        Into::into,
    );
    let truth = data.join("trajectories/KITTI_00_gt.txt");
    if !truth.exists() {
        println!("skipped: no test recordings");
        return;
    }
    for name in ["ORB", "SPTAM"] {
        let estimate = data.join(format!("trajectories/KITTI_00_{name}.txt"));
        let Ok(evo) = Command::new("python3")
            .args(["-c", ASK_EVO])
            .args([&truth, &estimate])
            .output()
        else {
            println!("skipped: no python3");
            return;
        };
        if !evo.status.success() {
            println!("skipped: no evo: {}", String::from_utf8_lossy(&evo.stderr));
            return;
        }
        let expected: Value = serde_json::from_slice(&evo.stdout).unwrap();
        let found = by_name(&evaluate_json(&truth, &estimate));
        for (name, of) in expected.as_object().unwrap() {
            // These files hold rotations to six or seven digits; visod takes the nearest rotation,
            // evo the matrix as it stands.
            assert_agree(&found, name, &statistics(of), 1e-6);
        }
    }
}

#[test]
fn wrong_input_gets_one_clear_sentence_and_its_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    let truth = folder.path().join("truth.txt");
    let broken = folder.path().join("broken.txt");
    std::fs::write(&truth, kitti(&drive())).unwrap();
    std::fs::write(&broken, format!("{}1 2 3\n", kitti(&drive()))).unwrap();
    let (truth, broken) = (truth.to_str().unwrap(), broken.to_str().unwrap());
    let evaluate = |more: &[&str]| {
        let output = visod(&[&["evaluate", "--ground-truth", truth], more].concat());
        assert!(output.stdout.is_empty());
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(said.lines().count(), 1, "{said}");
        (output.status.code(), said)
    };
    let (code, said) = evaluate(&["--odometry", broken]);
    assert_eq!(code, Some(1));
    assert!(
        said.contains("broken.txt:121: has 3 columns, but must have 12"),
        "{said}"
    );
    let (code, said) = evaluate(&["--odometry", "/nowhere/odometry.csv"]);
    assert_eq!(code, Some(1));
    assert!(
        said.contains("/nowhere/odometry.csv: cannot be read"),
        "{said}"
    );
    let (code, said) = evaluate(&["--odometry", truth, "--lengths", "10,-20"]);
    assert_eq!(code, Some(2));
    assert!(said.contains("--lengths"), "{said}");
    let (code, _) = evaluate(&["--odometry", truth, "--step", "0"]);
    assert_eq!(code, Some(2));
}

#[test]
fn the_table_has_every_length_and_says_which_is_too_long() {
    let folder = tempfile::tempdir().unwrap();
    let truth = folder.path().join("truth.txt");
    std::fs::write(&truth, kitti(&drive())).unwrap();
    let truth = truth.to_str().unwrap();
    let output = visod(&["evaluate", "--ground-truth", truth, "--odometry", truth]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        text.contains("\n         100         20          0.0000         0.000000\n"),
        "{text}"
    );
    assert!(
        text.contains("\n         200          0       no segment: path too short\n"),
        "{text}"
    );
}
