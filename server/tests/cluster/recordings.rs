//! Recordings among nodes: made at one, seen at all.

use super::http;
use super::nats::Nats;
use super::nodes::{HELLO, Node};
use super::process::wait_for;
use super::watch::Watch;
use serde_json::{Value, json};
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
    for k in 0..60 {
        publisher.frame(f64::from(k) / 60.0);
        std::thread::sleep(Duration::from_millis(10));
    }
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
