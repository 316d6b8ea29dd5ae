//! Packages of npm, in `target/npm`: nothing of them is part of the project.

use crate::setup;
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Drives the browser in tests: name and version.
pub const PLAYWRIGHT: (&str, &str) = ("playwright-core", "1.65.1");

/// The folder of a package in exactly this version; fetched where it is not there and may be.
pub fn package(target: &Path, name: &str, version: &str) -> Result<PathBuf> {
    let home = target.join("npm");
    let folder = home.join("node_modules").join(name);
    if has_version(&folder, version) {
        return Ok(folder);
    }
    ensure!(setup::is_on_path("npm"), "npm is missing, which fetches {name}");
    ensure!(setup::may_install(), "{name} is missing and RHYTID_NO_INSTALL forbids to fetch it");
    println!("set-up: fetching {name} {version} (npm)");
    std::fs::create_dir_all(&home)?;
    let output = Command::new("npm")
        .args(["install", "--no-audit", "--no-fund", "--no-save", "--ignore-scripts", "--prefix"])
        .arg(&home)
        // What stands here already stays only where it is named, too.
        .args(others(&home, name))
        .arg(format!("{name}@{version}"))
        .stdin(Stdio::null())
        .output()
        .context("cannot run npm")?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "npm does not fetch {name}: {}", said.lines().next().unwrap_or_default());
    ensure!(has_version(&folder, version), "npm brought another version of {name} than {version}");
    Ok(folder)
}

/// Rhytid's other packages that are there, with their versions.
fn others(home: &Path, name: &str) -> Vec<String> {
    [PLAYWRIGHT, crate::web::TRACKER]
        .into_iter()
        .filter(|(other, version)| *other != name && has_version(&home.join("node_modules").join(other), version))
        .map(|(other, version)| format!("{other}@{version}"))
        .collect()
}

fn has_version(folder: &Path, version: &str) -> bool {
    let Ok(text) = std::fs::read(folder.join("package.json")) else { return false };
    serde_json::from_slice::<serde_json::Value>(&text).is_ok_and(|package| package["version"] == version)
}
