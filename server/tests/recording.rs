//! Facts about recordings: they verify, they survive what kills their writer, they are small, they can be entered anywhere, and no
//! bytes break their reader.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::recording::{
    Entry, Faces, Recording, RecordingWriter, SessionEvent, Topic, VerifyError, export_csv, export_gltf, recover, verify,
};
use rhytid_server::{load_character, solve::SolveConfig};
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::view::ViewHello;
use rhytid_shared::{Character, FaceFrame, TrackingData, TrackingFrame};
use serde_json::Value;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

const PROGRAM: &str = env!("CARGO_BIN_EXE_rhytid-server");

fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl")
}

/// A folder that goes with the test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("rhytid-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Its only recording.
    fn recording(&self) -> PathBuf {
        let mut files: Vec<PathBuf> = std::fs::read_dir(&self.0).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.retain(|path| path.extension().is_some_and(|extension| extension == "mcap"));
        assert_eq!(files.len(), 1, "{files:?}");
        files.remove(0)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A server process that ends with the test.
struct Served {
    child: Child,
    address: String,
}

impl Served {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line.trim().strip_prefix("listening on http://").unwrap_or_else(|| panic!("first line {line:?}")).to_owned();
        Self { child, address }
    }

    fn serve(args: &[&str]) -> Self {
        Self::start(Command::new(PROGRAM).args(["serve", "--listen", "127.0.0.1:0"]).args(args))
    }

    fn recording_into(folder: &Folder) -> Self {
        Self::serve(&["--record", folder.0.to_str().unwrap()])
    }

    fn url(&self) -> String {
        format!("ws://{}", self.address)
    }

    fn request(&self, method: &str, path: &str, body: &str) -> (u16, String) {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        let length = body.len();
        write!(stream, "{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n{body}")
            .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        let status = answer.split(' ').nth(1).unwrap().parse().unwrap();
        (status, answer.split_once("\r\n\r\n").unwrap().1.to_owned())
    }

    fn json(&self, method: &str, path: &str, body: &str) -> Value {
        let (status, text) = self.request(method, path, body);
        assert_eq!(status, 200, "{method} {path}: {text}");
        serde_json::from_str(&text).unwrap()
    }

    fn metric(&self, name: &str) -> f64 {
        let text = self.request("GET", "/metrics", "").1;
        let line = text.lines().find(|line| line.starts_with(&format!("{name} "))).unwrap_or_else(|| panic!("{name} in {text}"));
        line.rsplit(' ').next().unwrap().parse().unwrap()
    }

    fn send(&self, args: &[&str]) -> Output {
        Command::new(PROGRAM).args(["send", demo().to_str().unwrap(), "--to", &self.url()]).args(args).output().unwrap()
    }

    /// Publishes the demo again and again until it is dropped.
    fn keep_sending(&self, speed: &str) -> Killed {
        let mut command = Command::new(PROGRAM);
        command.args(["send", demo().to_str().unwrap(), "--loop", "--speed", speed, "--to", &self.url()]);
        Killed(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    }

    /// Ends it in order.
    fn end(mut self) {
        let pid = rustix::process::Pid::from_raw(self.child.id() as i32).unwrap();
        rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
        assert!(self.child.wait().unwrap().success());
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A process that is killed when it is dropped.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run(args: &[&str]) -> Output {
    Command::new(PROGRAM).args(args).output().unwrap()
}

fn says(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

fn wait_for(what: &str, mut is_so: impl FnMut() -> bool) {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < Duration::from_secs(20), "waited for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A number from 0 to 1 that looks random.
fn noise(seed: u64) -> f64 {
    let mut x = seed.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (x ^ (x >> 31)) as f64 / u64::MAX as f64
}

const SECOND: u64 = 1_000_000_000;
const BEGIN: u64 = 1_700_000_000 * SECOND;

fn begin(character: &Character) -> SessionEvent {
    let hello = ViewHello::new("demo", character, "/characters/default.glb".into());
    SessionEvent::Recording { version: 1, room: "demo".into(), server: "test".into(), character: Box::new(hello.character), clock: 0 }
}

/// Frames of the demo, `fps` a second by interpolation.
fn resampled(character: &Character, fps: f64) -> (rhytid_shared::PublishHello, Vec<TrackingFrame>) {
    let mut feed = Feed::open(&demo(), character).unwrap();
    let (mut frame, mut frames) = (TrackingFrame::default(), Vec::new());
    while let Some(item) = feed.next_frame(&mut frame).unwrap() {
        if item == FeedItem::Frame {
            frames.push(frame.clone());
        }
    }
    let (start, end) = (frames[0].t, frames.last().unwrap().t);
    let at = |i: usize| {
        let t = start + i as f64 / fps;
        let after = frames.partition_point(|frame| frame.t <= t).clamp(1, frames.len() - 1);
        let (a, b) = (&frames[after - 1], &frames[after]);
        let mix = ((t - a.t) / (b.t - a.t)) as f32;
        let data = match (&a.data, &b.data) {
            (TrackingData::Landmarks { points: p, .. }, TrackingData::Landmarks { points: q, .. }) => TrackingData::Landmarks {
                points: p.iter().zip(q).map(|(p, q)| std::array::from_fn(|i| p[i] + (q[i] - p[i]) * mix)).collect(),
                confidence: Vec::new(),
            },
            (other, _) => other.clone(),
        };
        TrackingFrame::new(t, data)
    };
    let frames = (0..((end - start) * fps) as usize).map(at).collect();
    (feed.hello, frames)
}

/// Writes the packets of `frames`, each at its own time, chunks as a server closes them. Gives the faces.
fn write_packets(path: &Path, character: &Arc<Character>, hello: &rhytid_shared::PublishHello, frames: &[TrackingFrame]) -> Vec<FaceFrame> {
    let mut pipeline = Pipeline::new(character.clone(), &SolveConfig::default(), hello, 1).unwrap();
    let mut writer = RecordingWriter::to(File::create(path).unwrap(), PacketLayout::from(&**character)).unwrap();
    writer.event(BEGIN, &begin(character)).unwrap();
    let (mut faces, mut flushed) = (Vec::new(), 0.0);
    for frame in frames {
        let mut packet = Vec::new();
        let kind = pipeline.frame(frame, &mut packet).unwrap();
        faces.push(pipeline.face().clone());
        // 0.7 s, or 0.5 s and a key packet.
        let age = frame.t - flushed;
        if age >= 0.7 || (age >= 0.5 && kind == rhytid_shared::packet::PacketKind::Key) {
            writer.flush().unwrap();
            flushed = frame.t;
        }
        let jitter = (noise(faces.len() as u64) * 300_000.0) as u64;
        writer.packet(BEGIN + (frame.t * 1e9) as u64 + jitter, packet.into());
    }
    writer.finish().unwrap();
    faces
}

/// Writes `entries` as a recording.
fn rewrite(path: &Path, entries: &[Entry], character: &Character) {
    let mut writer = RecordingWriter::to(File::create(path).unwrap(), PacketLayout::from(character)).unwrap();
    for entry in entries {
        match entry.topic {
            Topic::Packets => {
                let mut reader = rhytid_shared::packet::BatchReader::new(character);
                reader.unpack(&entry.data, |at, packet| writer.packet(at * 1000, packet.to_vec().into())).unwrap();
                writer.flush().unwrap();
            }
            _ => writer.message(&entry.topic, entry.log_time, None, &entry.data).unwrap(),
        }
    }
    writer.finish().unwrap();
}

fn entries(path: &Path) -> Vec<Entry> {
    let mut recording = Recording::open(path).unwrap();
    (0..recording.chunks().len()).flat_map(|index| recording.read_chunk(index).unwrap()).collect()
}

#[test]
fn a_recorded_session_gives_the_same_bytes_again_and_a_changed_one_names_the_difference() {
    let folder = Folder::new("verify");
    let served = Served::recording_into(&folder);
    assert!(served.send(&["--speed", "max"]).status.success());
    assert_eq!(served.metric("rhytid_recordings"), 1.0);
    served.end();
    let path = folder.recording();
    let verified = run(&["verify", path.to_str().unwrap()]);
    assert!(
        verified.status.success() && says(&verified).contains("501 frames of 1 sessions give the recorded bytes"),
        "{}",
        says(&verified)
    );

    // One landmark of one frame is another.
    let (character, _) = load_character(None).unwrap();
    let mut entries = entries(&path);
    let frames: Vec<usize> = (0..entries.len()).filter(|i| matches!(entries[*i].topic, Topic::Text(_))).collect();
    let entry = &mut entries[frames[301]];
    let mut message: Value = serde_json::from_slice(&entry.data).unwrap();
    let t = message["t"].as_f64().unwrap();
    message["landmarks"][21][1] = (message["landmarks"][21][1].as_f64().unwrap() + 3.0).into();
    entry.data = message.to_string().into();
    let changed = folder.path("changed.mcap");
    rewrite(&changed, &entries, &character);
    let Err(VerifyError::Different(difference)) = verify(&mut Recording::open(&changed).unwrap(), &character) else { panic!("it differs") };
    assert!(difference.t == t && difference.seq == 300 && difference.what.contains("bone "), "{difference}");
    assert_ne!(difference.recorded, difference.solved);
    let verified = run(&["verify", changed.to_str().unwrap()]);
    assert!(!verified.status.success() && says(&verified).contains("first difference at t = 12."), "{}", says(&verified));

    // As a feed, too.
    let feed = Feed::open(&path, &character).unwrap();
    assert_eq!(feed.hello.source, "rhytid demo session");
}

/// The demo with `fields` in its hello and `others` before frames of these numbers, as a file.
fn changed_demo(path: &Path, fields: &Value, others: &[(usize, &str)], frames: std::ops::Range<usize>) {
    let text = std::fs::read_to_string(demo()).unwrap();
    let mut lines = text.lines();
    let mut hello: Value = serde_json::from_str(lines.next().unwrap()).unwrap();
    hello.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
    let mut out = hello.to_string() + "\n";
    for (index, line) in lines.enumerate().filter(|(index, _)| frames.contains(index)) {
        for (_, other) in others.iter().filter(|(before, _)| *before == index) {
            out += &format!("{other}\n");
        }
        out += &format!("{line}\n");
    }
    std::fs::write(path, out).unwrap();
}

fn without(entries: &[Entry], is_left_out: impl Fn(&Entry) -> bool) -> Vec<Entry> {
    entries.iter().filter(|entry| !is_left_out(entry)).cloned().collect()
}

#[test]
fn a_room_of_two_slots_gives_the_same_bytes_again() {
    let folder = Folder::new("slots");
    let (camera, phone) = (folder.path("camera.jsonl"), folder.path("phone.jsonl"));
    let camera_slot = serde_json::json!({ "slot": "camera", "priority": 40 });
    changed_demo(&camera, &camera_slot, &[], 0..500);
    // It comes later and leaves earlier: each time the brows are handed over.
    changed_demo(&phone, &serde_json::json!({ "slot": "phone", "priority": 60, "groups": ["brows", "head"] }), &[], 100..260);
    let served = Served::recording_into(&folder);
    let send = |path: &Path| {
        let mut command = Command::new(PROGRAM);
        command.args(["send", path.to_str().unwrap(), "--speed", "3", "--to", &served.url()]);
        Killed(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    };
    let mut first = send(&camera);
    wait_for("frames", || served.metric("rhytid_frames_in_total") > 60.0);
    let mut second = send(&phone);
    assert!(first.0.wait().unwrap().success() && second.0.wait().unwrap().success());
    served.end();

    let path = folder.recording();
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut Recording::open(&path).unwrap(), &character).unwrap();
    println!("{report:?}");
    assert!(report.sessions == 2 && report.frames >= 450 && report.not_compared + report.cut == 0, "{report:?}");
    let entries = entries(&path);
    for slot in ["camera", "phone"] {
        let num = entries.iter().filter(|entry| entry.topic == Topic::Text(slot.into())).count();
        assert!(num > 160, "{slot}: {num} messages");
    }
    // The leads' clocks make sessions of their own: camera, phone, camera.
    let mut faces = Faces::new(Recording::open(&path).unwrap());
    let mut sessions = Vec::new();
    while faces.advance().unwrap().is_some() {
        sessions.push(faces.frame().session);
    }
    sessions.dedup();
    assert!(sessions.len() >= 3, "{sessions:?}");

    // Without what the phone sent it comes out otherwise, and so it does in another order.
    let changed = folder.path("changed.mcap");
    let is_phone = |entry: &Entry| matches!(&entry.topic, Topic::Text(slot) if slot == "phone");
    rewrite(&changed, &without(&entries, is_phone), &character);
    assert!(matches!(verify(&mut Recording::open(&changed).unwrap(), &character), Err(VerifyError::Different(_))));

    // Both are published again beside each other.
    let second = Served::serve(&[]);
    let replayed = run(&["replay", path.to_str().unwrap(), "--server", &second.url(), "--speed", "4"]);
    assert!(replayed.status.success() && says(&replayed).contains("sent 660 frames"), "{}", says(&replayed));
    assert_eq!(second.metric("rhytid_frames_in_total"), 660.0);
}

#[test]
fn binary_frames_give_the_same_bytes_again() {
    let folder = Folder::new("binary");
    let served = Served::recording_into(&folder);
    assert!(served.send(&["--speed", "max", "--binary"]).status.success());
    served.end();
    let path = folder.recording();
    let entries = entries(&path);
    let binary: Vec<&Entry> = entries.iter().filter(|entry| entry.topic == Topic::Binary("main".into())).collect();
    assert_eq!(binary.len(), 501, "as bytes");
    assert!(binary.iter().all(|entry| entry.data[0] == 1 && entry.data.len() == 28 + 68 * 4), "as they were sent");
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut Recording::open(&path).unwrap(), &character).unwrap();
    assert_eq!((report.frames, report.sessions, report.not_compared), (501, 1, 0));
    // One point of one frame is another.
    let mut other = entries.clone();
    let frame = other.iter_mut().filter(|entry| matches!(entry.topic, Topic::Binary(_))).nth(300).unwrap();
    frame.data[28 + 21 * 4 + 3] ^= 0x10;
    let changed = folder.path("changed.mcap");
    rewrite(&changed, &other, &character);
    let Err(VerifyError::Different(difference)) = verify(&mut Recording::open(&changed).unwrap(), &character) else { panic!("it differs") };
    assert_eq!(difference.seq, 300, "{difference}");
    // As a feed they are text.
    let second = Served::serve(&[]);
    let replayed = run(&["replay", path.to_str().unwrap(), "--server", &second.url(), "--speed", "max"]);
    assert!(replayed.status.success() && says(&replayed).contains("sent 501 frames"), "{}", says(&replayed));
}

#[test]
fn settings_changed_in_the_middle_give_the_same_bytes_again() {
    let folder = Folder::new("settings");
    let feed = folder.path("feed.jsonl");
    let settings = r#"{"type":"settings","mirror":true,"gains":{"brows":1.7},"smoothing":{"mouth":2.5}}"#;
    let others = [(150, settings), (250, r#"{"type":"recentre"}"#), (350, r#"{"type":"calibrate"}"#)];
    changed_demo(&feed, &serde_json::json!({ "settings": { "gains": { "mouth": 0.8 } } }), &others, 0..501);
    let served = Served::recording_into(&folder);
    let sent = run(&["send", feed.to_str().unwrap(), "--speed", "max", "--to", &served.url()]);
    assert!(sent.status.success(), "{}", says(&sent));
    served.end();
    let path = folder.recording();
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut Recording::open(&path).unwrap(), &character).unwrap();
    assert_eq!((report.frames, report.not_compared), (501, 0));
    let entries = entries(&path);
    for (_, other) in others {
        assert!(entries.iter().any(|entry| entry.data == other.as_bytes()), "{other} stands there as it was sent");
    }
    let changed = folder.path("changed.mcap");
    for (before, other) in others {
        rewrite(&changed, &without(&entries, |entry| entry.data == other.as_bytes()), &character);
        let Err(VerifyError::Different(difference)) = verify(&mut Recording::open(&changed).unwrap(), &character) else {
            panic!("without {other} it differs")
        };
        assert!((before..before + 30).contains(&(difference.seq as usize)), "without {other}: {difference}");
    }
}

#[test]
fn a_recording_may_begin_and_end_in_the_middle_of_a_session() {
    let folder = Folder::new("middle");
    let served = Served::serve(&["--record", folder.0.to_str().unwrap(), "--record-rooms", "none"]);
    assert_eq!(served.request("POST", "/api/rooms/demo/record/stop", "").0, 409);
    let sending = served.keep_sending("1.0");
    wait_for("frames", || served.metric("rhytid_frames_in_total") > 10.0);
    let begun = served.json("POST", "/api/rooms/demo/record/start", "");
    assert!(begun["recording"]["file"].as_str().unwrap().starts_with("demo-"), "{begun}");
    assert_eq!(served.request("POST", "/api/rooms/demo/record/start", "").0, 409, "once");
    std::thread::sleep(Duration::from_millis(1500));
    assert!(served.json("GET", "/api/rooms", "")["rooms"][0]["recording"]["bytes"].as_u64().unwrap() > 1000);
    served.json("POST", "/api/rooms/demo/record/stop", "");
    wait_for("its end", || served.metric("rhytid_recordings") == 0.0);
    let listed = served.json("GET", "/api/recordings", "");
    assert_eq!(listed["recordings"].as_array().unwrap().len(), 1);
    drop(sending);
    let recording = Recording::open(&folder.recording()).unwrap();
    assert_eq!(recording.cut_off(), None, "it is finished");
    let mut faces = Faces::new(recording);
    let mut num = 0;
    while faces.advance().unwrap().is_some() {
        num += 1;
    }
    assert!(num > 20 && faces.num_unreadable() == 0, "{num} faces, {} unreadable", faces.num_unreadable());
    let verified = run(&["verify", folder.recording().to_str().unwrap()]);
    assert!(!verified.status.success() && says(&verified).contains("nothing in it can be solved again"), "{}", says(&verified));
    // Another site's page may not.
    let mut stream = TcpStream::connect(&served.address).unwrap();
    let origin = "Origin: http://evil.example\r\nConnection: close\r\nContent-Length: 0\r\n\r\n";
    write!(stream, "POST /api/rooms/demo/record/start HTTP/1.1\r\nHost: localhost\r\n{origin}").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
}

#[test]
fn a_hundred_kills_lose_the_last_second_at_most() {
    let folder = Folder::new("kills");
    let served = Served::serve(&[]);
    let _sending = served.keep_sending("1.0");
    wait_for("frames", || served.metric("rhytid_frames_in_total") > 2.0);
    let now = || SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    let (mut worst, mut num_cut, mut num_faces) = (0.0f64, 0, 0);
    for round in 0..5 {
        let mut children: Vec<(f64, PathBuf, Killed)> = (0..20)
            .map(|i| {
                let path = folder.path(&format!("{round}-{i}.mcap"));
                let mut command = Command::new(PROGRAM);
                command.args(["record", path.to_str().unwrap(), "--server", &served.url()]);
                let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
                (now() + 0.02 + 2.5 * noise(round * 20 + i), path, Killed(child))
            })
            .collect();
        children.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (at, path, mut child) in children {
            std::thread::sleep(Duration::from_secs_f64((at - now()).max(0.0)));
            let killed = now();
            child.0.kill().unwrap();
            child.0.wait().unwrap();
            if !path.exists() || std::fs::metadata(&path).unwrap().len() < 200 {
                // Killed before its first chunk: younger than a second.
                continue;
            }
            let report = recover(&path, None).unwrap();
            assert!(!report.was_whole);
            num_cut += usize::from(report.cut_off > 0);
            let recording = Recording::open(&path).unwrap();
            assert_eq!(recording.cut_off(), None, "it is mended");
            let start = recording.start() as f64 / 1e9;
            let mut faces = Faces::new(recording);
            let mut last = None;
            while let Some(moment) = faces.advance().unwrap() {
                last = Some(moment.at);
                num_faces += 1;
            }
            assert_eq!(faces.num_unreadable(), 0);
            worst = worst.max(killed - (start + last.unwrap_or(0.0)));
            assert!(recover(&path, None).unwrap().was_whole, "mended once is mended");
        }
    }
    println!("worst loss {worst:.2} s; {num_cut} files were cut inside a chunk; {num_faces} faces in all");
    assert!(num_faces > 500);
    // Half a second more for a machine that has better things to do.
    assert!(worst < 1.5, "{worst} s");
}

#[test]
fn a_killed_server_leaves_recordings_that_verify() {
    let folder = Folder::new("killed");
    let served = Served::recording_into(&folder);
    let sending = served.keep_sending("1.0");
    wait_for("frames", || served.metric("rhytid_frames_in_total") > 60.0);
    drop(served);
    drop(sending);
    let path = folder.recording();
    let verified = run(&["verify", path.to_str().unwrap()]);
    assert!(verified.status.success(), "before it is mended: {}", says(&verified));
    let mended = run(&["recover", path.to_str().unwrap()]);
    assert!(mended.status.success() && says(&mended).contains("kept "), "{}", says(&mended));
    let verified = run(&["verify", path.to_str().unwrap()]);
    assert!(verified.status.success(), "{}", says(&verified));
}

#[test]
fn a_full_disk_ends_the_recording_and_not_the_stream() {
    let folder = Folder::new("full");
    // 64 blocks of 512 or 1,024 bytes.
    let script = format!("ulimit -f 64; exec {PROGRAM} serve --listen 127.0.0.1:0 --record {}", folder.0.display());
    let served = Served::start(Command::new("sh").args(["-c", &script]));
    let sending = served.keep_sending("4.0");
    wait_for("the failure", || served.metric("rhytid_recording_failures_total") >= 1.0);
    let before = served.metric("rhytid_frames_in_total");
    wait_for("more frames", || served.metric("rhytid_frames_in_total") > before + 50.0);
    let recording = &served.json("GET", "/api/rooms", "")["rooms"][0]["recording"];
    assert!(recording["error"].as_str().unwrap().contains("File too large"), "{recording}");
    drop(sending);
    drop(served);
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder.0).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(files.iter().all(|file| std::fs::metadata(file).unwrap().len() > 0), "{files:?}");
    let report = recover(&files[0], None).unwrap();
    assert!(report.packets > 20, "{report:?}");
}

#[test]
fn a_minute_of_packets_at_60_hz_takes_less_than_200_kib() {
    let folder = Folder::new("size");
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 60.0);
    let path = folder.path("size.mcap");
    write_packets(&path, &character, &hello, &frames);
    let seconds = frames.last().unwrap().t - frames[0].t;
    let bytes = std::fs::metadata(&path).unwrap().len() as f64;
    let a_minute = bytes / 1024.0 * 60.0 / seconds;
    println!("{} packets: {a_minute:.0} KiB a minute with expression weights", frames.len());
    assert!(a_minute <= 200.0, "{a_minute} KiB");
}

#[test]
fn an_hour_can_be_entered_anywhere_within_100_ms() {
    let folder = Folder::new("hour");
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 12.5);
    // The same twenty seconds again and again, on one clock.
    let length = frames.last().unwrap().t - frames[0].t + 0.08;
    let hour: Vec<TrackingFrame> = (0..180)
        .flat_map(|round| frames.iter().map(move |frame| TrackingFrame { t: frame.t + round as f64 * length, ..frame.clone() }))
        .collect();
    let path = folder.path("hour.mcap");
    let shown = write_packets(&path, &character, &hello, &hour);
    let opened = Instant::now();
    let recording = Recording::open(&path).unwrap();
    let opening = opened.elapsed();
    assert!(recording.seconds() > 3500.0, "{}", recording.seconds());
    let mut faces = Faces::new(recording);
    let mut worst = Duration::ZERO;
    for i in 0..40 {
        let to = noise(i) * 3500.0;
        let start = Instant::now();
        let found = faces.seek(to).unwrap().unwrap();
        worst = worst.max(start.elapsed());
        assert!(found.at <= to && to - found.at < 0.1, "{to} gave {found:?}");
        // The face that stands there, and no other.
        assert_eq!(faces.frame().captured_at_micros, shown[faces.frame().seq as usize].captured_at_micros);
    }
    println!("opened in {opening:?}, worst of 40 seeks {worst:?}, {} bytes", std::fs::metadata(&path).unwrap().len());
    assert!(opening + worst < Duration::from_millis(100), "opened in {opening:?}, worst seek {worst:?}");
}

#[test]
fn no_bytes_break_the_reader() {
    let folder = Folder::new("hostile");
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 10.0);
    let path = folder.path("whole.mcap");
    write_packets(&path, &character, &hello, &frames[..40]);
    let whole = std::fs::read(&path).unwrap();
    let broken = folder.path("broken.mcap");
    let (mut num_opened, mut num_refused) = (0, 0);
    let mut look = |bytes: &[u8]| {
        std::fs::write(&broken, bytes).unwrap();
        match Recording::open(&broken) {
            Ok(recording) => {
                num_opened += 1;
                let mut faces = Faces::new(recording);
                while let Ok(Some(_)) = faces.advance() {}
                let _ = faces.seek(2.0);
                let _ = verify(&mut Recording::open(&broken).unwrap(), &character);
                let _ = recover(&broken, Some(&folder.path("out.mcap")));
                let _ = std::fs::remove_file(folder.path("out.mcap"));
            }
            Err(error) => {
                num_refused += 1;
                assert!(!error.to_string().contains('\n'), "{error}");
            }
        }
    };
    for i in 0..120 {
        look(&whole[..whole.len() * i / 120]);
    }
    for i in 0..400u64 {
        let mut bytes = whole.clone();
        for k in 0..1 + i % 4 {
            let at = (noise(i * 10 + k) * bytes.len() as f64) as usize;
            // Lengths are where it hurts.
            bytes[at] = if i % 2 == 0 { 0xFF } else { (noise(i * 77 + k) * 256.0) as u8 };
        }
        look(&bytes);
    }
    for bytes in [&b""[..], b"\x89MCAP0\r\n", b"no recording at all", &whole[..9]] {
        look(bytes);
    }
    println!("{num_opened} opened, {num_refused} refused");
    assert!(num_opened > 50 && num_refused > 10);
}

#[test]
fn a_player_stops_seeks_and_goes_on() {
    let folder = Folder::new("player");
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    let path = folder.path("demo.mcap");
    let shown = write_packets(&path, &character, &hello, &frames);
    let served = Served::start(Command::new(PROGRAM).args(["replay", path.to_str().unwrap(), "--packets", "--listen", "127.0.0.1:0"]));
    let status = || served.json("GET", "/api/rooms/demo/replay", "")["replay"].clone();
    wait_for("it to move", || status()["position"].as_f64().unwrap() > 0.3);
    assert_eq!(status()["playing"], true);
    served.json("POST", "/api/rooms/demo/replay", r#"{"playing":false,"position":12.5}"#);
    wait_for("it to stand", || status()["playing"] == false && status()["position"] == 12.5);
    // What a viewer sees is what was recorded there.
    let watched = folder.path("watched.mcap");
    let recorded = run(&["record", watched.to_str().unwrap(), "--server", &served.url(), "--seconds", "0.5"]);
    assert!(recorded.status.success(), "{}", says(&recorded));
    let mut faces = Faces::new(Recording::open(&watched).unwrap());
    let mut num = 0;
    let expected = &shown[frames.partition_point(|frame| frame.t <= 12.5) - 1];
    while faces.advance().unwrap().is_some() {
        num += 1;
        let worst = faces.frame().points.iter().zip(&expected.points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(worst < 0.001, "{worst} m from the recorded face");
    }
    assert!(num >= 5, "a face that stands is sent again: {num}");
    let before = served.json("GET", "/api/rooms", "")["rooms"][0]["session"].as_u64().unwrap();
    served.json("POST", "/api/rooms/demo/replay", r#"{"playing":true,"position":1.0,"speed":4.0}"#);
    wait_for("it to go on", || status()["position"].as_f64().unwrap() > 3.0);
    let after = served.json("GET", "/api/rooms", "")["rooms"][0]["session"].as_u64().unwrap();
    assert_eq!(after, before + 1, "a jump begins a session");
    for (body, code) in [(r#"{"speed":0}"#, 400), (r#"{"position":-1}"#, 400), (r#"{"sped":1}"#, 400), (r#"{"file":"../x.mcap"}"#, 403)] {
        assert_eq!(served.request("POST", "/api/rooms/demo/replay", body).0, code, "{body}");
    }
    assert_eq!(served.request("POST", "/api/rooms/other/replay", r#"{"playing":true}"#).0, 409);
    served.json("DELETE", "/api/rooms/demo/replay", "");
    wait_for("the room to be free", || served.json("GET", "/api/rooms", "")["rooms"][0]["publisher"].is_null());
}

#[test]
fn a_recording_is_published_again() {
    let folder = Folder::new("again");
    let first = Served::recording_into(&folder);
    assert!(first.send(&["--speed", "max"]).status.success());
    first.end();
    let second = Served::serve(&[]);
    let path = folder.recording();
    let replayed = run(&["replay", path.to_str().unwrap(), "--server", &second.url(), "--speed", "max"]);
    assert!(replayed.status.success() && says(&replayed).contains("sent 501 frames"), "{}", says(&replayed));
    assert_eq!(second.metric("rhytid_frames_in_total"), 501.0);
}

#[test]
fn exports_hold_what_was_recorded() {
    let folder = Folder::new("exports");
    let (character, glb) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    let path = folder.path("demo.mcap");
    let shown = write_packets(&path, &character, &hello, &frames);

    let csv = folder.path("demo.csv");
    let mut out = Vec::new();
    let num = export_csv(&mut Faces::new(Recording::open(&path).unwrap()), [0.0, f64::INFINITY], &mut out).unwrap();
    assert_eq!(num as usize, frames.len());
    assert!(out.starts_with(b"Timecode,BlendShapeCount,EyeBlinkLeft,"));
    let header = out.split(|byte| *byte == b'\n').next().unwrap();
    assert!(header.windows(24).any(|part| part == b"JawForward,JawRight,JawL"), "the order of the app's files");
    std::fs::write(&csv, &out).unwrap();
    let mut feed = Feed::open(&csv, &character).unwrap();
    let (mut frame, mut index) = (TrackingFrame::default(), 0);
    while feed.next_frame(&mut frame).unwrap().is_some() {
        let (TrackingData::Weights { weights, head }, Some(expected)) = (&frame.data, shown[index].shapes) else { panic!("{frame:?}") };
        let worst = weights.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(expected.iter().all(|weight| (0.0..=1.0).contains(weight)), "{expected:?}");
        assert!(worst <= 0.5 / 255.0 + 1e-6, "{worst}");
        // Exact zeros say that the head is not sent.
        let turned = head.unwrap_or_default().rotation.angle_between(shown[index].head.rotation);
        assert!(turned < 0.0015, "{turned}");
        index += 1;
    }
    assert_eq!(index, frames.len());

    let (file, num) = export_gltf(&mut Faces::new(Recording::open(&path).unwrap()), [2.0, 6.0], &character, &glb).unwrap();
    assert!((98..=102).contains(&num), "{num}");
    let gltf = gltf::Gltf::from_slice(&file).unwrap();
    let names: Vec<_> = gltf.animations().filter_map(|animation| animation.name().map(str::to_owned)).collect();
    assert_eq!(names, ["bones", "shapes"]);
    let blob = gltf.blob.as_deref().unwrap();
    let brow = character.bones.iter().position(|bone| bone.name == "brow_inner_l").unwrap();
    let bones = gltf.animations().next().unwrap();
    let channel = bones
        .channels()
        .find(|channel| {
            channel.target().node().name() == Some(&character.bones[brow].joint)
                && channel.target().property() == gltf::animation::Property::Translation
        })
        .expect("the brow moves");
    let reader = channel.reader(|_| Some(blob));
    let times: Vec<f32> = reader.read_inputs().unwrap().collect();
    assert!(times[0] == 0.0 && (times.last().unwrap() - 4.0).abs() < 0.1, "{:?}", times.last());
    let Some(gltf::animation::util::ReadOutputs::Translations(values)) = reader.read_outputs() else { panic!("translations") };
    let rest = gltf::Gltf::from_slice(&glb).unwrap();
    let node = rest.nodes().find(|node| node.name() == Some(&character.bones[brow].joint)).unwrap();
    let at_rest = glam::Vec3::from(node.transform().decomposed().0);
    // The face that stands there: the one of 2.0 s arrives a little later.
    let first = frames.partition_point(|frame| frame.t < 2.0) - 1;
    for (i, value) in values.enumerate() {
        // Below the head's joint, which turns nothing at rest: what the point does in head space.
        let moved = glam::Vec3::from(value) - at_rest;
        let expected = shown[first + i].points[brow] - character.bones[brow].rest;
        assert!(moved.distance(expected) < 5e-5, "key {i}: {moved} is not {expected}");
    }
    let shapes = gltf.animations().nth(1).unwrap();
    let weights = shapes.channels().find(|channel| channel.target().property() == gltf::animation::Property::MorphTargetWeights).unwrap();
    let Some(gltf::animation::util::ReadOutputs::MorphTargetWeights(weights)) = weights.reader(|_| Some(blob)).read_outputs() else {
        panic!("weights")
    };
    assert_eq!(weights.into_f32().count(), times.len() * 52);
}
