//! The folder that the server serves: every file, what shrinks by gzip also compressed, and a list of all.

use anyhow::{Context, Result};
use flate2::{Compression, GzBuilder};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// The list, which the server's build reads: a line `SHA-256 bytes name` for each file. Written last and removed first, so
/// that half a bundle is none.
const LIST: &str = "bundle.txt";

/// Files by their name on the page.
#[derive(Debug, Default)]
pub struct Files(BTreeMap<String, Vec<u8>>);

impl Files {
    /// A file as it is.
    pub fn add(&mut self, path: PathBuf, name: &str) -> Result<()> {
        let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        self.0.insert(name.to_owned(), bytes);
        Ok(())
    }

    /// A text.
    pub fn add_text(&mut self, name: &str, text: &str) {
        self.0.insert(name.to_owned(), text.as_bytes().to_vec());
    }

    /// All files of a folder and of those in it, but for hidden ones.
    pub fn add_folder(&mut self, folder: &Path, before: &str) -> Result<()> {
        for entry in std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))? {
            let entry = entry?;
            let name = entry.file_name().into_string().ok().context("file names are UTF-8")?;
            if name.starts_with('.') {
                continue;
            }
            if entry.file_type()?.is_dir() {
                self.add_folder(&entry.path(), &format!("{before}{name}/"))?;
            } else {
                self.add(entry.path(), &format!("{before}{name}"))?;
            }
        }
        Ok(())
    }

    /// Makes `folder` hold these files and no others; gives names, bytes and compressed bytes. What is there already is not
    /// touched, so that the server is not built again for nothing.
    pub fn write(&self, folder: &Path) -> Result<Vec<(String, u64, u64)>> {
        let mut list = String::new();
        let mut bundled = Vec::new();
        let mut wanted = BTreeSet::from([folder.join(LIST)]);
        let is_known = std::fs::read_to_string(folder.join(LIST)).unwrap_or_default();
        let mut changes = Vec::new();
        for (name, bytes) in &self.0 {
            let line = format!("{} {} {name}\n", hex(&Sha256::digest(bytes)), bytes.len());
            let [path, gz] = [name.clone(), format!("{name}.gz")].map(|name| folder.join(name));
            if !is_known.contains(&line) || !path.is_file() {
                let mut encoder = GzBuilder::new().write(Vec::new(), Compression::best());
                encoder.write_all(bytes)?;
                let compressed = encoder.finish()?;
                // A twentieth at least, or it is not worth the name.
                let compressed = (compressed.len() < bytes.len() / 20 * 19).then_some(compressed);
                changes.push((path.clone(), gz.clone(), bytes, compressed));
            }
            list.push_str(&line);
            wanted.extend([path, gz]);
        }
        if list != is_known || !changes.is_empty() {
            // It may not be there.
            let _ = std::fs::remove_file(folder.join(LIST));
            for (path, gz, bytes, compressed) in changes {
                std::fs::create_dir_all(path.parent().context("a file stands in a folder")?)?;
                std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
                let _ = std::fs::remove_file(&gz);
                if let Some(compressed) = compressed {
                    std::fs::write(&gz, compressed)?;
                }
            }
            remove_others(folder, &wanted)?;
            std::fs::write(folder.join(LIST), &list)?;
        }
        for (name, bytes) in &self.0 {
            let len = bytes.len() as u64;
            let compressed = std::fs::metadata(folder.join(format!("{name}.gz"))).map_or(len, |gz| gz.len());
            bundled.push((name.clone(), len, compressed));
        }
        Ok(bundled)
    }
}

fn remove_others(folder: &Path, wanted: &BTreeSet<PathBuf>) -> Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            remove_others(&path, wanted)?;
        } else if !wanted.contains(&path) {
            std::fs::remove_file(path)?;
        }
    }
    Ok(())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bundle_is_written_once_and_follows_its_files() -> Result<()> {
        let folder = std::env::temp_dir().join(format!("rhytid-bundle-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        let mut files = Files::default();
        files.add_text("index.html", &"<p>again and again".repeat(50));
        files.add_text("sub/short.js", "1");
        let bundled = files.write(&folder)?;
        assert!(bundled[0].2 < bundled[0].1 / 4 && bundled[1] == ("sub/short.js".into(), 1, 1), "{bundled:?}");
        let changed = |name: &str| std::fs::metadata(folder.join(name)).and_then(|file| file.modified());
        let before = (changed(LIST)?, changed("index.html")?);
        assert_eq!(files.write(&folder)?, bundled);
        assert_eq!((changed(LIST)?, changed("index.html")?), before, "nothing is touched without need");
        files.0.remove("sub/short.js");
        files.write(&folder)?;
        assert!(!folder.join("sub/short.js").exists());
        let list = std::fs::read_to_string(folder.join(LIST))?;
        assert!(list.lines().count() == 1 && list.ends_with(" 900 index.html\n"), "{list}");
        Ok(std::fs::remove_dir_all(folder)?)
    }
}
