//! What a newcomer copies from: the sample configuration, the sample rig and every command's help.

use super::replay::{stderr_of, visod};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use visod::capture::settings::{CameraSettings, ControlValue};
use visod::config::Config;
use visod::geometry::{check_rig, load_rig};

fn sample(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("config")
        .join(name)
}

fn sample_text() -> String {
    std::fs::read_to_string(sample("visod.toml")).unwrap()
}

/// Whether a line sets a key or opens a table once `# ` is taken off.
fn is_setting(line: &str) -> bool {
    let word = |text: &str| {
        text.chars()
            .all(|c| c.is_ascii_alphanumeric() || "_.".contains(c))
    };
    let table = line.strip_prefix('[').and_then(|l| l.strip_suffix(']'));
    table.is_some_and(word) || line.split_once(" = ").is_some_and(|(key, _)| word(key))
}

/// The sample with its commented settings put in force.
fn uncommented(text: &str) -> String {
    let line = |line: &str| match line.strip_prefix("# ") {
        Some(setting) if is_setting(setting) => setting.to_owned(),
        _ => line.to_owned(),
    };
    text.lines().map(|l| line(l) + "\n").collect()
}

/// The dotted keys of all values below `table`.
fn keys(table: &toml::Table) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (name, value) in table {
        match value {
            toml::Value::Table(inner) => {
                found.extend(keys(inner).iter().map(|key| format!("{name}.{key}")));
            }
            _ => drop(found.insert(name.clone())),
        }
    }
    found
}

/// All settings there are, optional ones included.
fn all_keys() -> BTreeSet<String> {
    let mut config = Config {
        rig: Some("rig.toml".into()),
        ..Config::default()
    };
    // The right camera's keys are the left one's; the sample repeats only its name.
    config.camera.left = Some(CameraSettings {
        id: "PointGrey-11223344".to_owned(),
        pixel_format: Some("Mono8".to_owned()),
        frame_rate_hz: Some(20.0),
        exposure_ms: Some(5.0),
        gain: Some(0.0),
        packet_size: Some(1500),
        white_level: Some(4095),
        controls: [("BlackLevel".to_owned(), ControlValue::Integer(0))].into(),
        ..CameraSettings::default()
    });
    config.estimation.max_speed_m_s = Some(3.0);
    config.estimation.max_turn_rad_s = Some(4.0);
    config.publish.root = Some("/run/visod".into());
    config.publish.prefix = Some("robot1_".to_owned());
    config.last_pose.file = Some("/var/lib/visod/last_pose.toml".into());
    config.metrics.listen = Some("127.0.0.1:9477".to_owned());
    config.publish.foxglove = visod::output::publication::FOXGLOVE_ADDRESS.parse().ok();
    keys(&toml::Table::try_from(config).unwrap())
}

#[test]
fn the_sample_configuration_is_the_default() {
    assert_eq!(
        Config::load(&sample("visod.toml")).unwrap(),
        Config::default()
    );
}

#[test]
fn the_sample_configuration_has_every_key_and_no_other() {
    let in_force = keys(&sample_text().parse().unwrap());
    let defaults = keys(&toml::Table::try_from(Config::default()).unwrap());
    let is_opencv =
        |key: &&String| key.starts_with("features.opencv.") || key.starts_with("matching.flann.");
    let without_opencv = |keys: &BTreeSet<String>| -> BTreeSet<String> {
        keys.iter().filter(|key| !is_opencv(key)).cloned().collect()
    };
    assert_eq!(in_force, without_opencv(&defaults));

    let mut offered = keys(&uncommented(&sample_text()).parse().unwrap());
    assert!(offered.remove("camera.right.id"));
    let all = all_keys();
    if cfg!(feature = "opencv") {
        assert_eq!(offered, all);
    } else {
        assert_eq!(without_opencv(&offered), all);
    }
}

#[test]
fn commented_settings_of_the_cameras_are_the_default_where_there_is_one() {
    let table: toml::Table = uncommented(&sample_text()).parse().unwrap();
    let left: CameraSettings = table["camera"]["left"].clone().try_into().unwrap();
    assert!(left.check().is_ok());
    let default = CameraSettings::default();
    assert_eq!(left.driver, default.driver);
    assert_eq!(left.exposure_max_ms, default.exposure_max_ms);
    assert_eq!(left.trigger, default.trigger);
    assert_eq!(left.trigger_source, default.trigger_source);
    assert_eq!(left.offset_px, default.offset_px);
    assert_eq!(left.buffers, default.buffers);
}

#[cfg(feature = "opencv")]
#[test]
fn commented_settings_of_opencv_are_the_default() {
    let config = Config::parse(&uncommented(&sample_text())).unwrap();
    assert_eq!(config.features, Config::default().features);
    assert_eq!(config.matching, Config::default().matching);
}

#[test]
fn every_key_of_the_sample_has_a_comment_with_its_default_explained() {
    let mut comment = String::new();
    let text = sample_text();
    for line in text.lines() {
        let setting = line.strip_prefix("# ").unwrap_or(line);
        if is_setting(setting) {
            if !setting.starts_with('[') {
                assert!(comment.contains("Default: "), "{setting}: {comment}");
            }
            comment.clear();
        } else if line.is_empty() {
            comment.clear();
        } else {
            comment += setting;
            comment.push(' ');
        }
    }
}

#[test]
fn the_sample_rig_is_plausible() {
    let rig = load_rig(&sample("rig.toml")).unwrap();
    assert_eq!(check_rig(&rig), []);
    let base_from_camera = rig.base_from_camera.unwrap();
    // The camera looks ahead, and its right is the robot's right.
    let ahead = base_from_camera.rotation * nalgebra::Vector3::z();
    let right = base_from_camera.rotation * nalgebra::Vector3::x();
    assert!((ahead - nalgebra::Vector3::x()).norm() < 1e-6);
    assert!((right + nalgebra::Vector3::y()).norm() < 1e-6);
    assert!(rig.uncertainty.is_some());
    let output = visod()
        .args(["rig", "check"])
        .arg(sample("rig.toml"))
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr_of(&output));
}

/// The help of a command, which must succeed.
fn help(command: &[String]) -> String {
    let output = visod().args(command).arg("--help").output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{command:?}");
    assert_eq!(stderr_of(&output), "", "{command:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// The commands that a help text lists, `help` itself left out.
fn subcommands(help: &str) -> Vec<String> {
    let lines = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    lines
        .take_while(|line| !line.is_empty())
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

#[test]
fn every_command_has_help_with_an_example_of_its_own_flags() {
    let mut to_visit = vec![Vec::new()];
    let mut visited = 0;
    while let Some(command) = to_visit.pop() {
        let text = help(&command);
        visited += 1;
        let (_, examples) = text.rsplit_once("Example").unwrap_or_else(|| {
            panic!("the help of {command:?} has no example");
        });
        assert!(
            examples.contains(&["visod", &command.join(" ")].join(" ")),
            "{command:?}"
        );
        let flags = examples
            .split_whitespace()
            .filter(|word| word.starts_with("--"));
        for flag in flags {
            let offered = text.lines().any(|line| {
                let line = line.trim_start();
                line.starts_with(flag) || line.contains(&format!(", {flag}"))
            });
            assert!(
                offered,
                "{command:?}: its example has {flag}, which it does not take"
            );
        }
        for name in subcommands(&text) {
            to_visit.push([command.as_slice(), &[name]].concat());
        }
    }
    assert!(visited >= 9, "only {visited} commands found");
}
