//! `rhytid-client`: the window, and pictures without one.

use anyhow::anyhow;
use clap::{Parser, Subcommand};
use rhytid_client::film::{self, FilmArgs};
#[cfg(feature = "embedded")]
use rhytid_client::gallery::{self, GalleryArgs};
#[cfg(feature = "embedded")]
use rhytid_client::render_cli::{self, RenderArgs, StillArgs};
use rhytid_client::view::{self, ViewArgs};
use std::io::IsTerminal;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tracing_subscriber::EnvFilter;

#[derive(Parser)]
#[command(version, about = "Draws the wrinkled face of a Rhytid server")]
struct Cli {
    /// More log lines; twice for even more
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Show a room's face live in a window
    View(ViewArgs),
    /// Record a room's live face without a window: an animated picture and a contact sheet
    Film(FilmArgs),
    /// Draw a feed file to PNG frames
    #[cfg(feature = "embedded")]
    Render(RenderArgs),
    /// Draw one picture of a pose
    #[cfg(feature = "embedded")]
    Still(StillArgs),
    /// Draw the figures of the papers again: sheets of pictures and a page that shows them all
    #[cfg(feature = "embedded")]
    Gallery(GalleryArgs),
}

fn main() -> ExitCode {
    match run(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // One line; every error here says its cause in its own words.
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(cli: Cli) -> anyhow::Result<()> {
    // What a driver says of a failure the program tells in its own words.
    let level =
        ["error,wgpu_hal::vulkan::instance=off,rhytid=warn", "warn,rhytid=info", "warn,rhytid=debug"][usize::from(cli.verbose.min(2))];
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(std::io::stderr().is_terminal()).init();
    match cli.command {
        Command::View(args) => view::run(args)?,
        Command::Film(args) => {
            let is_stopped = Arc::new(AtomicBool::new(false));
            let flag = Arc::clone(&is_stopped);
            ctrlc::set_handler(move || flag.store(true, Ordering::SeqCst)).map_err(|error| anyhow!("cannot listen for Ctrl-C: {error}"))?;
            let film = film::run(&args, &is_stopped)?;
            println!("{} pictures in {:.1} s", film.num_pictures, film.length.as_secs_f64());
            println!("{}", film.animation.display());
            println!("{}", film.contact_sheet.display());
        }
        #[cfg(feature = "embedded")]
        Command::Render(args) => {
            let num_pictures = render_cli::render(&args)?;
            for place in [&args.out, &args.mp4].into_iter().flatten() {
                println!("{num_pictures} pictures in {}", place.display());
            }
        }
        #[cfg(feature = "embedded")]
        Command::Still(args) => render_cli::still(&args)?,
        #[cfg(feature = "embedded")]
        Command::Gallery(args) => println!("{}", gallery::run(&args)?.display()),
    }
    Ok(())
}
