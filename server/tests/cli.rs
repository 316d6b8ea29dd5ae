//! Facts about the program itself: its first line, its end, its errors, its memory.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod clip_fixture;

#[cfg(unix)]
#[path = "process/http.rs"]
mod http;
#[cfg(target_os = "linux")]
#[path = "process/memory.rs"]
mod memory;
mod process;
#[cfg(unix)]
#[path = "process/signal.rs"]
mod signal;
#[path = "process/socket.rs"]
mod socket;

#[cfg(unix)]
use process::Process;
use process::{PATIENCE, Server, program};
use rhytid_shared::view::ViewMessage;
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Output, Stdio};
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Message, WebSocket};

fn serve(args: &[&str]) -> Server {
    Server::start(&[&["serve"], args].concat())
}

/// A viewer's socket; `query` may be empty.
fn view(server: &Server, query: &str) -> WebSocket<TcpStream> {
    socket::open(&server.address, &format!("demo/view{query}"), &[], PATIENCE).expect("it upgrades")
}

fn run(args: &[&str]) -> Output {
    program(args).output().expect("the program starts")
}

/// Runs a command that must fail with one line on standard error.
fn failure(args: &[&str]) -> String {
    let output = run(args);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success(), "{args:?} must fail");
    assert_eq!(stderr.trim_end().lines().count(), 1, "one line, not {stderr:?}");
    assert!(stderr.starts_with("error: "), "{stderr}");
    stderr
}

fn scratch(name: &str, content: &[u8]) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, content).unwrap();
    path
}

#[cfg(unix)]
#[test]
fn both_signals_end_it_cleanly_and_sockets_are_told() {
    use signal::{Signal, signal};
    for kind in [Signal::INT, Signal::TERM] {
        let mut served = serve(&[]);
        let mut viewer = view(&served, "");
        assert!(matches!(viewer.read(), Ok(Message::Ping(_))));
        assert!(matches!(viewer.read(), Ok(Message::Text(_))));
        signal(&served.process, kind);
        let close = loop {
            match viewer.read().expect("a close frame comes") {
                Message::Close(frame) => break frame.expect("with a reason"),
                _ => continue,
            }
        };
        assert_eq!((close.code, close.reason.as_str()), (CloseCode::Away, "server is shutting down"));
        // Answers the close.
        while viewer.read().is_ok() {}
        assert_eq!(served.process.wait().unwrap().code(), Some(0), "{kind:?}");
        // That it has printed one line is looked at when it is dropped, as with every server.
    }
}

#[test]
fn what_cannot_work_says_so_in_one_line() {
    let served = serve(&[]);
    let error = failure(&["serve", "--listen", &served.address]);
    assert!(error.contains(&served.address) && error.contains("in use"), "{error}");
    assert!(failure(&["serve", "--character", "no/such.glb"]).contains("no/such.glb"));
    let broken = scratch("broken.glb", b"glTF\x02\0\0\0\x0c\0\0");
    let error = failure(&["serve", "--character", broken.to_str().unwrap()]);
    assert!(error.contains("broken.glb") && error.contains("not a readable .glb"), "{error}");
    let config = scratch("bad.toml", b"[limits]\nroms = 1\n");
    let error = failure(&["serve", "--config", config.to_str().unwrap()]);
    assert!(error.contains("bad.toml, line 2: unknown field `roms`"), "{error}");
    let config = scratch("broken.toml", b"\nlisten = \"a\nb\"\n");
    let error = failure(&["serve", "--config", config.to_str().unwrap()]);
    assert!(error.contains("broken.toml, line 3: "), "{error}");
    assert!(failure(&["serve", "--max-rooms", "0"]).contains("limits.rooms is 0"));
    assert!(failure(&["send", "no/such.jsonl"]).contains("no/such.jsonl"));
    let feed = scratch(
        "bad.jsonl",
        b"{\"type\":\"hello\",\"version\":1}\n\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n",
    );
    let to = format!("ws://{}", served.address);
    let error = failure(&["send", feed.to_str().unwrap(), "--to", &to]);
    assert!(error.contains("bad.jsonl, line 4: field t is 0, expected more than the 0"), "{error}");
    let feed = scratch("good.jsonl", b"{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n");
    let error = failure(&["send", feed.to_str().unwrap(), "--to", &to, "--room", "a.b"]);
    assert!(error.contains("room name \"a.b\""), "{error}");
    let error = failure(&["send", feed.to_str().unwrap(), "--to", "ws://127.0.0.1:1"]);
    assert!(error.contains("cannot connect to ws://127.0.0.1:1/"), "{error}");
    assert!(failure(&["send", "--clip", "walk", "--to", &to]).contains("no clip called \"walk\""));
}

#[test]
fn flags_win_over_the_file_and_send_reports() {
    let config = scratch("good.toml", b"listen = \"256.1.1.1:1\"\n[limits]\nrooms = 1\nviewers_per_room = 2\n");
    let served = serve(&["--config", config.to_str().unwrap(), "--max-viewers", "1"]);
    let _first = view(&served, "");
    let mut second = view(&served, "");
    let refused = second.read().unwrap();
    assert!(refused.to_text().unwrap().contains("the room has 1 viewers already"), "{refused}");
    let feed = scratch("three.jsonl", b"{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n{\"type\":\"frame\",\"t\":9,\"weights\":{}}\n{\"type\":\"calibrate\"}\n");
    let output = run(&["send", feed.to_str().unwrap(), "--to", &format!("ws://{}", served.address), "--speed", "max"]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && stderr.contains("sent 2 frames, none refused"), "{stderr}");
}

#[test]
fn refused_frames_make_send_fail_and_say_how_many() {
    let served = serve(&[]);
    let feed = scratch(
        "refused.jsonl",
        b"{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n{\"type\":\"frame\",\"t\":1,\"bones\":{\"tail\":[0,0,0]}}\n",
    );
    let output = run(&["send", feed.to_str().unwrap(), "--to", &format!("ws://{}", served.address), "--speed", "max"]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success(), "{stderr}");
    assert_eq!(stderr.lines().last(), Some("error: sent 2 frames, of all messages the server refused 1"), "{stderr}");
}

#[test]
fn a_clip_of_the_character_moves_the_viewers_bones() {
    let (glb, _) = clip_fixture::with_clip();
    let character = scratch("clip.glb", &glb);
    let character = character.to_str().unwrap();
    let served = serve(&["--character", character]);
    let mut viewer = view(&served, "?format=json");
    let to = format!("ws://{}", served.address);
    let sender = program(&["send", "--clip", "nod", "--character", character, "--to", &to]).stderr(Stdio::piped()).spawn().unwrap();
    let mut rest = Vec::new();
    let last = loop {
        let message = viewer.read().expect("frames come");
        let Message::Text(text) = message else { continue };
        match serde_json::from_str(&text).expect("a message that this version knows") {
            ViewMessage::Hello(hello) => rest = hello.character.bones,
            ViewMessage::Frame(frame) if frame.t >= 0.9999 => break frame,
            ViewMessage::Frame(_) => {}
            ViewMessage::Error { code, message } => panic!("{code}: {message}"),
        }
    };
    let output = sender.wait_with_output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && stderr.contains("sent 61 frames, none refused"), "{stderr}");
    for (i, (bone, point)) in rest.iter().zip(&last.bones).enumerate() {
        let rise = if i == 0 { 0.008 } else { 0.0 };
        let wanted = [bone.rest[0], bone.rest[1] + rise, bone.rest[2]];
        let is_there = wanted.iter().zip(point).all(|(wanted, got)| (wanted - got).abs() < 1e-4);
        assert!(is_there, "{} is at {point:?}, expected {wanted:?}", bone.name);
    }
    // A turn of 0.4 rad about +Y.
    assert!((last.head.rotation[1] - 0.2_f32.sin()).abs() < 2e-3, "{:?}", last.head);
    assert!(last.influence.iter().any(|of_pose| of_pose[0] > 0.1), "the brow wrinkles: {:?}", last.influence);
}

#[cfg(unix)]
#[test]
fn a_sender_that_is_interrupted_closes_its_session() {
    let served = serve(&[]);
    let feed = scratch(
        "slow.jsonl",
        b"{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n{\"type\":\"frame\",\"t\":9000,\"weights\":{}}\n",
    );
    let mut viewer = view(&served, "");
    let to = format!("ws://{}", served.address);
    let mut sender = Process::start(program(&["send", feed.to_str().unwrap(), "--to", &to]).stderr(Stdio::null()));
    // Its first frame has come: the next one is due in hours.
    while !matches!(viewer.read().unwrap(), Message::Binary(_)) {}
    signal::signal(&sender, signal::Signal::INT);
    assert_eq!(sender.wait().unwrap().code(), Some(0));
    let (_, text) = http::ask(&served.address, "GET", "/metrics", &[], "").unwrap();
    assert!(text.contains("rhytid_sessions_ended_total{reason=\"closed\"} 1\n"), "{text}");
}

#[test]
fn more_is_logged_with_verbose() {
    let log = |args: &[&str]| {
        let mut served = serve(args);
        let mut viewer = view(&served, "");
        while !matches!(viewer.read().unwrap(), Message::Text(_)) {}
        served.kill();
        served.log()
    };
    let (plain, verbose) = (log(&[]), log(&["-v"]));
    assert!(plain.contains("serving") && !plain.contains("viewer connects"), "{plain}");
    assert!(verbose.contains("serving") && verbose.contains("viewer connects"), "{verbose}");
}

#[cfg(target_os = "linux")]
#[cfg(unix)]
#[test]
fn a_viewer_that_talks_without_end_is_sent_away_and_one_that_commands_nobody_is_slowed() {
    let server = serve(&[]);
    let mut quiet = view(&server, "");
    let mut viewer = view(&server, "");
    for _ in 0..1000 {
        // It may be gone before all are sent, and its last word lost with them.
        let _ = viewer.send(Message::text("hear me"));
    }
    let count = || {
        let metrics = http::ask(&server.address, "GET", "/metrics", &[], "").unwrap().1;
        metrics.lines().any(|line| line.contains("\"too_fast\"") && line.ends_with(" 1")).then_some(())
    };
    process::wait_for("its end", count);
    // A second's worth of pings of one's own is fine.
    for _ in 0..50 {
        quiet.send(Message::Ping("still there?".into())).unwrap();
    }
    let mut num_pongs = 0;
    while num_pongs < 1 {
        num_pongs += usize::from(quiet.read().unwrap().is_pong());
    }
    // Two seconds' worth of commands to a slot that nobody has.
    let start = Instant::now();
    let mut control = socket::open(&server.address, "demo/control", &[], PATIENCE).unwrap();
    for _ in 0..100 {
        control.send(Message::text(r#"{"type":"calibrate"}"#)).unwrap();
    }
    let mut num_refused = 0;
    while num_refused < 100 {
        num_refused += usize::from(control.read().unwrap().to_text().is_ok_and(|text| text.contains("no_source")));
    }
    assert!(start.elapsed().as_secs_f64() > 1.5, "{:?}", start.elapsed());
}

#[test]
fn a_closed_standard_output_is_no_end() {
    // Writing to this device always fails.
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut child = Process::start(program(&["serve", "--listen", "127.0.0.1:0"]).stdout(full).stderr(Stdio::piped()));
    let mut log = BufReader::new(child.stderr.take().unwrap()).lines();
    let said = log.by_ref().map(|line| line.unwrap()).find(|line| line.contains("cannot write to standard output"));
    assert!(said.is_some(), "it says so");
    assert!(log.any(|line| line.unwrap().contains("serving")), "and serves");
}

/// Bytes of the server's memory that each of many viewers takes, once all have got frames.
#[cfg(target_os = "linux")]
fn memory_of_viewers(query: &str) -> f64 {
    use rustix::process::{Resource, getrlimit, setrlimit};
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    setrlimit(Resource::Nofile, limit).unwrap();
    let most = limit.maximum.map_or(2000, |maximum| (maximum.saturating_sub(200)).min(2000)) as usize;

    let served = serve(&[]);
    let connect = |count: usize| -> Vec<WebSocket<TcpStream>> {
        (0..count)
            .map(|_| {
                let mut viewer = view(&served, query);
                while !matches!(viewer.read().unwrap(), Message::Text(_)) {}
                viewer.flush().unwrap();
                viewer
            })
            .collect()
    };
    // The first ones pay for what all share.
    let _first = connect(20);
    let before = memory::resident(&served.process);
    let mut viewers = connect(most);
    // A few frames, so that every buffer has been used.
    let mut publisher = socket::open(&served.address, "demo/publish", &[], PATIENCE).unwrap();
    publisher.send(Message::text(r#"{"type":"hello","version":1}"#)).unwrap();
    publisher.read().unwrap();
    let start = Instant::now();
    for i in 0..20 {
        publisher
            .send(Message::text(format!(
                r#"{{"type":"frame","t":{},"weights":{{"jawOpen":{}}}}}"#,
                f64::from(i) * 0.04,
                f64::from(i) * 0.05
            )))
            .unwrap();
        std::thread::sleep((start + Duration::from_millis(40) * i as u32).saturating_duration_since(Instant::now()));
    }
    for viewer in &mut viewers {
        while !matches!(viewer.read().unwrap(), Message::Binary(_) | Message::Text(_)) {}
    }
    let bytes = memory::resident(&served.process).saturating_sub(before) as f64 / most as f64;
    println!("{most} viewers{query}: {bytes:.0} bytes of memory each");
    bytes
}

#[cfg(target_os = "linux")]
#[test]
fn a_viewer_takes_less_than_16_kib() {
    let bytes = memory_of_viewers("");
    assert!(bytes <= 16.0 * 1024.0, "{bytes} bytes a viewer");
}

#[cfg(target_os = "linux")]
#[test]
fn a_json_viewer_takes_less_than_32_kib() {
    let bytes = memory_of_viewers("?format=json");
    assert!(bytes <= 32.0 * 1024.0, "{bytes} bytes a viewer");
}
