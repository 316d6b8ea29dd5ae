//! The papers' figures, drawn again by the client.

use crate::{demo::target_dir, setup, workspace_root};
use anyhow::{Context, Result, ensure};
use std::process::Command;

/// Builds the client and lets it draw; `arguments` are passed on to it.
pub fn run(arguments: &[String]) -> Result<()> {
    setup::run()?;
    let root = workspace_root();
    let status = Command::new(env!("CARGO"))
        .current_dir(&root)
        .args(["build", "--release", "-p", "rhytid-client"])
        .status()
        .context("cannot run cargo")?;
    ensure!(status.success(), "the build failed ({status})");
    let client = target_dir(&root).join("release/rhytid-client");
    let mut gallery = Command::new(client);
    // Its default paths are those of the project.
    gallery.current_dir(&root).arg("gallery").args(arguments);
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // Without it the software Vulkan driver prints two lines that look like errors and are none.
        gallery.env("XDG_RUNTIME_DIR", std::env::temp_dir());
    }
    let status = gallery.status().context("cannot run rhytid-client")?;
    ensure!(status.success(), "the gallery failed ({status})");
    Ok(())
}
