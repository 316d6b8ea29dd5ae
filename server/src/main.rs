//! The server's command line.

#[cfg(target_os = "linux")]
mod load_command;
mod token_command;

use anyhow::{Context, ensure};
use clap::{Args, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use rhytid_server::{
    Access, Clip, Identity, Limits, SendOptions, SendReport, SendSource, ServerConfig, Timeouts, Tls, bind, load_character, run, send,
};
use rhytid_shared::trust::Trust;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;
use tracing_subscriber::EnvFilter;

/// Turns what a face tracker sees into a moving, wrinkled face and streams it to viewers.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    /// Say more: -v every connection and bad message, -vv also what libraries do.
    #[arg(short, long, action = clap::ArgAction::Count, global = true)]
    verbose: u8,
    /// Write the log as JSON, one object a line.
    #[arg(long, global = true)]
    log_json: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Serve rooms until SIGINT or SIGTERM.
    Serve(Box<ServeArgs>),
    /// Publish a feed file, or an animation clip of a character.
    Send(SendArgs),
    /// Make a token, or a key that signs tokens.
    Token(token_command::TokenArgs),
    /// Measure: a server on one core, its publishers and viewers on another.
    #[cfg(target_os = "linux")]
    Load(load_command::LoadArgs),
    /// What `load --baseline` measures against.
    #[cfg(target_os = "linux")]
    #[command(hide = true)]
    PlainServer,
}

#[derive(Args)]
struct ServeArgs {
    /// Address and port; port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:7878")]
    listen: String,
    /// The character's .glb instead of the built-in one.
    #[arg(long, value_name = "FILE.glb")]
    character: Option<PathBuf>,
    /// Settings; flags given besides win.
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    #[command(flatten)]
    limits: Limits,
    #[command(flatten)]
    timeouts: Timeouts,
    #[command(flatten)]
    access: Access,
    #[command(flatten)]
    tls: Tls,
}

#[derive(Args)]
struct SendArgs {
    /// The feed file.
    #[arg(value_name = "FEED.jsonl", required_unless_present = "clip", conflicts_with = "clip")]
    feed: Option<PathBuf>,
    /// An animation clip of the character instead of a feed file.
    #[arg(long, value_name = "NAME")]
    clip: Option<String>,
    /// The character that has the clip, instead of the built-in one.
    #[arg(long, value_name = "FILE.glb", requires = "clip")]
    character: Option<PathBuf>,
    /// The server.
    #[arg(long, default_value = "ws://127.0.0.1:7878", value_name = "URL")]
    to: String,
    /// The room.
    #[arg(long, default_value = "demo")]
    room: String,
    /// Feed seconds a second, or `max`: as fast as the server takes it.
    #[arg(long, default_value = "1.0", value_parser = parse_speed)]
    speed: f64,
    /// Send it again and again, each time as a new session.
    #[arg(long = "loop")]
    repeats: bool,
    /// Take the room over from another publisher.
    #[arg(long)]
    takeover: bool,
    /// How long the server may take to accept the connection, to answer the hello, and to read a message.
    #[arg(long, default_value = "15", value_name = "SECONDS", value_parser = parse_seconds)]
    timeout: Duration,
    /// Whom to trust on wss://: the fingerprint that `serve --tls-self-signed` printed, or a PEM file of authorities; else the
    /// public ones
    #[arg(long, value_name = "FINGERPRINT|FILE.pem", value_parser = parse_trust, default_value = "", hide_default_value = true)]
    trust: Trust,
    /// What lets it in, where the server wants to know; also from the environment's RHYTID_TOKEN. Others on this machine can read
    /// the arguments of a command.
    #[arg(long, conflicts_with = "token_file")]
    token: Option<String>,
    /// A file with the token.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

fn parse_trust(text: &str) -> Result<Trust, String> {
    if text.is_empty() { Ok(Trust::Public) } else { Trust::from_argument(text, |path| std::fs::read(path)) }
}

fn parse_speed(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        _ if text == "max" => Ok(f64::INFINITY),
        Ok(speed) if speed > 0.0 && speed.is_finite() => Ok(speed),
        _ => Err("expected a number more than 0, or max".into()),
    }
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.01..=86_400.0).contains(seconds));
    seconds.map(Duration::from_secs_f64).ok_or_else(|| "expected seconds from 0.01 to 86400".into())
}

#[tokio::main]
async fn main() -> ExitCode {
    let matches = <Cli as clap::CommandFactory>::command().get_matches();
    let cli = match <Cli as clap::FromArgMatches>::from_arg_matches(&matches) {
        Ok(cli) => cli,
        Err(error) => error.exit(),
    };
    start_log(&cli);
    let result = match cli.command {
        Command::Serve(args) => serve(*args, matches.subcommand_matches("serve")).await,
        Command::Send(args) => send_feed(args).await,
        Command::Token(args) => token_command::token(&args),
        #[cfg(target_os = "linux")]
        Command::Load(args) => load_command::load(args).await,
        #[cfg(target_os = "linux")]
        Command::PlainServer => load_command::plain_server().await,
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Logs go to standard error; `RUST_LOG` overrules `-v`.
fn start_log(cli: &Cli) {
    let level = match (cli.verbose, &cli.command) {
        (0, Command::Serve(_)) => "rhytid_server=info,warn",
        (0, _) => "warn",
        (1, _) => "rhytid_server=debug,info",
        _ => "debug",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    if cli.log_json {
        log.json().init();
    } else {
        log.init();
    }
}

async fn serve(args: ServeArgs, matches: Option<&clap::ArgMatches>) -> anyhow::Result<()> {
    let mut config = match &args.config {
        Some(path) => ServerConfig::from_file(path)?,
        None => ServerConfig::default(),
    };
    let is_given = |id: &str| matches.is_some_and(|matches| matches.value_source(id) == Some(clap::parser::ValueSource::CommandLine));
    macro_rules! take {
        ($($id:literal: $($part:ident).+),* $(,)?) => { $(if is_given($id) { config.$($part).+ = args.$($part).+; })* };
    }
    take! {
        "listen": listen,
        "max-rooms": limits.rooms,
        "max-viewers": limits.viewers_per_room,
        "max-message": limits.message_bytes,
        "max-fps": limits.frames_per_second,
        "max-bad-frames": limits.bad_frames_in_a_row,
        "max-connections-in-all": limits.connections,
        "max-connections": limits.connections_per_address,
        "max-connection-rate": limits.connections_per_second,
        "max-address-fps": limits.frames_per_second_per_address,
        "hello-timeout": timeouts.hello,
        "ping-interval": timeouts.ping,
        "publisher-timeout": timeouts.publisher_idle,
        "viewer-timeout": timeouts.viewer_idle,
        "write-timeout": timeouts.write,
        "room-timeout": timeouts.room_idle,
    }
    config.character = args.character.or(config.character);
    config.access.hosts.extend(args.access.hosts);
    config.access.origins.extend(args.access.origins);
    config.access.token_key = args.access.token_key.or(config.access.token_key);
    config.access.insecure |= args.access.insecure;
    // Given by flags it is whole, whatever the file says.
    if args.tls != Tls::default() {
        config.tls = args.tls;
    }
    config.validate()?;
    raise_file_limit();

    let mut interrupt = Signals::new().context("cannot wait for signals")?;
    // Before the port is bound: who sees the line below may connect, and a broken character must not leave a port behind.
    let character = load_character(config.character.as_deref())?;
    let listener = bind(&config.listen).await?;
    config.check_access(listener.local_addr()?)?;
    let identity = Identity::load(&config.tls, listener.local_addr()?, &config.access.hosts)?;
    let scheme = if identity.is_some() { "https" } else { "http" };
    let mut greeting = format!("listening on {scheme}://{}\n", listener.local_addr()?);
    if let Some(identity) = &identity {
        greeting += &format!("certificate SHA-256 {}\n", identity.fingerprint());
    }
    let mut output = std::io::stdout();
    if let Err(error) = output.write_all(greeting.as_bytes()).and_then(|()| output.flush()) {
        // Who closed it does not want to know; who connects is served all the same.
        tracing::warn!(%error, "cannot write to standard output");
    }
    run(listener, config, character, identity, async move { interrupt.wait().await }).await?;
    Ok(())
}

/// Every viewer is a file descriptor, and the usual soft limit is 1,024.
fn raise_file_limit() {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, getrlimit, setrlimit};
        let mut limit = getrlimit(Resource::Nofile);
        limit.current = limit.maximum;
        if let Err(error) = setrlimit(Resource::Nofile, limit) {
            tracing::warn!(%error, "cannot raise the limit of open files");
        }
    }
}

/// SIGINT and SIGTERM; Ctrl-C elsewhere.
struct Signals {
    #[cfg(unix)]
    interrupt: tokio::signal::unix::Signal,
    #[cfg(unix)]
    terminate: tokio::signal::unix::Signal,
}

impl Signals {
    #[cfg(unix)]
    fn new() -> std::io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    #[cfg(unix)]
    async fn wait(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }

    #[cfg(not(unix))]
    fn new() -> std::io::Result<Self> {
        Ok(Self {})
    }

    #[cfg(not(unix))]
    async fn wait(&mut self) {
        // Without a handler the system ends the process itself.
        let _ = tokio::signal::ctrl_c().await;
    }
}

async fn send_feed(args: SendArgs) -> anyhow::Result<()> {
    let source = match (args.feed, args.clip) {
        (Some(path), _) => SendSource::File(path),
        (None, clip) => {
            let name = clip.context("expected a feed file or --clip")?;
            let (character, glb) = load_character(args.character.as_deref())?;
            SendSource::Clip(Arc::new(Clip::open(&glb, &character, &name)?), format!("clip {name}"))
        }
    };
    let progress = ProgressBar::new(0);
    progress
        .set_style(ProgressStyle::with_template("{elapsed_precise} [{bar:40}] {percent:>3}% {bytes}/{total_bytes}")?.progress_chars("=> "));
    let options = SendOptions {
        source,
        to: args.to,
        room: args.room,
        speed: args.speed,
        repeats: args.repeats,
        takeover: args.takeover,
        timeout: args.timeout,
        trust: args.trust,
        token: token_command::given(args.token, args.token_file.as_deref())?,
    };
    let mut interrupt = Signals::new().context("cannot wait for signals")?;
    let report = send(&options, &progress, async move { interrupt.wait().await }).await;
    progress.finish_and_clear();
    let SendReport { frames, errors } = report?;
    ensure!(errors == 0, "sent {frames} frames, of all messages the server refused {errors}");
    eprintln!("sent {frames} frames, none refused");
    Ok(())
}
