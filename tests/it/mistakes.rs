//! Mistakes that a user makes: one clear sentence each, and the right exit code.

use super::replay::{Recording, stderr_of, visod};
use std::path::Path;
use std::process::Output;

/// Runs `visod replay --no-publish` in `folder`, with backtraces asked for.
fn replay(folder: &Path, args: &[&str]) -> Output {
    visod()
        .current_dir(folder)
        .env("RUST_BACKTRACE", "1")
        .args(["replay", "--no-publish"])
        .args(args)
        .output()
        .unwrap()
}

/// The error: one sentence on a line of its own, no panic, nothing on standard output.
fn assert_refused(output: &Output, code: i32, says: &[&str]) {
    let said = stderr_of(output);
    assert_eq!(output.status.code(), Some(code), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(
        said.starts_with("visod: ") && said.ends_with('\n'),
        "{said}"
    );
    assert!(
        !said.contains("panicked") && !said.contains("backtrace"),
        "{said}"
    );
    for part in says {
        assert!(said.contains(part), "no '{part}' in: {said}");
    }
    assert!(output.stdout.is_empty());
}

#[test]
fn what_is_no_recording_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::create_dir(path.join("empty")).unwrap();
    std::fs::create_dir_all(path.join("half/left")).unwrap();
    std::fs::create_dir_all(path.join("bare/left")).unwrap();
    std::fs::create_dir_all(path.join("bare/right")).unwrap();
    std::fs::write(path.join("file"), "hello").unwrap();
    for (dataset, says) in [
        ("empty", "empty: the folder is empty"),
        ("file", "file: is not a folder"),
        ("nowhere", "nowhere: cannot be read: No such file"),
        ("half", "half/right: is missing"),
        (
            "bare",
            "bare: has images but neither rig.toml nor calib.txt",
        ),
        (".", "holds no recording"),
    ] {
        assert_refused(&replay(path, &[dataset]), 2, &[says]);
    }
}

#[test]
fn a_wrong_configuration_is_named_with_file_line_and_key() {
    let recording = Recording::shared();
    let dataset = recording.path().to_str().unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (text, says) in [
        (
            "[matching]\nmax_ration = 0.8\n",
            "c.toml:2: matching.max_ration: unknown field",
        ),
        ("max_ratio = 0.8\n", "c.toml:1: max_ratio: unknown field"),
        ("\n[cameras]\n", "c.toml:2: cameras: unknown field"),
        (
            "[matching]\n\nmax_ratio = 7.0\n",
            "c.toml:3: matching.max_ratio: must be from 0.1 to 1, but is 7",
        ),
        (
            "[estimation]\ngate_sigma2 = nan\n",
            "c.toml:2: estimation.gate_sigma2: must be from 1 to 100, but is NaN",
        ),
        (
            "[features]\n[features.surf]\nhessian = -1\n",
            "c.toml:3: features.surf.hessian: must be from 0 to",
        ),
        (
            "[pipeline]\nworkers = 65\n",
            "c.toml:2: pipeline.workers: must be from 0 to 64, but is 65",
        ),
        (
            "[pipeline]\nworkers = -1\n",
            "c.toml:2: pipeline.workers: invalid value: integer `-1`",
        ),
        (
            "[matching]\nmax_ratio = \"much\"\n",
            "c.toml:2: matching.max_ratio: invalid type: string \"much\"",
        ),
        (
            "[publish]\nprefix = \"a/b\"\n",
            "c.toml:2: publish.prefix: must be 1 to 32 letters",
        ),
        (
            "[features]\ndetector = \"harris\"\n",
            "c.toml:2: features.detector: unknown variant `harris`",
        ),
        ("[matching\nmax_ratio = 0.8\n", "c.toml:1: "),
        (
            "[matching]\nmax_ratio = 0.8\nmax_ratio = 0.9\n",
            "c.toml:3: ",
        ),
        (
            "rig = \"nowhere.toml\"\n",
            "nowhere.toml: cannot be read: No such file",
        ),
    ] {
        std::fs::write(folder.path().join("c.toml"), text).unwrap();
        let output = replay(folder.path(), &[dataset, "--config", "c.toml"]);
        assert_refused(&output, 2, &[says]);
    }
    std::fs::write(folder.path().join("c.toml"), b"\xff\xfe").unwrap();
    let output = replay(folder.path(), &[dataset, "--config", "c.toml"]);
    assert_refused(&output, 2, &["c.toml:1: is not UTF-8 text"]);
    let output = replay(folder.path(), &[dataset, "--config", "none.toml"]);
    assert_refused(&output, 2, &["none.toml: cannot be read"]);
}

#[cfg(not(feature = "opencv"))]
#[test]
fn a_detector_that_was_not_built_in_is_named_with_its_feature() {
    let recording = Recording::shared();
    let dataset = recording.path().to_str().unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (text, says) in [
        (
            "[features]\ndetector = \"sift\"\n",
            "c.toml:2: features.detector: ",
        ),
        (
            "[features.opencv]\nbudget = 500\n",
            "c.toml:1: features.opencv: ",
        ),
    ] {
        std::fs::write(folder.path().join("c.toml"), text).unwrap();
        let output = replay(folder.path(), &[dataset, "--config", "c.toml"]);
        assert_refused(&output, 2, &[says, "feature `opencv`"]);
    }
}

#[test]
fn a_wrong_rig_is_named_with_file_line_and_key() {
    let recording = Recording::shared();
    let dataset = recording.path().to_str().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let good = std::fs::read_to_string(recording.path().join("rig.toml")).unwrap();
    let spoil = |key: &str, value: &str| {
        let mut lines: Vec<String> = good.lines().map(str::to_owned).collect();
        let at = lines.iter().position(|line| line.starts_with(key)).unwrap();
        lines[at] = format!("{key} = {value}");
        (lines.join("\n"), format!("rig.toml:{}: ", at + 1))
    };
    for (key, value, says) in [
        (
            "focal",
            "[nan, 300.0]",
            "left.focal: must be finite and above 0 px, but holds NaN",
        ),
        (
            "principal_point",
            "[inf, 119.5]",
            "left.principal_point: must be finite",
        ),
        ("width", "0", "left.width: must be from 1 to"),
        (
            "translation_m",
            "[0.0, 0.0, 0.0]",
            "right_from_left.translation_m: the cameras must stand apart",
        ),
        (
            "rotation_vector_rad",
            "[0.0, nan, 0.0]",
            "right_from_left.rotation_vector_rad: must be finite",
        ),
    ] {
        let (text, place) = spoil(key, value);
        std::fs::write(folder.path().join("rig.toml"), text).unwrap();
        for args in [
            vec!["replay", "--no-publish", dataset, "--rig", "rig.toml"],
            vec!["rig", "check", "rig.toml"],
        ] {
            let output = visod()
                .current_dir(folder.path())
                .args(args)
                .output()
                .unwrap();
            assert_refused(&output, 2, &[&place, says]);
        }
    }
}

#[test]
fn an_output_that_cannot_be_written_is_named() {
    let recording = Recording::shared();
    let dataset = recording.path().to_str().unwrap();
    let folder = tempfile::tempdir().unwrap();
    for flag in ["--odometry", "--trajectory"] {
        let output = replay(folder.path(), &[dataset, flag, "nowhere/out"]);
        assert_refused(
            &output,
            1,
            &["nowhere/out: cannot be written: No such file"],
        );
    }
    // Those at the end of a run come after its figures.
    for flag in ["--summary", "--report"] {
        let output = replay(folder.path(), &[dataset, flag, "nowhere/out"]);
        let said = stderr_of(&output);
        assert_eq!(output.status.code(), Some(1));
        assert!(
            said.starts_with("visod: nowhere/out: cannot be written: No such file"),
            "{said}"
        );
        assert_eq!(said.lines().count(), 1, "{said}");
    }
    if Path::new("/dev/full").exists() {
        for flag in ["--odometry", "--trajectory"] {
            let output = replay(folder.path(), &[dataset, flag, "/dev/full"]);
            assert_refused(&output, 1, &["/dev/full: cannot be written: No space left"]);
        }
    }
}

#[test]
fn a_recording_of_which_nothing_can_be_used_is_a_failure() {
    let recording = Recording::shared();
    let folder = tempfile::tempdir().unwrap();
    let own = std::fs::read_to_string(recording.path().join("rig.toml")).unwrap();
    let other = own
        .replace("width = 320", "width = 640")
        .replace("height = 240", "height = 480");
    assert_ne!(other, own);
    std::fs::write(folder.path().join("other.toml"), other).unwrap();
    let dataset = recording.path().to_str().unwrap();
    let output = replay(folder.path(), &[dataset, "--rig", "other.toml"]);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr_of(&output);
    let (last, before) = said
        .lines()
        .collect::<Vec<_>>()
        .split_last()
        .map(|(l, b)| (*l, b.to_vec()))
        .unwrap();
    let size = "the image has 320×240 px, but the rig's 640×480";
    assert!(
        last.contains(": not one of 12 pairs is usable; the first: ") && last.contains(size),
        "{last}"
    );
    assert!(
        before
            .iter()
            .all(|line| line.starts_with("visod: warning: ")),
        "{said}"
    );
}

#[test]
fn wrong_usage_ends_with_code_2() {
    for args in [
        &[][..],
        &["replay"],
        &["fly"],
        &["replay", ".", "--pace", "slow"],
        &["replay", ".", "--unknown"],
        &[
            "simulate",
            "--scene",
            "moon",
            "--trajectory",
            "straight",
            "out",
        ],
        &["evaluate"],
        &["rig"],
    ] {
        let output = visod().args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty(), "{args:?}");
        let said = stderr_of(&output);
        assert!(said.contains("--help"), "{args:?}: {said}");
    }
}
