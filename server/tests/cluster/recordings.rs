//! Recordings among nodes: made at one, seen at all.

use super::http;
use super::nats::Nats;
use super::nodes::{HELLO, Node, Publisher};
use super::process::wait_for;
use super::signal::{Signal, signal};
use super::watch::Watch;
use rhytid_server::load_character;
use rhytid_server::recording::{Faces, Recording, verify};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::time::Duration;

/// Two nodes; the first keeps recordings, of rooms that it is asked to record.
fn nodes(nats: &Nats) -> [Node; 2] {
    let recordings = nats.folder.path().join("recordings");
    std::fs::create_dir_all(&recordings).unwrap();
    let a = Node::with(&nats.url(), &["--record", recordings.to_str().unwrap(), "--record-rooms", "none"]);
    [a, Node::start(&nats.url())].map(Node::ready)
}

fn ask(node: &Node, method: &str, path: &str, body: &str) -> (u16, Value) {
    let (status, text) = http::ask(&node.address, method, path, &[], body).unwrap();
    (status, serde_json::from_str(&text).unwrap_or_else(|_| panic!("{text}")))
}

/// Records a moment of what somebody publishes to a room of `node`; gives the file's name.
fn record_something(node: &Node, room: &str) -> String {
    let mut publisher = node.publisher(room, HELLO).ready();
    let (status, begun) = ask(node, "POST", &format!("/api/rooms/{room}/record/start"), "");
    assert_eq!(status, 200, "{begun}");
    publish(&mut publisher, 60);
    let (status, ended) = ask(node, "POST", &format!("/api/rooms/{room}/record/stop"), "");
    assert_eq!(status, 200, "{ended}");
    wait_for("the recording's end", || node.get("/metrics")?.lines().any(|line| line == "rhytid_recordings 0").then_some(()));
    ended["recording"]["file"].as_str().unwrap().to_owned()
}

pub fn played_at_one_node_for_all() {
    let nats = Nats::start();
    let [a, b] = nodes(&nats);
    let file = record_something(&a, "take");
    let play = |more: &str| ask(&a, "POST", "/api/rooms/demo/replay", &format!(r#"{{"file":"{file}","loop":true{more}}}"#));
    let (status, playing) = play("");
    assert_eq!(status, 200, "a room that nobody has had: {playing}");
    let watch = Watch::start(&[&b.address], "demo");
    watch.wait_for_more("what is played, at the other node");
    // Every jump is a session of its own, in the same room.
    let (status, jumped) = ask(&a, "POST", "/api/rooms/demo/replay", r#"{"position":0.1}"#);
    assert_eq!(status, 200, "{jumped}");
    watch.wait_for_more("what is played behind a jump");
    // It holds the room as any publisher does.
    let refused = b.publisher("demo", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "{refused}");
    let mut publisher = b.publisher("demo", &HELLO.replace('}', r#","takeover":true}"#)).ready();
    publisher.frame(0.5);
    wait_for("the player's end", || ask(&a, "GET", "/api/rooms/demo/replay", "").1["replay"]["error"].as_str().map(drop));
    let (status, refused) = play("");
    assert_eq!((status, &refused["code"]), (409, &json!("room_taken")), "{refused}");
    let (status, playing) = play(r#","takeover":true"#);
    assert_eq!(status, 200, "{playing}");
    let told = publisher.answer();
    assert_eq!(told["code"], "taken_over", "{told}");
    watch.wait_for_more("what is played once more");
    watch.finish();
    // Sources of other slots keep the room where they are.
    let _phone = b.publisher("other", &HELLO.replace('}', r#","slot":"phone"}"#)).ready();
    let (status, refused) = ask(&a, "POST", "/api/rooms/other/replay", &format!(r#"{{"file":"{file}"}}"#));
    assert_eq!((status, &refused["code"]), (409, &json!("room_elsewhere")), "{refused}");
    assert!(refused["message"].as_str().unwrap().contains(&b.address), "it is said where: {refused}");
}

pub fn faces_of_another_node_are_recorded() {
    let nats = Nats::start();
    let [a, b] = nodes(&nats);
    let mut publisher = b.publisher("demo", HELLO).ready();
    publisher.frame(0.1);
    wait_for("the room's home", || a.room("demo"));
    let (status, begun) = ask(&a, "POST", "/api/rooms/demo/record/start", "");
    assert_eq!(status, 200, "{begun}");
    // Nobody watches here.
    publish(&mut publisher, 200);
    let mut faces = Faces::new(finished(&a, &nats));
    let mut sessions = BTreeSet::new();
    let mut num = 0;
    while faces.advance().unwrap().is_some() {
        num += 1;
        sessions.insert(faces.frame().session);
    }
    assert!(num > 50 && faces.num_unreadable() == 0 && sessions.len() == 1, "{num} faces, {} unreadable", faces.num_unreadable());
}

pub fn take_goes_on_when_its_room_moves() {
    let nats = Nats::start();
    let [a, b] = nodes(&nats);
    let (status, begun) = ask(&a, "POST", "/api/rooms/demo/record/start", "");
    assert_eq!(status, 200, "{begun}");
    let mut first = a.publisher("demo", HELLO).ready();
    publish(&mut first, 60);
    let takeover = HELLO.replace('}', r#","takeover":true}"#);
    let mut second = b.publisher("demo", &takeover).ready();
    publish(&mut second, 200);
    let mut third = a.publisher("demo", &takeover).ready();
    publish(&mut third, 60);
    let mut recording = finished(&a, &nats);
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut recording, &character).unwrap();
    assert_eq!((report.sessions, report.frames), (2, 120), "what was published here gives the same packets: {report:?}");
    assert!(report.not_compared > 50, "what came from there is in it, and no difference: {report:?}");
}

pub fn recording_that_nobody_asked_for_ends_where_its_room_moves() {
    let nats = Nats::start();
    let recordings = [0, 1].map(|node| nats.folder.path().join(format!("recordings-{node}")));
    recordings.iter().for_each(|folder| std::fs::create_dir_all(folder).unwrap());
    let [a, b] = [0, 1].map(|node: usize| Node::with(&nats.url(), &["--record", recordings[node].to_str().unwrap()]).ready());
    let mut first = a.publisher("demo", HELLO).ready();
    publish(&mut first, 30);
    let _watched_here = Watch::start(&[&a.address], "demo");
    let mut second = b.publisher("demo", &HELLO.replace('}', r#","takeover":true}"#)).ready();
    publish(&mut second, 30);
    let is_recording = |node: &Node| node.get("/metrics").unwrap().lines().any(|line| line == "rhytid_recordings 1");
    wait_for("the end of the first", || (!is_recording(&a)).then_some(()));
    assert!(is_recording(&b), "its home records it");
}

pub fn recording_that_nobody_asked_for_ends_where_its_empty_room_is_entered_elsewhere() {
    let nats = Nats::start();
    let recordings = [0, 1].map(|node| nats.folder.path().join(format!("recordings-{node}")));
    recordings.iter().for_each(|folder| std::fs::create_dir_all(folder).unwrap());
    let [a, b] = [0, 1].map(|node: usize| Node::with(&nats.url(), &["--record", recordings[node].to_str().unwrap()]).ready());
    let mut first = a.publisher("demo", HELLO).ready();
    publish(&mut first, 30);
    drop(first);
    // Longer than a node without a publisher stays a room's home.
    std::thread::sleep(Duration::from_secs(4));
    let mut second = b.publisher("demo", HELLO).ready();
    publish(&mut second, 100);
    let is_recording = |node: &Node| node.get("/metrics").unwrap().lines().any(|line| line == "rhytid_recordings 1");
    wait_for("the end of the first", || (!is_recording(&a)).then_some(()));
    assert!(is_recording(&b), "its home records it");
    let file = std::fs::read_dir(&recordings[0]).unwrap().next().unwrap().unwrap().path();
    let mut faces = Faces::new(Recording::open(&file).unwrap());
    while faces.advance().unwrap().is_some() {
        assert_eq!(faces.frame().session, 1, "what was published elsewhere is not in it");
    }
}

pub fn recording_of_another_nodes_room_is_finished_when_its_node_ends() {
    let nats = Nats::start();
    let [mut a, b] = nodes(&nats);
    let mut publisher = b.publisher("demo", HELLO).ready();
    publisher.frame(0.1);
    wait_for("the room's home", || a.room("demo"));
    let (status, begun) = ask(&a, "POST", "/api/rooms/demo/record/start", "");
    assert_eq!(status, 200, "{begun}");
    publish(&mut publisher, 60);
    signal(&a.process, Signal::TERM);
    assert!(a.process.wait().unwrap().success());
    a.kill();
    assert!(!a.log().contains("did not close in time"), "nothing holds it up");
    let file = begun["recording"]["file"].as_str().unwrap();
    let recording = Recording::open(&nats.folder.path().join("recordings").join(file)).unwrap();
    assert_eq!(recording.cut_off(), None, "it is finished");
}

fn publish(publisher: &mut Publisher, frames: u32) {
    for k in 0..frames {
        publisher.frame(f64::from(k % 50) / 50.0);
        std::thread::sleep(Duration::from_millis(10));
    }
    // What was sent last is taken, too.
    std::thread::sleep(Duration::from_millis(200));
}

/// Ends the one recording of the room `demo` and opens it.
fn finished(node: &Node, nats: &Nats) -> Recording {
    let (status, ended) = ask(node, "POST", "/api/rooms/demo/record/stop", "");
    assert_eq!(status, 200, "{ended}");
    wait_for("the recording's end", || node.get("/metrics")?.lines().any(|line| line == "rhytid_recordings 0").then_some(()));
    let recording = Recording::open(&nats.folder.path().join("recordings").join(ended["recording"]["file"].as_str().unwrap())).unwrap();
    assert_eq!(recording.cut_off(), None, "it is finished");
    recording
}
