//! The browser's client: the client crate compiled to WebAssembly, with the page around it, in `target/web`. The server takes
//! that folder into its binary when it is built next.

mod bundle;
mod tools;

use crate::demo::target_dir;
use crate::{npm, workspace_root};
use anyhow::{Context, Result, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
use tools::Toolchain;

/// Name of the module: `rhytid_client.js` and `rhytid_client_bg.wasm`.
const MODULE: &str = "rhytid_client";
/// The face tracker of the page's camera, Apache-2.0, with its models. This version runs without the network.
pub const TRACKER: (&str, &str) = ("@mediapipe/face_mesh", "0.4.1657299874");
/// What the tracker loads; the rest is for browsers without SIMD, which have no WebGPU or WebGL2 worth the name either.
const TRACKER_FILES: [&str; 6] = [
    "face_mesh.js",
    "face_mesh.binarypb",
    "face_mesh_solution_packed_assets.data",
    "face_mesh_solution_packed_assets_loader.js",
    "face_mesh_solution_simd_wasm_bin.js",
    "face_mesh_solution_simd_wasm_bin.wasm",
];
/// Most the module may take compressed: 3 MB.
const MOST_COMPRESSED: u64 = 3_000_000;

/// Builds the bundle.
pub fn run() -> Result<()> {
    let root = workspace_root();
    let target = target_dir(&root);
    let toolchain = Toolchain::find()?;
    println!("web: compiling the client to WebAssembly with {toolchain} (the first time takes some minutes)");
    let module = compile(&root, &target.join("wasm"), &toolchain)?;
    let bound = target.join("wasm/bound");
    bind(&module, &bound)?;

    let mut files = bundle::Files::default();
    files.add_folder(&root.join("client/web"), "")?;
    for name in [format!("{MODULE}.js"), format!("{MODULE}_bg.wasm")] {
        files.add(bound.join(&name), &name)?;
    }
    match npm::package(&target, TRACKER.0, TRACKER.1) {
        Ok(folder) => {
            for name in TRACKER_FILES {
                files.add(folder.join(name), &format!("face_mesh/{name}"))?;
            }
            files.add_text(
                "face_mesh/LICENCE.txt",
                &format!(
                    "{} {} of npm, (c) The MediaPipe Authors, Apache-2.0: https://www.apache.org/licenses/LICENSE-2.0\n",
                    TRACKER.0, TRACKER.1
                ),
            );
        }
        Err(error) => println!("web: without the face tracker, so the page's camera stays off: {error:#}"),
    }
    let bundled = with_spinner("web: compressing the page", || files.write(&target.join("web")))?;
    for (name, raw, compressed) in &bundled {
        if name.ends_with(".wasm") {
            println!("web: {name} {raw} bytes, {compressed} with gzip");
        }
    }
    let (_, _, compressed) =
        bundled.iter().find(|(name, ..)| *name == format!("{MODULE}_bg.wasm")).context("the module is in the bundle")?;
    ensure!(*compressed <= MOST_COMPRESSED, "the module takes {compressed} bytes compressed, more than the {MOST_COMPRESSED} it may");
    println!(
        "web: {} files, {} bytes with gzip, in {}",
        bundled.len(),
        bundled.iter().map(|(_, _, compressed)| compressed).sum::<u64>(),
        target.join("web").display()
    );
    Ok(())
}

/// Builds the bundle where that is possible; says why not elsewhere. The server then shows its list of rooms only.
pub fn run_where_possible() {
    if let Err(error) = run() {
        println!("web: no page in the browser: {error:#}");
    }
}

/// Compiles the client; gives the module as the compiler leaves it.
fn compile(root: &Path, target: &Path, toolchain: &Toolchain) -> Result<PathBuf> {
    let status = toolchain
        .cargo()
        .current_dir(root)
        // Only here a dynamic library: natively nobody wants one.
        .args(["rustc", "--profile", "web", "-p", "rhytid-client", "--lib", "--no-default-features", "--crate-type", "cdylib"])
        .args(["--target", tools::TARGET, "--target-dir"])
        .arg(target)
        .args(toolchain.build_std())
        .status()
        .context("cannot run cargo")?;
    ensure!(status.success(), "the client does not compile to WebAssembly ({status})");
    let module = target.join(tools::TARGET).join("web").join(format!("{MODULE}.wasm"));
    ensure!(module.is_file(), "cargo left no {}", module.display());
    Ok(module)
}

/// Writes JavaScript for the module and makes it smaller. Does nothing where the module is that of the last time.
fn bind(module: &Path, bound: &Path) -> Result<()> {
    let has_optimiser = tools::has_optimiser();
    let stamp = format!("{:x?} {} {has_optimiser}", Sha256::digest(std::fs::read(module)?), env!("CARGO_PKG_VERSION"));
    let stamp_file = bound.join("made-from");
    if std::fs::read_to_string(&stamp_file).is_ok_and(|made_from| made_from == stamp) {
        return Ok(());
    }
    // It may not be there.
    let _ = std::fs::remove_dir_all(bound);
    std::fs::create_dir_all(bound)?;
    with_spinner("web: writing the module's JavaScript", || {
        wasm_bindgen_cli_support::Bindgen::new()
            .input_path(module)
            .web(true)?
            .omit_default_module_path(false)
            .typescript(false)
            .remove_name_section(true)
            .remove_producers_section(true)
            .generate(bound)
            .context("wasm-bindgen fails")
    })?;
    if has_optimiser {
        let wasm = bound.join(format!("{MODULE}_bg.wasm"));
        if let Err(error) = with_spinner("web: making the module smaller with wasm-opt", || optimise(&wasm)) {
            println!("web: {error:#}; the module stays as it is");
        }
    }
    Ok(std::fs::write(stamp_file, stamp)?)
}

fn optimise(wasm: &Path) -> Result<()> {
    let smaller = wasm.with_extension("smaller");
    let output = Command::new("wasm-opt")
        .arg("-Os")
        // What rustc's own target has; every browser with WebGL2 has it since 2022.
        .args(["--enable-bulk-memory", "--enable-mutable-globals", "--enable-nontrapping-float-to-int"])
        .args(["--enable-sign-ext", "--enable-reference-types", "--enable-multivalue"])
        .arg(wasm)
        .arg("-o")
        .arg(&smaller)
        .stdin(Stdio::null())
        .output()?;
    if !output.status.success() {
        bail!("wasm-opt fails: {}", String::from_utf8_lossy(&output.stderr).lines().next().unwrap_or_default());
    }
    Ok(std::fs::rename(smaller, wasm)?)
}

/// Shows that something goes on while `work` does it.
fn with_spinner<T>(what: &'static str, work: impl FnOnce() -> Result<T>) -> Result<T> {
    let style = ProgressStyle::with_template("{msg} {spinner} {elapsed}").expect("the template is right");
    let spinner = ProgressBar::new_spinner().with_style(style).with_message(what);
    if spinner.is_hidden() {
        println!("{what}");
    }
    spinner.enable_steady_tick(Duration::from_millis(100));
    let result = work();
    spinner.finish_and_clear();
    result
}
