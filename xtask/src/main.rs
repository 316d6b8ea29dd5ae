//! Developer commands: `cargo xtask demo | test | web | setup | bake | convert | gallery`.

mod bake;
mod convert;
mod demo;
mod gallery;
mod npm;
mod setup;
mod web;

use anyhow::{Context, Result, ensure};
use clap::{Parser, Subcommand};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

#[derive(Parser)]
#[command(about = "Rhytid's developer commands")]
struct Arguments {
    #[command(subcommand)]
    command: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Set up, build, and show the main job: a recorded tracker session drives a wrinkled face, live
    Demo,
    /// Set up and run every test
    Test {
        /// Passed on to `cargo test`
        #[arg(trailing_var_arg = true)]
        arguments: Vec<String>,
    },
    /// Compile the client to WebAssembly and put the page in the browser together, in target/web
    Web,
    /// Find out what this machine lacks and install it where that is possible (`RHYTID_NO_INSTALL=1` forbids it)
    Setup,
    /// Make the default character, shared/assets/default.glb, from its CC0 sources
    Bake,
    /// Turn a normal map into partial derivatives or differences and back, and say what that lost
    Convert(convert::Conversion),
    /// Draw the figures of the papers again, into target/gallery
    Gallery {
        /// Passed on to `rhytid-client gallery`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Task::Demo => demo::run(),
        Task::Test { arguments } => test(&arguments),
        Task::Web => web::run(),
        Task::Setup => setup::run(),
        Task::Bake => bake::run(),
        Task::Convert(conversion) => convert::run(&conversion),
        Task::Gallery { arguments } => gallery::run(&arguments),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn test(arguments: &[String]) -> Result<()> {
    setup::run()?;
    web::run_where_possible();
    let status = Command::new(env!("CARGO"))
        .current_dir(workspace_root())
        .args(["test", "--workspace"])
        .args(arguments)
        .status()
        .context("cannot run cargo")?;
    ensure!(status.success(), "tests failed ({status})");
    Ok(())
}

/// The project's folder.
fn workspace_root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask stands inside the workspace").to_owned()
}
