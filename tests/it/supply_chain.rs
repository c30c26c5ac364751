//! What comes into the program from elsewhere: licences, sources, and the Rust that it takes. `cargo deny` reads
//! the same `.cargo-deny.toml`, and knows advisories besides.

use serde_json::Value;
use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

/// Every package that a build for this machine takes, visod itself apart.
fn dependencies() -> Vec<Value> {
    let output = Command::new(env!("CARGO"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        // What was built for these tests is there: nothing is fetched.
        .args(["metadata", "--format-version", "1", "--locked", "--offline"])
        .args(["--all-features", "--filter-platform", TRIPLE])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let taken: BTreeSet<&str> = metadata["resolve"]["nodes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|node| node["id"].as_str().unwrap())
        .collect();
    let is_other = |package: &&Value| {
        taken.contains(package["id"].as_str().unwrap()) && package["name"] != "visod"
    };
    let packages = metadata["packages"].as_array().unwrap();
    let others: Vec<Value> = packages.iter().filter(is_other).cloned().collect();
    assert!(others.len() > 100, "{}", others.len());
    others
}

const TRIPLE: &str = if cfg!(target_arch = "aarch64") {
    "aarch64-unknown-linux-gnu"
} else {
    "x86_64-unknown-linux-gnu"
};

fn read(file: &str) -> toml::Table {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    std::fs::read_to_string(path).unwrap().parse().unwrap()
}

/// A licence as SPDX spells it, `A OR (B AND C)`, or in the older form `A/B`.
struct Licence<'a> {
    words: Vec<String>,
    at: usize,
    allowed: &'a BTreeSet<String>,
}

impl<'a> Licence<'a> {
    fn is_allowed(text: &str, allowed: &'a BTreeSet<String>) -> bool {
        let spaced = text
            .replace('/', " OR ")
            .replace('(', " ( ")
            .replace(')', " ) ");
        let words = spaced.split_whitespace().map(str::to_owned).collect();
        let mut licence = Self {
            words,
            at: 0,
            allowed,
        };
        licence.any() && licence.at == licence.words.len()
    }

    fn takes(&mut self, word: &str) -> bool {
        let is_next = self.words.get(self.at).is_some_and(|next| next == word);
        self.at += usize::from(is_next);
        is_next
    }

    fn any(&mut self) -> bool {
        let mut is_allowed = self.all();
        while self.takes("OR") {
            is_allowed |= self.all();
        }
        is_allowed
    }

    fn all(&mut self) -> bool {
        let mut is_allowed = self.one();
        while self.takes("AND") {
            is_allowed &= self.one();
        }
        is_allowed
    }

    fn one(&mut self) -> bool {
        if self.takes("(") {
            let is_allowed = self.any();
            return self.takes(")") && is_allowed;
        }
        let mut name = self.words.get(self.at).cloned().unwrap_or_default();
        self.at += 1;
        if self.takes("WITH") {
            name = format!("{name} WITH {}", self.words[self.at]);
            self.at += 1;
        }
        self.allowed.contains(&name)
    }
}

#[test]
fn every_dependency_may_be_given_on_under_our_licence() {
    let settings = read(".cargo-deny.toml");
    let allowed = settings["licenses"]["allow"].as_array().unwrap();
    let allowed = allowed
        .iter()
        .map(|name| name.as_str().unwrap().to_owned())
        .collect();
    for package in dependencies() {
        let licence = package["license"].as_str().unwrap_or("none");
        assert!(
            Licence::is_allowed(licence, &allowed),
            "{} {}: {licence}",
            package["name"],
            package["version"]
        );
    }
    for (licence, is_allowed) in [
        ("MIT/Apache-2.0", true),
        ("GPL-3.0-only", false),
        ("GPL-3.0-only OR MIT", true),
        ("(MIT OR Apache-2.0) AND GPL-3.0-only", false),
        ("GPL-3.0-only AND MIT OR ISC", true),
        ("Apache-2.0 WITH LLVM-exception", true),
        ("MIT WITH LLVM-exception", false),
        ("MIT)", false),
    ] {
        let found = Licence::is_allowed(licence, &allowed);
        assert_eq!(found, is_allowed, "{licence}");
    }
}

#[test]
fn every_dependency_comes_from_the_registry_with_its_checksum() {
    let lock = read("Cargo.lock");
    let mut locked = 0;
    for package in lock["package"].as_array().unwrap() {
        if package["name"].as_str() == Some("visod") {
            continue;
        }
        let name = &package["name"];
        let source = package.get("source").and_then(toml::Value::as_str);
        assert!(
            source.is_some_and(|source| source.starts_with("registry+")),
            "{name}: {source:?}"
        );
        assert!(package.get("checksum").is_some(), "{name}: no checksum");
        locked += 1;
    }
    assert!(locked > 100, "{locked}");
}

/// With the lints of clippy (`incompatible_msrv`), which see to the standard library, all that can be known of
/// an older compiler without one.
#[test]
fn no_dependency_wants_a_newer_rust_than_visod_says() {
    let parts = |version: &str| -> Vec<u32> {
        version
            .split('.')
            .map(|part| part.parse().unwrap())
            .collect()
    };
    let ours = read("Cargo.toml")["package"]["rust-version"]
        .as_str()
        .map(parts)
        .unwrap();
    let mut stated = 0;
    for package in dependencies() {
        if let Some(wanted) = package["rust_version"].as_str() {
            stated += 1;
            assert!(
                parts(wanted) <= [&ours[..], &[0]].concat(),
                "{} wants Rust {wanted}",
                package["name"]
            );
        }
    }
    assert!(stated > 100, "{stated}");
}
