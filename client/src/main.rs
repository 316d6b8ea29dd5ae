//! `rhytid-client`: the window, and pictures without one.

use clap::{Parser, Subcommand};
use rhytid_client::render_cli::{self, RenderArgs, StillArgs};
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
    /// Draw a feed file to PNG frames
    Render(RenderArgs),
    /// Draw one picture of a pose
    Still(StillArgs),
}

fn main() -> anyhow::Result<()> {
    let cli = Cli::parse();
    let level = ["warn", "rhytid=info", "rhytid=debug"][usize::from(cli.verbose.min(2))];
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    match cli.command {
        Command::Render(args) => {
            let num_pictures = render_cli::render(&args)?;
            println!("{num_pictures} pictures in {}", args.out.display());
        }
        Command::Still(args) => render_cli::still(&args)?,
    }
    Ok(())
}
