//! The C header in `tools/clients/` against the layouts that the crate documents and has.
//!
//! Needs `cc`, which building visod does too.

use std::path::{Path, PathBuf};
use std::process::Command;
use visod::output::features::{FEATURES_MAGIC, FeaturesMessage, MAX_FEATURES};
use visod::output::health::{HEALTH_MAGIC, HealthMessage};
use visod::output::message::{ODOMETRY_MAGIC, OdometryMessage};
use visod::output::publication;

/// Type in C, size in Rust, and the source whose documentation has the layout.
const STRUCTS: [(&str, usize, &str); 4] = [
    (
        "visod_odometry_message",
        size_of::<OdometryMessage>(),
        include_str!("../../src/output/message.rs"),
    ),
    (
        "visod_features_message",
        size_of::<FeaturesMessage>(),
        include_str!("../../src/output/features.rs"),
    ),
    (
        "visod_feature",
        size_of::<visod::output::features::Feature>(),
        include_str!("../../src/output/features.rs"),
    ),
    (
        "visod_health_message",
        size_of::<HealthMessage>(),
        include_str!("../../src/output/health.rs"),
    ),
];

fn header_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/clients")
}

/// Offset, type and name of each documented field of a struct.
fn documented(name: &str, source: &'static str) -> Vec<(usize, &'static str, &'static str)> {
    let begin = match name {
        "visod_feature" => "//! | +",
        _ => "//! | ",
    };
    source
        .lines()
        .filter_map(|line| line.strip_prefix(begin))
        .filter_map(|row| {
            let cells: Vec<_> = row.split(" | ").collect();
            // A `+` would be parsed too: it marks the fields of what is in a message.
            let offset = cells[0].parse().ok().filter(|_| !row.starts_with('+'))?;
            Some((
                offset,
                cells[1].trim_matches('`'),
                cells[2].trim_matches('`'),
            ))
        })
        .collect()
}

/// A C or C++ program that prints every offset, size and constant.
fn program() -> String {
    let mut text = "#include <stdio.h>\n#include \"visod.h\"\nint main(void) {\n".to_owned();
    for (name, _, source) in STRUCTS {
        for (_, kind, field) in documented(name, source) {
            let member = format!("(({name} *)0)->{field}");
            let first = if kind.starts_with('[') {
                format!("{member}[0]")
            } else {
                member.clone()
            };
            text.push_str(&format!(
                "printf(\"{name} {field} %zu %zu %zu\\n\", offsetof({name}, {field}), sizeof({member}), sizeof({first}));\n"
            ));
        }
        text.push_str(&format!("printf(\"{name} %zu\\n\", sizeof({name}));\n"));
    }
    for constant in [
        "ODOMETRY_MAGIC",
        "FEATURES_MAGIC",
        "HEALTH_MAGIC",
        "MAX_FEATURES",
        "ODOMETRY_BUFFER",
        "FEATURES_BUFFER",
        "HEALTH_BUFFER",
        "MAX_SUBSCRIBERS",
        "MAX_PUBLISHERS",
        "MAX_NODES",
        "EVENT_LEAVING",
        "EVENT_CONNECTED",
        "EVENT_MAX",
    ] {
        text.push_str(&format!(
            "printf(\"{constant} %lu\\n\", (unsigned long)VISOD_{constant});\n"
        ));
    }
    for text_of in ["ODOMETRY_SERVICE", "FEATURES_SERVICE", "HEALTH_SERVICE"] {
        text.push_str(&format!("puts(\"{text_of} \" VISOD_{text_of});\n"));
    }
    text + "return 0;\n}\n"
}

/// Size of one element in Rust.
fn size_of_element(kind: &str) -> usize {
    match kind.trim_matches(['[', ']']).split(';').next().unwrap() {
        "u32" | "i32" | "f32" => 4,
        "Feature" => size_of::<visod::output::features::Feature>(),
        _ => 8,
    }
}

fn expected() -> String {
    let mut text = String::new();
    for (name, size, source) in STRUCTS {
        for (offset, kind, field) in documented(name, source) {
            let each = size_of_element(kind);
            let count = kind
                .split("; ")
                .nth(1)
                .map_or(1, |n| n.trim_end_matches(']').parse().unwrap());
            text.push_str(&format!(
                "{name} {field} {offset} {} {each}\n",
                each * count
            ));
        }
        text.push_str(&format!("{name} {size}\n"));
    }
    for (constant, value) in [
        ("ODOMETRY_MAGIC", ODOMETRY_MAGIC as usize),
        ("FEATURES_MAGIC", FEATURES_MAGIC as usize),
        ("HEALTH_MAGIC", HEALTH_MAGIC as usize),
        ("MAX_FEATURES", MAX_FEATURES),
        ("ODOMETRY_BUFFER", publication::ODOMETRY_BUFFER),
        ("FEATURES_BUFFER", publication::FEATURES_BUFFER),
        ("HEALTH_BUFFER", publication::HEALTH_BUFFER),
        ("MAX_SUBSCRIBERS", publication::MAX_SUBSCRIBERS),
        ("MAX_PUBLISHERS", publication::MAX_PUBLISHERS),
        ("MAX_NODES", publication::MAX_NODES),
        ("EVENT_LEAVING", publication::events::LEAVING),
        ("EVENT_CONNECTED", publication::events::CONNECTED),
        ("EVENT_MAX", publication::events::MAX),
    ] {
        text.push_str(&format!("{constant} {value}\n"));
    }
    text.push_str(&format!(
        "ODOMETRY_SERVICE {}\n",
        publication::ODOMETRY_SERVICE
    ));
    text.push_str(&format!(
        "FEATURES_SERVICE {}\n",
        publication::FEATURES_SERVICE
    ));
    text + &format!("HEALTH_SERVICE {}\n", publication::HEALTH_SERVICE)
}

#[test]
fn c_and_cpp_have_the_documented_layouts() {
    let folder = tempfile::tempdir().unwrap();
    for (compiler, file, standard) in [
        ("cc", "layout.c", "-std=c11"),
        ("c++", "layout.cpp", "-std=c++11"),
    ] {
        if Command::new(compiler).arg("--version").output().is_err() {
            println!("skipped: there is no {compiler}");
            continue;
        }
        std::fs::write(folder.path().join(file), program()).unwrap();
        let compiled = Command::new(compiler)
            .current_dir(folder.path())
            .args([standard, "-Wall", "-Wextra", "-Werror", "-pedantic", "-I"])
            .arg(header_folder())
            .args([file, "-o", "layout"])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&compiled.stderr);
        assert!(compiled.status.success(), "{compiler}: {said}");
        let output = Command::new(folder.path().join("layout")).output().unwrap();
        assert_eq!(
            String::from_utf8(output.stdout).unwrap(),
            expected(),
            "{compiler}"
        );
    }
}
