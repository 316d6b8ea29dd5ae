//! What the end-to-end tests share.

use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A program of the workspace, of the same profile as this test: as it stands, and built where it does not.
pub fn program(name: &str) -> Result<PathBuf> {
    let test = std::env::current_exe()?;
    // target/PROFILE/deps/test
    let folder = test.parent().and_then(Path::parent).context("the test stands in the build's folder")?;
    let path = folder.join(name).with_extension(std::env::consts::EXE_EXTENSION);
    if !path.is_file() {
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let mut build = Command::new(cargo);
        build.current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).args(["build", "-p", name, "--bin", name]);
        if folder.ends_with("release") {
            build.arg("--release");
        }
        ensure!(build.status()?.success(), "cannot build {name}");
    }
    Ok(path)
}
