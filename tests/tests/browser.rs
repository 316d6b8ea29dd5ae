//! The page in the browser, in a real Chromium without a window: both back ends draw what the native client draws, and the page
//! does what it says. The scripts stand in `tests/browser`; `node` and `playwright-core` run them.
//!
//! What a machine lacks shows as ignored: `cargo xtask setup` fetches it, `cargo xtask web` builds the page.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

#[path = "service/harness.rs"]
#[allow(dead_code, reason = "the service's tests use the rest")]
mod harness;

use anyhow::{Context, Result, ensure};
use harness::Server;
use image::RgbaImage;
use libtest_mimic::{Arguments, Failed, Trial};
use rhytid_client::renderer::AdapterChoice;
use rhytid_client::{Camera, CharacterAsset, DrawSettings, Headless, Playout};
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use rhytid_shared::packet::{Decoder, PacketLayout};
use rhytid_shared::view::ViewMessage;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::sync::Mutex;
use std::time::Duration;

/// Side of the pictures that are compared, pixels.
const SIDE: u32 = 512;
/// A channel that is off by more than this many codes counts as different: SwiftShader and llvmpipe round and place samples a
/// little differently.
const CODES: u8 = 10;
/// Share of the pixels that may be different; 0.0007 has been seen, and 0.004 for a face without wrinkles.
const MOST_DIFFERENT: f64 = 0.002;
/// Mean difference over all channels, codes; 0.09 has been seen, and 0.23 for a face without wrinkles.
const MOST_MEAN: f64 = 0.16;
/// Most the module may take compressed, bytes.
const MOST_COMPRESSED: u64 = 3_000_000;
/// A first picture that takes longer than this is a fault and no busy machine. The aim is 2 s; how long it took is printed.
const MOST_FIRST_PICTURE: f64 = 20.0;
/// Moments of the packets, every 40 ms, and of the pictures: by the last, the face has long been what the packets say.
const PACKETS: std::ops::RangeInclusive<u64> = 0..=60;
const DRAWS: [u64; 3] = [0, 1600, 2400];

/// Where Debian puts it, which only root's path leads to.
const NATS: &str = "/usr/sbin/nats-server";

/// Browsers take turns: each takes all there is of a small machine.
static TURN: Mutex<()> = Mutex::new(());

fn main() -> ExitCode {
    let mut arguments = Arguments::from_args();
    arguments.test_threads.get_or_insert(1);
    let lack = lack();
    if let Some(lack) = &lack {
        eprintln!("ignored: {lack}");
    }
    let trial = |name: &'static str, can_run: bool, test: fn() -> Result<()>| {
        let run = move || {
            let _turn = TURN.lock();
            test().map_err(|error| Failed::from(format!("{error:#}")))
        };
        Trial::test(name, run).with_ignored_flag(!can_run)
    };
    let can_draw = lack.is_none() && native_picture_is_possible();
    let can_track = lack.is_none() && film().is_file() && target().join("web/face_mesh/face_mesh.js").is_file();
    let trials = vec![
        trial("the_module_takes_less_than_3_mb", has_bundle(), the_module_takes_less_than_3_mb),
        trial("the_pages_own_code", has("node"), || script("wire.mjs", None, &[])),
        trial("qr_codes_can_be_read", has("node") && has_package("jsqr"), || script("qr.mjs", None, &[])),
        trial("webgl2_draws_what_the_native_client_draws", can_draw, || compare("webgl")),
        trial("webgpu_draws_what_the_native_client_draws", can_draw, || compare("webgpu")),
        trial("the_first_picture_comes_soon_with_webgl2", lack.is_none(), || first_picture("webgl")),
        trial("the_first_picture_comes_soon_with_webgpu", lack.is_none(), || first_picture("webgpu")),
        trial("the_page_does_what_it_says", lack.is_none(), || on_a_server("page.mjs")),
        trial("the_page_lets_in_who_has_a_token", lack.is_none(), the_page_lets_in_who_has_a_token),
        trial("the_page_records_and_replays", lack.is_none(), the_page_records_and_replays),
        trial("the_page_survives_the_server", lack.is_none(), the_page_survives_the_server),
        trial("the_page_goes_on_at_another_node", lack.is_none() && has(NATS), the_page_goes_on_at_another_node),
        trial("a_lost_graphics_device_is_replaced", lack.is_none(), || on_a_server("lost.mjs")),
        trial("publish_to_shown_picture_takes_so_long_with_webgl2", lack.is_none(), || latency("webgl")),
        trial("publish_to_shown_picture_takes_so_long_with_webgpu", lack.is_none(), || latency("webgpu")),
        trial("sources_are_listed_and_told_from_the_page", lack.is_none(), sources_are_listed_and_told_from_the_page),
        trial("a_face_before_the_camera_moves_another_pages_picture", can_track, || with_film("camera.mjs")),
        trial("the_camera_page_fits_a_performer", can_track, || with_film("wizard.mjs")),
        trial("a_newcomers_way", can_track, a_newcomers_way),
        trial("the_camera_page_and_the_server_agree", can_track, || with_film("fit.mjs")),
    ];
    libtest_mimic::run(&arguments, trials).exit_code()
}

/// The first of the things that are missing.
fn lack() -> Option<String> {
    if !has_bundle() {
        return Some("the page is not built (`cargo xtask web`)".into());
    }
    if !chromium().is_file() {
        return Some(format!("there is no Chromium at {} (RHYTID_CHROMIUM names another)", chromium().display()));
    }
    if !has("node") {
        return Some("there is no node".into());
    }
    if !has_package("playwright-core") {
        return Some("playwright-core is not fetched (`cargo xtask setup`)".into());
    }
    None
}

fn has(program: &str) -> bool {
    Command::new(program).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

fn has_package(name: &str) -> bool {
    target().join("npm/node_modules").join(name).is_dir()
}

/// A film of a face, which `cargo xtask setup` makes.
fn film() -> PathBuf {
    target().join("npm/face.mjpeg")
}

fn has_bundle() -> bool {
    target().join("web/bundle.txt").is_file()
}

fn chromium() -> PathBuf {
    std::env::var_os("RHYTID_CHROMIUM").map_or_else(|| "/usr/bin/chromium".into(), PathBuf::from)
}

fn native_picture_is_possible() -> bool {
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
    Headless::on(&asset, AdapterChoice::Software).is_ok()
}

fn target() -> PathBuf {
    // CARGO_TARGET_TMPDIR is target/tmp.
    Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("it stands in the target folder").to_owned()
}

/// Runs a script, passes on what it prints, and fails with the lines that say `not ok`.
fn script(name: &str, server: Option<&Server>, environment: &[(&str, &Path)]) -> Result<()> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("browser").join(name);
    let mut node = Command::new("node");
    node.arg(&path).env("RHYTID_NODE_MODULES", target().join("npm/node_modules")).env("RHYTID_CHROMIUM", chromium());
    if let Some(server) = server {
        node.env("RHYTID_URL", format!("http://{}", server.address));
    }
    node.envs(environment.iter().copied());
    let mut child = node.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().context("cannot run node")?;
    let mut stderr = child.stderr.take().context("piped")?;
    let reader = std::thread::spawn(move || {
        let mut said = String::new();
        // Half of it is better than none.
        let _ = stderr.read_to_string(&mut said);
        said
    });
    let mut failed = Vec::new();
    for line in BufReader::new(child.stdout.take().context("piped")?).lines() {
        let line = line?;
        println!("{name}: {line}");
        if line.starts_with("not ok") {
            failed.push(line);
        }
    }
    let status = child.wait()?;
    let said = reader.join().expect("reading does not panic");
    ensure!(status.success() && failed.is_empty(), "{name} ended with {status}: {}\n{said}", failed.join("\n"));
    Ok(())
}

fn the_module_takes_less_than_3_mb() -> Result<()> {
    let bytes = |name: &str| Ok::<_, anyhow::Error>(std::fs::metadata(target().join("web").join(name))?.len());
    let (raw, compressed) = (bytes("rhytid_client_bg.wasm")?, bytes("rhytid_client_bg.wasm.gz")?);
    println!("the module takes {raw} bytes, {compressed} compressed");
    ensure!(compressed <= MOST_COMPRESSED, "{compressed} bytes, at most {MOST_COMPRESSED}");
    // The server serves this and nothing else.
    let server = Server::start();
    let (head, body) = server.get("/rhytid_client_bg.wasm", "Accept-Encoding: gzip\r\n");
    ensure!(head.starts_with("HTTP/1.1 200") && head.contains("application/wasm"), "{head}");
    ensure!(body == std::fs::read(target().join("web/rhytid_client_bg.wasm.gz"))?, "the server was built with another page");
    Ok(())
}

/// Draws a frown with half a raised brow in the browser and natively, from the same packets at the same moments.
fn compare(backend: &str) -> Result<()> {
    let server = Server::start();
    let mut viewer = server.connect("/v1/rooms/compare/view", &[]).map_err(|answer| anyhow::anyhow!("refused: {answer:?}"))?;
    let hello = viewer.text();
    let mut publisher = server.ready_publisher("compare");
    let mut packets = Vec::new();
    for k in PACKETS {
        let weights = r#"{"browInnerUp":0.9,"browOuterUpLeft":0.8,"jawOpen":0.35,"mouthSmileLeft":0.7,"eyeSquintRight":0.6}"#;
        publisher.send(&format!(r#"{{"type":"frame","t":{},"weights":{weights}}}"#, k as f64 * 0.04));
        let packet = loop {
            if let tungstenite::Message::Binary(packet) = viewer.socket.read()? {
                break packet.to_vec();
            }
        };
        packets.push((40 * k, packet));
    }
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("browser");
    std::fs::create_dir_all(&folder)?;
    let png = folder.join(format!("{backend}.png"));
    let job = folder.join(format!("{backend}.json"));
    std::fs::write(
        &job,
        serde_json::to_vec(&serde_json::json!({
            "backend": backend, "size": SIDE, "hello": hello, "packets": packets, "draws": DRAWS, "png": png,
            "mostFirstPicture": MOST_FIRST_PICTURE,
        }))?,
    )?;
    script("picture.mjs", Some(&server), &[("RHYTID_JOB", &job)])?;
    let got = image::open(&png)?.to_rgba8();

    let Ok(ViewMessage::Hello(hello)) = serde_json::from_str(&hello) else { anyhow::bail!("the first message is no hello") };
    let mut decoder = Decoder::new(PacketLayout::try_from(&hello.character)?);
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
    let mut playout = Playout::new(&asset.character);
    let mut frame = decoder.layout().frame_at_rest();
    let rest = playout.sample(Duration::ZERO).clone();
    let mut shown = rest.clone();
    let mut waiting = packets.iter().peekable();
    for at in DRAWS {
        while let Some((came, packet)) = waiting.next_if(|(came, _)| *came <= at) {
            decoder.decode(packet, &mut frame)?;
            playout.push(&frame, Duration::from_millis(*came));
        }
        shown.clone_from(playout.sample(Duration::from_millis(at)));
    }
    let mut headless = Headless::on(&asset, AdapterChoice::Software)?;
    let settings = DrawSettings::new(Camera::front(&asset.character));
    let expected = headless.render([SIDE; 2], &settings, &shown)?;
    expected.save(folder.join("native.png"))?;
    let bare = headless.render([SIDE; 2], &DrawSettings { wrinkles: false, ..settings }, &shown)?;
    let at_rest = headless.render([SIDE; 2], &settings, &rest)?;
    let off = Difference::of(&got, &expected)?;
    println!("{backend}: off by {:.3} codes on average, {:.3} % of the pixels by more than {CODES}", off.mean, 100.0 * off.share);
    ensure!(off.mean <= MOST_MEAN && off.share <= MOST_DIFFERENT, "{off:?} in {}", png.display());
    // Another face and a face without its wrinkles must not pass for it.
    for (what, wrong) in [("without wrinkles", bare), ("at rest", at_rest)] {
        let far = Difference::of(&got, &wrong)?;
        ensure!(far.mean > MOST_MEAN || far.share > MOST_DIFFERENT, "a face {what} passes, too: {far:?}");
        ensure!(far.mean > 2.0 * off.mean, "a face {what} is as near: {far:?} against {off:?}");
    }
    Ok(())
}

/// How far two pictures are apart.
#[derive(Debug)]
struct Difference {
    /// Over all channels, codes.
    mean: f64,
    /// Of the pixels: those with a channel off by more than [`CODES`].
    share: f64,
}

impl Difference {
    fn of(a: &RgbaImage, b: &RgbaImage) -> Result<Self> {
        ensure!(a.dimensions() == b.dimensions(), "{:?} and {:?} pixels", a.dimensions(), b.dimensions());
        let (mut sum, mut count) = (0, 0);
        for (a, b) in a.pixels().zip(b.pixels()) {
            let off: [u8; 3] = std::array::from_fn(|channel| a[channel].abs_diff(b[channel]));
            sum += off.iter().map(|off| u64::from(*off)).sum::<u64>();
            count += usize::from(off.iter().any(|off| *off > CODES));
        }
        let pixels = f64::from(a.width()) * f64::from(a.height());
        Ok(Self { mean: sum as f64 / (3.0 * pixels), share: count as f64 / pixels })
    }
}

fn on_a_server(name: &str) -> Result<()> {
    let server = Server::start();
    script(name, Some(&server), &[])
}

fn first_picture(backend: &str) -> Result<()> {
    let server = Server::start();
    let most = MOST_FIRST_PICTURE.to_string();
    script("first.mjs", Some(&server), &[("RHYTID_BACKEND", Path::new(backend)), ("RHYTID_MOST", Path::new(&most))])
}

fn latency(backend: &str) -> Result<()> {
    let server = Server::start();
    script("latency.mjs", Some(&server), &[("RHYTID_BACKEND", Path::new(backend))])
}

fn the_page_lets_in_who_has_a_token() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let key = folder.path().join("keys");
    rhytid_server::make_key_file(&key)?;
    let server = Server::with(|config| config.access.token_key = Some(key.clone()));
    let make = |role, rooms: &str| rhytid_server::make_token(&key, role, &[rooms.to_owned()], Duration::from_secs(3600));
    let (view, publish) = (make(rhytid_server::Role::View, "demo")?, make(rhytid_server::Role::Publish, "demo")?);
    script("access.mjs", Some(&server), &[("RHYTID_VIEW", Path::new(&view)), ("RHYTID_PUBLISH", Path::new(&publish))])
}

fn the_page_records_and_replays() -> Result<()> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("takes");
    // What a run before has left.
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder)?;
    let server = Server::with(|config| {
        config.record.dir = Some(folder.clone());
        config.record.rooms = vec!["none".into()];
    });
    script("takes.mjs", Some(&server), &[])
}

/// Runs a script that shows the film to the browser's camera.
fn with_film(name: &str) -> Result<()> {
    let server = Server::start();
    script(name, Some(&server), &[("RHYTID_CLIP", &film())])
}

/// The address of the server's port for trackers.
fn tracker_port(server: &Server) -> Result<String> {
    let (_, body) = server.get("/api/trackers", "");
    let trackers: serde_json::Value = serde_json::from_slice(&body)?;
    Ok(trackers["ports"][0]["address"].as_str().context("the port is listed")?.to_owned())
}

fn sources_are_listed_and_told_from_the_page() -> Result<()> {
    let program = rhytid_tests::program("rhytid-server")?;
    let work = tempfile::tempdir()?;
    let server = Server::with(|config| {
        config.listen_udp = vec!["livelink=127.0.0.1:0,room=stage,slot=phone,priority=60".parse().expect("a port for trackers")];
        config.profiles = Some(work.path().join("profiles"));
    });
    let port = tracker_port(&server)?;
    script("sources.mjs", Some(&server), &[("RHYTID_SERVER", &program), ("RHYTID_UDP", Path::new(&port)), ("RHYTID_WORK", work.path())])
}

fn a_newcomers_way() -> Result<()> {
    let program = rhytid_tests::program("rhytid-server")?;
    let server = Server::with(|config| config.listen_udp = vec!["openseeface=127.0.0.1:0,room=demo".parse().expect("a port for trackers")]);
    let port = tracker_port(&server)?;
    let feed = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl");
    script(
        "newcomer.mjs",
        Some(&server),
        &[("RHYTID_CLIP", &film()), ("RHYTID_SERVER", &program), ("RHYTID_UDP", Path::new(&port)), ("RHYTID_FEED", &feed)],
    )
}

fn the_page_goes_on_at_another_node() -> Result<()> {
    let server = rhytid_tests::program("rhytid-server")?;
    script("nodes.mjs", None, &[("RHYTID_SERVER", &server), ("RHYTID_NATS", Path::new(NATS))])
}

fn the_page_survives_the_server() -> Result<()> {
    let server = rhytid_tests::program("rhytid-server")?;
    let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port().to_string();
    script("restart.mjs", None, &[("RHYTID_SERVER", &server), ("RHYTID_PORT", Path::new(&port))])
}
