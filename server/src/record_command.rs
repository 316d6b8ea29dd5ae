//! What works on recordings: `record`, `replay`, `verify`, `recover`, `export`.

use super::{Signals, parse_seconds, parse_speed, parse_trust, send_with_progress, serve_until_signal, token_command};
use anyhow::{Context, ensure};
use clap::Args;
use rhytid_server::recording::{
    Faces, PlayRequest, Recording, RecoverReport, VerifyReport, export_csv, export_gltf, recover, verify, watch,
};
use rhytid_server::{Access, Play, SendOptions, SendSource, ServerConfig, Tls, load_character};
use rhytid_shared::RoomName;
use rhytid_shared::trust::Trust;
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Args)]
pub(crate) struct RecordArgs {
    /// The file to be made.
    #[arg(value_name = "OUT.mcap")]
    out: PathBuf,
    /// The room.
    #[arg(long, default_value = "demo")]
    room: String,
    /// The server.
    #[arg(long, default_value = "ws://127.0.0.1:7878", value_name = "URL")]
    server: String,
    /// Stop after so many seconds.
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds)]
    seconds: Option<Duration>,
    /// Whom to trust on wss://: the fingerprint that `serve --tls-self-signed` printed, or a PEM file of authorities; else the
    /// public ones
    #[arg(long, value_name = "FINGERPRINT|FILE.pem", value_parser = parse_trust, default_value = "", hide_default_value = true)]
    trust: Trust,
    #[command(flatten)]
    token: token_command::GivenToken,
}

#[derive(Args)]
pub(crate) struct ReplayArgs {
    /// The recording.
    #[arg(value_name = "FILE.mcap")]
    file: PathBuf,
    /// The room; the recorded one where none is given.
    #[arg(long)]
    room: Option<String>,
    /// The server to publish to.
    #[arg(long, default_value = "ws://127.0.0.1:7878", value_name = "URL", conflicts_with = "packets")]
    server: String,
    /// Send the recorded packets: serve them to viewers from here, with a play bar over HTTP.
    #[arg(long)]
    packets: bool,
    /// With --packets: address and port to serve at.
    #[arg(long, default_value = "127.0.0.1:7878", requires = "packets")]
    listen: String,
    #[command(flatten)]
    access: Access,
    #[command(flatten)]
    tls: Tls,
    /// With --packets: the character it is of, instead of the built-in one.
    #[arg(long, value_name = "FILE.glb", requires = "packets")]
    character: Option<PathBuf>,
    /// Where to begin, seconds of the recording. Publishers' messages before are left out.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    from: f64,
    /// Where to end, seconds of the recording.
    #[arg(long, default_value_t = f64::INFINITY, value_name = "SECONDS", hide_default_value = true)]
    to: f64,
    /// Seconds of the recording a second, or `max`: as fast as it goes.
    #[arg(long, default_value = "1.0", value_parser = parse_speed)]
    speed: f64,
    /// Play it again and again.
    #[arg(long = "loop")]
    repeats: bool,
    /// Take the room over from another publisher.
    #[arg(long)]
    takeover: bool,
    /// Whom to trust on wss://: the fingerprint that `serve --tls-self-signed` printed, or a PEM file of authorities; else the
    /// public ones
    #[arg(long, value_name = "FINGERPRINT|FILE.pem", value_parser = parse_trust, default_value = "", hide_default_value = true)]
    trust: Trust,
    #[command(flatten)]
    token: token_command::GivenToken,
}

#[derive(Args)]
pub(crate) struct RecoverArgs {
    /// The recording.
    #[arg(value_name = "FILE.mcap")]
    file: PathBuf,
    /// Write the mended recording here instead of in its place.
    #[arg(long, value_name = "OUT.mcap")]
    out: Option<PathBuf>,
}

#[derive(Args)]
pub(crate) struct ExportArgs {
    /// The recording.
    #[arg(value_name = "FILE.mcap")]
    file: PathBuf,
    /// As what: Live Link Face's table of weights, or the character with two animations, `bones` and `shapes`.
    #[arg(long, value_enum)]
    to: ExportFormat,
    /// The file to be made.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Where to begin, seconds of the recording.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    from: f64,
    /// Where to end, seconds of the recording.
    #[arg(long, default_value_t = f64::INFINITY, value_name = "SECONDS", hide_default_value = true)]
    until: f64,
    /// The character it is of, instead of the built-in one (for glTF).
    #[arg(long, value_name = "FILE.glb")]
    character: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum ExportFormat {
    Csv,
    Gltf,
}

#[derive(Args)]
pub(crate) struct VerifyArgs {
    /// The recording.
    #[arg(value_name = "FILE.mcap")]
    file: PathBuf,
    /// The character it is of, instead of the built-in one.
    #[arg(long, value_name = "FILE.glb")]
    character: Option<PathBuf>,
}

pub(crate) async fn record_room(args: RecordArgs) -> anyhow::Result<()> {
    let room = RoomName::new(&args.room)?;
    let mut interrupt = Signals::new().context("cannot wait for signals")?;
    let stop = async move {
        tokio::select! {
            () = interrupt.wait() => {}
            () = tokio::time::sleep(args.seconds.unwrap_or(Duration::MAX / 4)) => {}
        }
    };
    let (packets, bytes) = watch(&args.server, room.as_str(), &args.trust, args.token.read()?.as_deref(), &args.out, stop).await?;
    println!("{packets} packets in {bytes} bytes");
    Ok(())
}

pub(crate) async fn replay_file(args: ReplayArgs) -> anyhow::Result<()> {
    ensure!(args.from >= 0.0 && args.from < args.to, "--from must be 0 or more and before --to");
    let recording = Recording::open(&args.file)?;
    let room = RoomName::new(args.room.as_deref().unwrap_or(recording.room()))?;
    drop(recording);
    if !args.packets {
        ensure!(args.access == Access::default() && args.tls == Tls::default(), "who may watch and how is said with --packets only");
        let source = SendSource::Recording(args.file, [args.from, args.to]);
        let (to, room, takeover) = (args.server, room.to_string(), args.takeover);
        let (timeout, trust) = (Duration::from_secs(15), args.trust);
        let (speed, repeats) = (args.speed, args.repeats);
        return send_with_progress(SendOptions {
            source,
            to,
            room,
            speed,
            repeats,
            takeover,
            slot: None,
            priority: None,
            binary: false,
            profile: None,
            timeout,
            trust,
            token: args.token.read()?,
        })
        .await;
    }
    let request = PlayRequest {
        speed: Some(args.speed),
        repeats: Some(args.repeats),
        from: Some(args.from),
        to: Some(args.to).filter(|to| to.is_finite()),
        takeover: args.takeover,
        ..PlayRequest::default()
    };
    let play = Some(Play { file: args.file, room, request });
    let config = ServerConfig { listen: args.listen, play, access: args.access, tls: args.tls, ..ServerConfig::default() };
    config.validate()?;
    let character = load_character(args.character.as_deref())?;
    serve_until_signal(config, character).await
}

pub(crate) fn recover_file(args: &RecoverArgs) -> anyhow::Result<()> {
    let RecoverReport { was_whole, messages, packets, seconds, cut_off, damaged, num_damaged, orphans } =
        recover(&args.file, args.out.as_deref())?;
    if was_whole {
        println!("the recording is whole: {seconds:.1} s, nothing was written");
        return Ok(());
    }
    println!("kept {seconds:.1} s: {messages} messages, {packets} packets among them");
    match cut_off {
        0 if num_damaged == 0 => println!("lost nothing but the index, which was written anew"),
        0 => {}
        bytes => println!("lost {bytes} bytes at the end, part of a chunk that holds a second at most"),
    }
    for problem in &damaged {
        println!("lost: {problem}");
    }
    if num_damaged > damaged.len() as u64 {
        println!("lost {} more damaged chunks", num_damaged - damaged.len() as u64);
    }
    if orphans > 0 {
        println!("lost {orphans} batches of packets that go on from what was lost");
    }
    Ok(())
}

pub(crate) fn export_file(args: &ExportArgs) -> anyhow::Result<()> {
    let mut faces = Faces::new(Recording::open(&args.file)?);
    let range = [args.from, args.until];
    let named = || args.out.display().to_string();
    let num = match args.to {
        ExportFormat::Csv => {
            let file = std::fs::File::create(&args.out).with_context(named)?;
            let mut out = std::io::BufWriter::new(file);
            let num = export_csv(&mut faces, range, &mut out)?;
            out.flush().with_context(named)?;
            num
        }
        ExportFormat::Gltf => {
            let (character, glb) = load_character(args.character.as_deref())?;
            let (file, num) = export_gltf(&mut faces, range, &character, &glb)?;
            std::fs::write(&args.out, file).with_context(named)?;
            num
        }
    };
    println!("{num} faces in {}", args.out.display());
    Ok(())
}

pub(crate) fn verify_file(args: &VerifyArgs) -> anyhow::Result<()> {
    let (character, _) = load_character(args.character.as_deref())?;
    let mut recording = Recording::open(&args.file)?;
    if recording.server() != env!("CARGO_PKG_VERSION") {
        eprintln!("recorded by version {}, this is {}", recording.server(), env!("CARGO_PKG_VERSION"));
    }
    let VerifyReport { sessions, frames, not_compared, cut } = verify(&mut recording, &character)?;
    println!("{frames} frames of {sessions} sessions give the recorded bytes");
    if not_compared > 0 {
        println!("not compared: {not_compared} packets of sessions that had begun before the recording");
    }
    if cut > 0 {
        println!("the recording was cut: {cut} frames at its end have no packet");
    }
    Ok(())
}
