//! What the project is built from, against the lists of `.ci/deny.toml`: its licences, its sources, and what must not be among it.
//! `cargo deny` checks the same and advisories besides (see `.ci/run`); this needs nothing but what a build has fetched.

use serde_json::Value;
use spdx::{Expression, ParseMode};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Lists of `.ci/deny.toml` that hold text.
struct Lists(toml::Table);

impl Lists {
    fn read() -> Self {
        let text = std::fs::read_to_string(root().join(".ci/deny.toml")).expect("the lists are there");
        Self(text.parse().expect("the lists are TOML"))
    }

    /// A list of strings, or of tables with a `name`.
    fn list(&self, part: &str, name: &str) -> Vec<&str> {
        let entries = self.0[part][name].as_array().expect("it is a list");
        entries.iter().map(|entry| entry.get("name").unwrap_or(entry).as_str().expect("entries are text")).collect()
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("it stands in the workspace").to_owned()
}

/// What Cargo knows of all packages: of every platform where all of them have been fetched, else of this one.
fn packages() -> Vec<Value> {
    let host = Command::new(env!("CARGO")).args(["-vV"]).output().expect("cargo runs").stdout;
    let host = String::from_utf8(host).expect("cargo says text");
    let host = host.lines().find_map(|line| line.strip_prefix("host: ")).expect("cargo says its host").to_owned();
    let metadata = |more: &[&str]| {
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["metadata", "--format-version", "1", "--locked", "--offline"]).args(more).current_dir(root());
        let output = cargo.output().expect("cargo runs");
        output.status.success().then_some(output.stdout).ok_or_else(|| String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let text = metadata(&["--all-features"]).or_else(|_| metadata(&["--filter-platform", &host])).expect("what was built is known");
    let mut metadata: Value = serde_json::from_slice(&text).expect("cargo says JSON");
    let Value::Array(packages) = metadata["packages"].take() else { panic!("packages are a list") };
    packages
}

fn is_allowed(licence: &str, allowed: &[&str]) -> bool {
    // Old manifests have a slash for "or".
    let expression = Expression::parse_mode(licence, ParseMode::LAX);
    expression.is_ok_and(|expression| expression.evaluate(|requirement| allowed.contains(&requirement.to_string().as_str())))
}

#[test]
fn everything_may_be_given_away_under_the_projects_own_licences() {
    let lists = Lists::read();
    let allowed = lists.list("licenses", "allow");
    let packages = packages();
    // Those of the workspace have no source.
    let foreign: Vec<&Value> = packages.iter().filter(|package| !package["source"].is_null()).collect();
    assert!(foreign.len() > 200, "only {} packages: something is not seen", foreign.len());
    for package in foreign {
        let licence = package["license"].as_str().unwrap_or_default();
        assert!(
            is_allowed(licence, &allowed),
            "{} {} is under {licence:?}, which .ci/deny.toml does not list",
            package["name"],
            package["version"]
        );
    }
}

#[test]
fn licences_that_are_not_listed_are_found() {
    let allowed = ["MIT", "Apache-2.0", "Apache-2.0 WITH LLVM-exception"];
    for good in ["MIT", "MIT/Apache-2.0", "GPL-3.0 OR MIT", "MIT AND Apache-2.0", "Apache-2.0 WITH LLVM-exception OR GPL-2.0-only"] {
        assert!(is_allowed(good, &allowed), "{good}");
    }
    for bad in ["", "GPL-3.0-only", "MIT AND GPL-3.0-only", "GPL-2.0 WITH Classpath-exception-2.0", "Mine"] {
        assert!(!is_allowed(bad, &allowed), "{bad}");
    }
}

#[test]
fn nothing_comes_from_elsewhere_and_nothing_banned_is_in() {
    let lists = Lists::read();
    let sources: Vec<String> = lists.list("sources", "allow-registry").iter().map(|url| format!("registry+{url}")).collect();
    let banned = lists.list("bans", "deny");
    assert!(!sources.is_empty() && banned.contains(&"rsa"));
    // The lock file is of every platform.
    let lock: toml::Table = std::fs::read_to_string(root().join("Cargo.lock")).expect("there is a lock file").parse().expect("it is TOML");
    let locked = lock["package"].as_array().expect("it lists packages");
    assert!(locked.len() > 200);
    for package in locked {
        let name = package["name"].as_str().expect("packages have names");
        assert!(!banned.contains(&name), "{name} is banned by .ci/deny.toml");
        if let Some(source) = package.get("source") {
            assert!(sources.iter().any(|allowed| Some(allowed.as_str()) == source.as_str()), "{name} comes from {source}");
        }
    }
}
