//! Who compiles to WebAssembly here: rustup's target, or Debian's own toolchain with its standard library's source.

use crate::setup::{self, is_on_path};
use anyhow::{Result, bail};
use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The target.
pub const TARGET: &str = "wasm32-unknown-unknown";
/// What Debian's way needs.
const DEBIAN_PACKAGES: [&str; 4] = ["rustc-web", "cargo-web", "rust-web-src", "lld"];

/// What compiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Toolchain {
    /// The one that builds everything else has the target.
    Own,
    /// Debian's compiler builds the standard library, too.
    Debian,
}

impl Toolchain {
    /// Finds one; fetches the target or Debian's packages where that is allowed.
    pub fn find() -> Result<Self> {
        if has_target() {
            return Ok(Self::Own);
        }
        if setup::may_install() && is_on_path("rustup") {
            println!("web: fetching the compiler's target {TARGET} (rustup)");
            let status = Command::new("rustup").args(["target", "add", TARGET]).stdin(Stdio::null()).stderr(Stdio::null()).status();
            if status.is_ok_and(|status| status.success()) && has_target() {
                return Ok(Self::Own);
            }
        }
        if !has_debian() && setup::may_install_packages() {
            setup::install(&DEBIAN_PACKAGES)?;
        }
        if has_debian() {
            return Ok(Self::Debian);
        }
        bail!(
            "nothing here compiles to WebAssembly; get it with `rustup target add {TARGET}` or, on Debian, `sudo apt-get install \
             --no-install-recommends {}`",
            DEBIAN_PACKAGES.join(" ")
        )
    }

    /// Its cargo.
    pub fn cargo(self) -> Command {
        match self {
            Self::Own => Command::new(env!("CARGO")),
            Self::Debian => {
                let mut cargo = Command::new("/usr/bin/cargo");
                let path = std::env::var_os("PATH").unwrap_or_default();
                let path = std::iter::once(PathBuf::from("/usr/bin")).chain(std::env::split_paths(&path));
                if let Ok(path) = std::env::join_paths(path) {
                    cargo.env("PATH", path);
                }
                cargo
                    .env("RUSTC", "/usr/bin/rustc")
                    .env_remove("RUSTC_WRAPPER")
                    .env_remove("RUSTUP_TOOLCHAIN")
                    // Building the standard library is not stable, and this compiler is released with its source.
                    .env("RUSTC_BOOTSTRAP", "1")
                    .env("CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_LINKER", "wasm-ld")
                    .env("CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_RUSTFLAGS", "-Clinker-flavor=wasm-ld");
                cargo
            }
        }
    }

    /// What its cargo is told besides.
    pub fn build_std(self) -> &'static [&'static str] {
        match self {
            Self::Own => &[],
            Self::Debian => &["-Zbuild-std=std,panic_abort"],
        }
    }
}

impl fmt::Display for Toolchain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Own => "rustup's target",
            Self::Debian => "Debian's toolchain",
        })
    }
}

/// A wasm-opt that knows tables of references: what older ones (Debian 12 has 108) write of them no browser starts.
pub fn has_optimiser() -> bool {
    const OLDEST: u32 = 116;
    let Ok(output) = Command::new("wasm-opt").arg("--version").output() else { return false };
    let said = String::from_utf8_lossy(&output.stdout);
    let version = said.split_whitespace().find_map(|word| word.parse::<u32>().ok());
    version.is_some_and(|version| version >= OLDEST)
}

fn sysroot(rustc: &str) -> Option<PathBuf> {
    let output = Command::new(rustc).args(["--print", "sysroot"]).output().ok()?;
    output.status.success().then(|| PathBuf::from(String::from_utf8_lossy(&output.stdout).trim()))
}

fn has_target() -> bool {
    sysroot("rustc").is_some_and(|root| root.join("lib/rustlib").join(TARGET).join("lib").is_dir())
}

fn has_debian() -> bool {
    Path::new("/usr/bin/cargo").is_file()
        && is_on_path("wasm-ld")
        && sysroot("/usr/bin/rustc").is_some_and(|root| root.join("lib/rustlib/src/rust/library/std/Cargo.toml").is_file())
}
