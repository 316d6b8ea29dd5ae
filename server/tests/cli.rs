//! Facts about the program itself: its first line, its end, its errors, its memory.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod clip_fixture;

use rhytid_shared::view::ViewMessage;
use std::io::{BufRead, BufReader, Read};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

const PROGRAM: &str = env!("CARGO_BIN_EXE_rhytid-server");

/// A server process that ends with the test.
struct Served {
    child: Child,
    address: String,
    stdout: BufReader<ChildStdout>,
}

impl Served {
    fn start(args: &[&str]) -> Self {
        let mut child = Command::new(PROGRAM)
            .args(["serve", "--listen", "127.0.0.1:0"])
            .args(args)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("the program starts");
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        let mut line = String::new();
        stdout.read_line(&mut line).expect("it prints a line");
        let address = line.trim().strip_prefix("listening on http://").expect("its first line says where it listens").to_owned();
        Self { child, address, stdout }
    }

    /// A viewer's socket; `room` may have a query behind it.
    fn view(&self, room: &str) -> WebSocket<TcpStream> {
        let (name, query) = room.split_at(room.find('?').unwrap_or(room.len()));
        let stream = TcpStream::connect(&self.address).expect("it listens");
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        tungstenite::client(format!("ws://{}/v1/rooms/{name}/view{query}", self.address), stream).expect("it upgrades").0
    }

    #[cfg(unix)]
    fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_raw(self.child.id() as i32).expect("not 0");
        rustix::process::kill_process(pid, signal).expect("it still runs");
    }

    #[cfg(target_os = "linux")]
    fn resident_kib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("it still runs");
        let line = status.lines().find(|line| line.starts_with("VmRSS:")).expect("Linux says so");
        line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).expect("a number of KiB")
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn run(args: &[&str]) -> Output {
    Command::new(PROGRAM).args(args).output().expect("the program starts")
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
    use rustix::process::Signal;
    for signal in [Signal::INT, Signal::TERM] {
        let mut served = Served::start(&[]);
        let mut viewer = served.view("demo");
        assert!(matches!(viewer.read(), Ok(Message::Ping(_))));
        assert!(matches!(viewer.read(), Ok(Message::Text(_))));
        served.signal(signal);
        let close = loop {
            match viewer.read().expect("a close frame comes") {
                Message::Close(frame) => break frame.expect("with a reason"),
                _ => continue,
            }
        };
        assert_eq!((close.code, close.reason.as_str()), (CloseCode::Away, "server is shutting down"));
        // Answers the close.
        while viewer.read().is_ok() {}
        assert_eq!(served.child.wait().unwrap().code(), Some(0), "{signal:?}");
        let mut rest = String::new();
        served.stdout.read_to_string(&mut rest).unwrap();
        assert_eq!(rest, "", "standard output has one line");
    }
}

#[test]
fn what_cannot_work_says_so_in_one_line() {
    let served = Served::start(&[]);
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
    let served = Served::start(&["--config", config.to_str().unwrap(), "--max-viewers", "1"]);
    let _first = served.view("demo");
    let mut second = served.view("demo");
    let refused = second.read().unwrap();
    assert!(refused.to_text().unwrap().contains("the room has 1 viewers already"), "{refused}");
    let feed = scratch("three.jsonl", b"{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n{\"type\":\"frame\",\"t\":9,\"weights\":{}}\n{\"type\":\"calibrate\"}\n");
    let output = run(&["send", feed.to_str().unwrap(), "--to", &format!("ws://{}", served.address), "--speed", "max"]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && stderr.contains("sent 2 frames, none refused"), "{stderr}");
}

#[test]
fn refused_frames_make_send_fail_and_say_how_many() {
    let served = Served::start(&[]);
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
    let served = Served::start(&["--character", character]);
    let mut viewer = served.view("demo?format=json");
    let to = format!("ws://{}", served.address);
    let sender = Command::new(PROGRAM)
        .args(["send", "--clip", "nod", "--character", character, "--to", &to])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
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
    let served = Served::start(&[]);
    let feed = scratch(
        "slow.jsonl",
        b"{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n{\"type\":\"frame\",\"t\":9000,\"weights\":{}}\n",
    );
    let mut viewer = served.view("demo");
    let mut sender = Command::new(PROGRAM)
        .args(["send", feed.to_str().unwrap(), "--to", &format!("ws://{}", served.address)])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // Its first frame has come: the next one is due in hours.
    while !matches!(viewer.read().unwrap(), Message::Binary(_)) {}
    let pid = rustix::process::Pid::from_raw(sender.id() as i32).expect("not 0");
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    assert_eq!(sender.wait().unwrap().code(), Some(0));
    let mut stream = TcpStream::connect(&served.address).unwrap();
    std::io::Write::write_all(&mut stream, format!("GET /metrics HTTP/1.0\r\nHost: {}\r\n\r\n", served.address).as_bytes()).unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    assert!(text.contains("rhytid_sessions_ended_total{reason=\"closed\"} 1\n"), "{text}");
}

#[test]
fn more_is_logged_with_verbose() {
    let log = |args: &[&str]| {
        let mut child = Command::new(PROGRAM)
            .args(["serve", "--listen", "127.0.0.1:0"])
            .args(args)
            .env_remove("RUST_LOG")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line.trim().strip_prefix("listening on http://").unwrap();
        let stream = TcpStream::connect(address).unwrap();
        let (mut viewer, _) = tungstenite::client(format!("ws://{address}/v1/rooms/demo/view"), stream).unwrap();
        while !matches!(viewer.read().unwrap(), Message::Text(_)) {}
        child.kill().unwrap();
        let mut log = String::new();
        child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        child.wait().unwrap();
        log
    };
    let (plain, verbose) = (log(&[]), log(&["-v"]));
    assert!(plain.contains("serving") && !plain.contains("viewer connects"), "{plain}");
    assert!(verbose.contains("serving") && verbose.contains("viewer connects"), "{verbose}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_closed_standard_output_is_no_end() {
    // Writing to this device always fails.
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut child = Command::new(PROGRAM).args(["serve", "--listen", "127.0.0.1:0"]).stdout(full).stderr(Stdio::piped()).spawn().unwrap();
    let mut log = BufReader::new(child.stderr.take().unwrap()).lines();
    let said = log.by_ref().map(|line| line.unwrap()).find(|line| line.contains("cannot write to standard output"));
    assert!(said.is_some(), "it says so");
    assert!(log.any(|line| line.unwrap().contains("serving")), "and serves");
    child.kill().unwrap();
    child.wait().unwrap();
}

/// Bytes of the server's memory that each of many viewers takes, once all have got frames.
#[cfg(target_os = "linux")]
fn memory_of_viewers(query: &str) -> f64 {
    use rustix::process::{Resource, getrlimit, setrlimit};
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    setrlimit(Resource::Nofile, limit).unwrap();
    let most = limit.maximum.map_or(2000, |maximum| (maximum.saturating_sub(200)).min(2000)) as usize;

    let served = Served::start(&[]);
    let connect = |count: usize| -> Vec<WebSocket<TcpStream>> {
        (0..count)
            .map(|_| {
                let mut viewer = served.view(&format!("demo{query}"));
                while !matches!(viewer.read().unwrap(), Message::Text(_)) {}
                viewer.flush().unwrap();
                viewer
            })
            .collect()
    };
    // The first ones pay for what all share.
    let _first = connect(20);
    let before = served.resident_kib();
    let mut viewers = connect(most);
    // A few frames, so that every buffer has been used.
    let stream = TcpStream::connect(&served.address).unwrap();
    let (mut publisher, _) = tungstenite::client(format!("ws://{}/v1/rooms/demo/publish", served.address), stream).unwrap();
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
    let bytes = served.resident_kib().saturating_sub(before) as f64 * 1024.0 / most as f64;
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
