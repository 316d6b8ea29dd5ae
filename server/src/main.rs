//! The server's command line: `serve`, `send`, `fit`, `fake`, `token`, `load`, and what works on recordings.

#[cfg(target_os = "linux")]
mod load_command;
mod record_command;
mod token_command;

use anyhow::{Context, ensure};
use clap::{Args, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use rhytid_server::recording::RecordConfig;
use rhytid_server::{
    Access, Clip, ClusterConfig, FakeKind, FakeOptions, Guide, Identity, Limits, ListenSpec, LiveFit, SendOptions, SendReport, SendSource,
    ServerConfig, StepAt, Timeouts, Tls, VmcOutSpec, bind, fake, fit_feed, fit_live, load_character, run, send, write_profile,
};
use rhytid_shared::trust::Trust;
use rhytid_shared::{Character, FIT_SECONDS, FitStep, Profile, ProfileChoice, RoomName, Settings, Slot};
use std::io::{IsTerminal, Write};
use std::net::SocketAddr;
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
    /// Solve a recording again and compare every packet, byte by byte.
    Verify(record_command::VerifyArgs),
    /// Record a room of any server as a viewer: its packets, until Ctrl-C.
    Record(record_command::RecordArgs),
    /// Play a recording: its publishers' messages to a server, which solves them again, or its packets to viewers.
    Replay(Box<record_command::ReplayArgs>),
    /// Mend a recording that was cut or damaged, in its place, and say what was lost.
    Recover(record_command::RecoverArgs),
    /// Write a recording as Live Link Face CSV, or as animations on the character (glTF).
    Export(record_command::ExportArgs),
    /// Fit a performer: measure eight faces, from a recorded feed or live with instructions here, and write a profile.
    Fit(FitArgs),
    /// Play another program's tracker from a feed file, to try its protocol without it.
    Fake(FakeArgs),
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
    /// A port for other programs' trackers, PROTOCOL one of any, openseeface, livelink, ifacialmocap, fmv3, vmc and vts; options
    /// room=NAME|subject, allow=IP, phone=IP:PORT,
    /// version=1|2|3|facemotion3d, swap_jaw=BOOL, swap_mouth=BOOL (repeat for several).
    #[arg(long, value_name = "PROTOCOL=IP:PORT[,OPTION=VALUE…]")]
    listen_udp: Vec<ListenSpec>,
    /// A program that gets a room's face as VMC (repeat for several).
    #[arg(long, value_name = "IP:PORT[,room=NAME]")]
    vmc_out: Vec<VmcOutSpec>,
    /// Keep performers' profiles in this folder: a fit that is given a name is written there, and a tracker gets the newest one
    /// that was made with it.
    #[arg(long, value_name = "DIR")]
    profiles: Option<PathBuf>,
    #[command(flatten)]
    cluster: ClusterConfig,
    #[command(flatten)]
    limits: Limits,
    #[command(flatten)]
    timeouts: Timeouts,
    #[command(flatten)]
    access: Access,
    #[command(flatten)]
    record: RecordConfig,
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
    /// The server, or nodes of a cluster with commas between them: when one is lost, the face goes on at the next.
    #[arg(long, default_value = "ws://127.0.0.1:7878", value_name = "URL[,URL…]")]
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
    /// Slot in the room, beside other sources, in place of what the feed's hello says.
    #[arg(long, value_name = "NAME", value_parser = parse_name)]
    slot: Option<RoomName>,
    /// Priority of that slot: the highest live one drives the face.
    #[arg(long, value_name = "0..100", value_parser = clap::value_parser!(u8).range(..=i64::from(Slot::MAX_PRIORITY)))]
    priority: Option<u8>,
    /// Send frames of landmarks in the binary form, a twelfth of the bytes.
    #[arg(long)]
    binary: bool,
    /// What is known of the performer: a profile's file, or the name of one that the server keeps.
    #[arg(long, value_name = "FILE.json|NAME", value_parser = parse_profile)]
    profile: Option<ProfileChoice>,
    /// How long the server may take to accept the connection, to answer the hello, and to read a message.
    #[arg(long, default_value = "15", value_name = "SECONDS", value_parser = parse_seconds)]
    timeout: Duration,
    /// Whom to trust on wss://: the fingerprint that `serve --tls-self-signed` printed, or a PEM file of authorities; else the
    /// public ones
    #[arg(long, value_name = "FINGERPRINT|FILE.pem", value_parser = parse_trust, default_value = "", hide_default_value = true)]
    trust: Trust,
    #[command(flatten)]
    token: token_command::GivenToken,
}

fn parse_trust(text: &str) -> Result<Trust, String> {
    Trust::from_argument(text, |path| std::fs::read(path))
}

fn parse_profile(text: &str) -> Result<ProfileChoice, String> {
    if let Ok(name) = RoomName::new(text) {
        return Ok(ProfileChoice::Named(name));
    }
    let json = std::fs::read_to_string(text).map_err(|error| format!("cannot read it: {error}"))?;
    Profile::from_json(&json).map(|profile| ProfileChoice::Given(Box::new(profile))).map_err(|error| error.message)
}

#[derive(Args)]
struct FitArgs {
    /// A recording of the eight faces; without one a live source is guided.
    #[arg(value_name = "FEED")]
    feed: Option<PathBuf>,
    /// Where to write the profile.
    #[arg(long, value_name = "FILE.json")]
    out: PathBuf,
    /// When the recording shows a face, seconds of the feed (repeat for each); without any, when the feed itself asks for it.
    #[arg(long = "step", value_name = "STEP=FROM..TO", requires = "feed")]
    steps: Vec<StepAt>,
    /// What the profile is called; a server with --profiles keeps it by this name.
    #[arg(long, value_parser = parse_name)]
    name: Option<RoomName>,
    /// The server of a live source.
    #[arg(long, default_value = "ws://127.0.0.1:7878", value_name = "URL", conflicts_with = "feed")]
    to: String,
    /// Its room.
    #[arg(long, default_value = "demo", value_parser = parse_name, conflicts_with = "feed")]
    room: RoomName,
    /// Its slot in the room.
    #[arg(long, default_value = "main", value_parser = parse_name, conflicts_with = "feed")]
    slot: RoomName,
    /// How long to get into a face.
    #[arg(long, default_value = "1.5", value_name = "SECONDS", value_parser = parse_seconds, conflicts_with = "feed")]
    ready: Duration,
    /// How long each face is measured, 0.2 to 10.
    #[arg(long, default_value = "1.5", value_name = "SECONDS", value_parser = parse_hold, conflicts_with = "feed")]
    hold: Duration,
    /// Put sides right without asking.
    #[arg(long)]
    yes: bool,
    /// Whom to trust on wss://, as of `send`.
    #[arg(long, value_name = "FINGERPRINT|FILE.pem", value_parser = parse_trust, default_value = "", hide_default_value = true)]
    trust: Trust,
    #[command(flatten)]
    token: token_command::GivenToken,
}

fn parse_name(text: &str) -> Result<RoomName, String> {
    RoomName::new(text).map_err(|error| error.to_string())
}

fn parse_hold(text: &str) -> Result<Duration, String> {
    let [least, most] = FIT_SECONDS;
    let seconds = text.parse().ok().filter(|seconds| (least..=most).contains(seconds));
    seconds.map(Duration::from_secs_f64).ok_or_else(|| format!("expected seconds from {least} to {most}"))
}

#[derive(Args)]
struct FakeArgs {
    /// The feed file: weights, or landmarks, from which weights are told where the protocol has weights.
    #[arg(value_name = "FEED")]
    feed: PathBuf,
    /// Whom to play.
    #[arg(long = "as", value_name = "SENDER")]
    kind: FakeKind,
    /// Where to send to; without, to whoever asks for it (ifacialmocap, facemotion3d, fmv3, vts).
    #[arg(long, value_name = "IP:PORT")]
    to: Option<SocketAddr>,
    /// Where to send from and to be asked at; port 0 takes a free one.
    #[arg(long, default_value = "0.0.0.0:0", value_name = "IP:PORT")]
    bind: SocketAddr,
    /// What the performer is called, where the protocol says it.
    #[arg(long, default_value = "Fake", value_parser = parse_subject)]
    subject: String,
    /// Feed seconds a second, or `max`.
    #[arg(long, default_value = "1.0", value_parser = parse_speed)]
    speed: f64,
    /// Play it again and again.
    #[arg(long = "loop")]
    repeats: bool,
}

fn parse_subject(text: &str) -> Result<String, String> {
    if text.len() <= 256 { Ok(text.to_owned()) } else { Err("expected at most 256 bytes".into()) }
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
        Command::Verify(args) => record_command::verify_file(&args),
        Command::Record(args) => record_command::record_room(args).await,
        Command::Replay(args) => record_command::replay_file(*args).await,
        Command::Recover(args) => record_command::recover_file(&args),
        Command::Export(args) => record_command::export_file(&args),
        Command::Fit(args) => fit(args).await,
        Command::Fake(args) => fake_feed(args).await,
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
        (0, Command::Serve(_) | Command::Replay(_)) => "rhytid_server=info,warn",
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
        "max-request-rate": limits.requests_per_second_per_address,
        "hello-timeout": timeouts.hello,
        "ping-interval": timeouts.ping,
        "publisher-timeout": timeouts.publisher_idle,
        "viewer-timeout": timeouts.viewer_idle,
        "write-timeout": timeouts.write,
        "room-timeout": timeouts.room_idle,
        "replay-timeout": timeouts.replay_idle,
        "record": record.dir,
        "record-rooms": record.rooms,
        "max-recordings": record.recordings,
        "max-recording": record.file_bytes,
    }
    config.character = args.character.or(config.character);
    config.profiles = args.profiles.or(config.profiles);
    // Given by flags it is whole, whatever the file says.
    if args.cluster != ClusterConfig::default() {
        config.cluster = args.cluster;
    }
    config.listen_udp.extend(args.listen_udp);
    config.vmc_out.extend(args.vmc_out);
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
    // Before the port is bound: who sees its line may connect, and a broken character must not leave a port behind.
    let character = load_character(config.character.as_deref())?;
    serve_until_signal(config, character).await
}

/// Serves `character` until SIGINT or SIGTERM.
async fn serve_until_signal(config: ServerConfig, character: (Arc<Character>, Vec<u8>)) -> anyhow::Result<()> {
    let mut interrupt = Signals::new().context("cannot wait for signals")?;
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
        // A recording that reaches the process's limit of file sizes fails by itself; unheard, the signal would end the process.
        let _ = signal(SignalKind::from_raw(rustix::process::Signal::XFSZ.as_raw()))?;
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
    let options = SendOptions {
        source,
        to: args.to,
        room: args.room,
        speed: args.speed,
        repeats: args.repeats,
        takeover: args.takeover,
        slot: args.slot,
        priority: args.priority,
        binary: args.binary,
        profile: args.profile,
        timeout: args.timeout,
        trust: args.trust,
        token: args.token.read()?,
    };
    send_with_progress(options).await
}

async fn send_with_progress(options: SendOptions) -> anyhow::Result<()> {
    let progress = ProgressBar::new(0);
    progress
        .set_style(ProgressStyle::with_template("{elapsed_precise} [{bar:40}] {percent:>3}% {bytes}/{total_bytes}")?.progress_chars("=> "));
    let mut interrupt = Signals::new().context("cannot wait for signals")?;
    let report = send(&options, &progress, async move { interrupt.wait().await }).await;
    progress.finish_and_clear();
    let SendReport { frames, errors } = report?;
    ensure!(errors == 0, "sent {frames} frames, of all messages the server refused {errors}");
    eprintln!("sent {frames} frames, none refused");
    Ok(())
}

async fn fit(args: FitArgs) -> anyhow::Result<()> {
    let FitArgs { feed, out, steps, name, to, room, slot, ready, hold, yes, trust, token } = args;
    let profile = if let Some(feed) = feed {
        let (character, _) = load_character(None)?;
        let report = fit_feed(&feed, &character, steps, name.as_ref(), |line| eprintln!("{line}"))?;
        report.warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
        let mut profile = report.profile;
        if yes {
            profile.settings.change(&report.offers);
        } else if report.offers != Settings::default() {
            eprintln!("--yes puts it right in the profile");
        }
        profile
    } else {
        let (room, slot, name) = (room.to_string(), slot.to_string(), name.map(|name| name.to_string()));
        let options = LiveFit { to, room, slot, name, ready, hold, trust, token: token.read()? };
        fit_live(&options, &mut Terminal { yes }).await?
    };
    write_profile(&profile, &out).with_context(|| format!("cannot write {}", out.display()))?;
    eprintln!("wrote {}", out.display());
    Ok(())
}

/// Guides a performer by lines of text.
struct Terminal {
    yes: bool,
}

impl Guide for Terminal {
    fn ask(&mut self, step: FitStep, at: usize, of: usize, ready: Duration, hold: Duration) {
        let bell = if std::io::stderr().is_terminal() { "\x07" } else { "" };
        eprintln!("{bell}[{at}/{of}] {}: in {:.1} s, for {:.1} s", step.instruction(), ready.as_secs_f64(), hold.as_secs_f64());
    }

    fn tell(&mut self, text: &str) {
        eprintln!("      {text}");
    }

    fn agrees(&mut self, offers: &Settings) -> bool {
        if self.yes {
            return true;
        }
        let offered = serde_json::to_string(offers).unwrap_or_default();
        if !std::io::stdin().is_terminal() {
            eprintln!("      --yes puts it right: {offered}");
            return false;
        }
        eprint!("      put it right ({offered})? [Y/n] ");
        let mut line = String::new();
        std::io::stdin().read_line(&mut line).is_ok() && !line.trim().to_lowercase().starts_with('n')
    }
}

async fn fake_feed(args: FakeArgs) -> anyhow::Result<()> {
    let options = FakeOptions {
        kind: args.kind,
        feed: args.feed,
        to: args.to,
        bind: args.bind,
        subject: args.subject,
        speed: args.speed,
        repeats: args.repeats,
    };
    let mut interrupt = Signals::new().context("cannot wait for signals")?;
    let tell = |address: SocketAddr| match options.to {
        Some(to) => eprintln!("sending from udp {address} to {to}"),
        None => eprintln!("waiting on udp {address} to be asked"),
    };
    let frames = fake(&options, tell, async move { interrupt.wait().await }).await?;
    eprintln!("sent {frames} frames");
    Ok(())
}
