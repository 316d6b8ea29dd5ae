//! Finds out what this machine lacks, installs it where that is possible and allowed, and says what stays missing.

use crate::demo::target_dir;
use crate::{npm, workspace_root};
use anyhow::Result;
use std::path::Path;
use std::process::{Command, Stdio};

/// Something outside Cargo that Rhytid uses.
struct Need {
    /// What it is for, as people would say it.
    what: &'static str,
    /// Debian's packages that bring it.
    packages: &'static [&'static str],
    /// Is it here?
    is_here: fn() -> bool,
    /// What goes without it.
    without: &'static str,
}

const NEEDS: [Need; 8] = [
    Need {
        what: "a Vulkan driver",
        packages: &["libvulkan1", "mesa-vulkan-drivers"],
        is_here: has_vulkan,
        without: "nothing can be drawn; the server and its tests work",
    },
    Need {
        what: "X11 client libraries for the window",
        packages: &["libxkbcommon-x11-0", "libxcursor1", "libxi6", "libxrandr2", "libx11-xcb1"],
        is_here: has_x11_libraries,
        without: "no window opens under X11; rendering to files works",
    },
    Need {
        what: "Xvfb, a display for the window's test",
        packages: &["xvfb", "xauth"],
        is_here: || is_on_path("Xvfb") && is_on_path("xvfb-run"),
        without: "the window's test shows as ignored",
    },
    Need {
        what: "SPIR-V tools, which count a shader's instructions",
        packages: &["spirv-tools"],
        is_here: || is_on_path("spirv-opt"),
        without: "the test of the shaders' cost shows as ignored",
    },
    Need {
        what: "NATS, through which nodes of a cluster meet",
        packages: &["nats-server"],
        // Debian puts it where only root's path leads.
        is_here: || is_on_path("nats-server") || Path::new("/usr/sbin/nats-server").is_file(),
        without: "the tests of clusters show as ignored; one server alone needs none",
    },
    Need {
        what: "Node.js and npm, which fetch the page's face tracker and run its tests",
        packages: &["nodejs", "npm"],
        is_here: || is_on_path("node") && is_on_path("npm"),
        without: "the page in the browser has no camera, and its tests show as ignored",
    },
    Need {
        what: "Chromium, for the tests of the page in the browser",
        packages: &["chromium"],
        is_here: has_chromium,
        without: "the page's tests show as ignored",
    },
    Need {
        what: "ffmpeg, which makes the film for the tests of the page's camera",
        packages: &["ffmpeg"],
        is_here: || is_on_path("ffmpeg"),
        without: "the tests of the page's camera show as ignored",
    },
];

/// Checks everything and installs what it may. Says what it did; a machine that stays without something is no error.
pub fn run() -> Result<()> {
    if !cfg!(target_os = "linux") {
        println!("set-up: nothing to install on this system; the graphics driver and the display are its own");
        return Ok(());
    }
    let missing: Vec<&Need> = NEEDS.iter().filter(|need| !(need.is_here)()).collect();
    if missing.is_empty() {
        fetch_driver();
        println!("set-up: everything is here");
        return Ok(());
    }
    let packages: Vec<&str> = missing.iter().flat_map(|need| need.packages.iter().copied()).collect();
    for need in &missing {
        println!("set-up: {} is missing", need.what);
    }
    if may_install_packages()
        && let Err(error) = install(&packages)
    {
        println!("set-up: {error}");
    }
    fetch_driver();
    let missing: Vec<&Need> = missing.into_iter().filter(|need| !(need.is_here)()).collect();
    for need in &missing {
        println!("set-up: still without {}: {}", need.what, need.without);
    }
    if !missing.is_empty() {
        println!("set-up: to get all of it: {}", command_for(&missing));
    }
    Ok(())
}

/// What drives Chromium in tests comes from npm, and what they show to its camera. Without it they show as ignored.
fn fetch_driver() {
    if !is_on_path("npm") || !has_chromium() {
        return;
    }
    let target = target_dir(&workspace_root());
    for (name, version) in [npm::PLAYWRIGHT, npm::QR_READER] {
        if let Err(error) = npm::package(&target, name, version) {
            println!("set-up: without {name}, so tests of the page show as ignored: {error:#}");
        }
    }
    if let Err(error) = npm::face_film(&target) {
        println!("set-up: without a film of a face, so the tests of the page's camera show as ignored: {error:#}");
    }
}

/// The one command that installs all that is missing.
fn command_for(missing: &[&Need]) -> String {
    let packages: Vec<&str> = missing.iter().flat_map(|need| need.packages.iter().copied()).collect();
    format!("sudo apt-get install --no-install-recommends {}", packages.join(" "))
}

/// A display a window can open on.
pub fn has_display() -> bool {
    let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    !cfg!(target_os = "linux") || is_set("WAYLAND_DISPLAY") || is_set("DISPLAY")
}

/// Nothing is fetched where `RHYTID_NO_INSTALL=1` is set.
pub fn may_install() -> bool {
    std::env::var_os("RHYTID_NO_INSTALL").is_none_or(|value| value != "1")
}

/// Packages of the system can be installed.
pub fn may_install_packages() -> bool {
    may_install() && is_root() && is_on_path("apt-get")
}

/// Installs Debian's packages.
pub fn install(packages: &[&str]) -> Result<()> {
    // Another apt may be at work on a machine that has just been started: wait for it rather than fail.
    const LOCK: &str = "DPkg::Lock::Timeout=300";
    println!("set-up: installing {} (apt-get)", packages.join(" "));
    for arguments in [vec!["update", "-q"], [vec!["install", "-y", "-q", "--no-install-recommends"], packages.to_vec()].concat()] {
        let status = Command::new("apt-get")
            .args(["-o", LOCK])
            .args(&arguments)
            .env("DEBIAN_FRONTEND", "noninteractive")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .status()?;
        anyhow::ensure!(status.success(), "apt-get {} failed ({status})", arguments[0]);
    }
    Ok(())
}

fn is_root() -> bool {
    Command::new("id").arg("-u").output().is_ok_and(|output| output.stdout.trim_ascii() == b"0")
}

/// Whether the shell would find a program.
pub fn is_on_path(program: &str) -> bool {
    let Some(path) = std::env::var_os("PATH") else { return false };
    std::env::split_paths(&path).any(|folder| folder.join(program).is_file())
}

fn has_chromium() -> bool {
    std::env::var_os("RHYTID_CHROMIUM").is_some() || is_on_path("chromium")
}

fn has_vulkan() -> bool {
    let has_driver = std::env::var_os("VK_ICD_FILENAMES").is_some()
        || std::env::var_os("VK_DRIVER_FILES").is_some()
        || ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d"]
            .iter()
            .any(|folder| Path::new(folder).read_dir().is_ok_and(|mut entries| entries.next().is_some()));
    has_driver && has_library("libvulkan.so.1")
}

fn has_x11_libraries() -> bool {
    ["libxkbcommon-x11.so.0", "libXcursor.so.1", "libXi.so.6", "libXrandr.so.2", "libX11-xcb.so.1"].into_iter().all(has_library)
}

fn has_library(name: &str) -> bool {
    // ldconfig stands in /sbin, which is not on everybody's path.
    ["ldconfig", "/sbin/ldconfig", "/usr/sbin/ldconfig"]
        .iter()
        .find_map(|program| Command::new(program).arg("-p").output().ok())
        .is_some_and(|output| String::from_utf8_lossy(&output.stdout).lines().any(|line| line.trim_start().starts_with(name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_command_installs_all_that_is_missing() {
        let [driver, _, display, ..] = &NEEDS;
        assert_eq!(
            command_for(&[driver, display]),
            "sudo apt-get install --no-install-recommends libvulkan1 mesa-vulkan-drivers xvfb xauth"
        );
    }
}
