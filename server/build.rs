//! Takes the page in the browser (`cargo xtask web`) into the server, where it has been built. Without it the server is whole,
//! too: its page only lists the rooms.

use std::error::Error;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-env-changed=CARGO_TARGET_DIR");
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().ok_or("the server stands inside the workspace")?;
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| workspace.join("target"), |target| workspace.join(target));
    let folder = target.join("web");
    // A folder that is not there would count as changed at every build.
    if std::fs::create_dir_all(&folder).is_ok() {
        println!("cargo::rerun-if-changed={}", folder.display());
    }
    let table = match table(&folder) {
        Ok(table) => table,
        Err(error) => {
            println!("cargo::warning=the page in the browser is left out: {error}");
            String::new()
        }
    };
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    Ok(std::fs::write(out.join("files.rs"), format!("&[{table}]"))?)
}

/// An entry for each file of the bundle's list; none where there is no bundle.
fn table(folder: &Path) -> Result<String, Box<dyn Error>> {
    let Ok(list) = std::fs::read_to_string(folder.join("bundle.txt")) else { return Ok(String::new()) };
    let mut table = String::new();
    for line in list.lines() {
        let (sha256, rest) = line.split_once(' ').ok_or("bundle.txt is damaged")?;
        let (bytes, name) = rest.split_once(' ').ok_or("bundle.txt is damaged")?;
        let plain = folder.join(name);
        let got = std::fs::metadata(&plain).map_err(|error| format!("{}: {error}", plain.display()))?.len();
        if got != bytes.parse::<u64>()? {
            return Err(format!("{} has {got} bytes, bundle.txt says {bytes}", plain.display()).into());
        }
        let compressed = folder.join(format!("{name}.gz"));
        let is_compressed = compressed.is_file();
        let path = if is_compressed { compressed } else { plain };
        write!(
            table,
            "File {{ name: {name:?}, tag: {:?}, is_compressed: {is_compressed}, bytes: include_bytes!({:?}) }},",
            format!("\"{sha256}\""),
            path.to_str().ok_or("the project's path is UTF-8")?
        )?;
    }
    Ok(table)
}
