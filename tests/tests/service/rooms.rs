//! Publishers, viewers and what lies between them.

use super::harness::{Client, Server, Viewer};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::{load_character, solve::SolveConfig};
use rhytid_shared::view::JsonFrame;
use rhytid_shared::{PublishMessage, PublishReader, TrackingFrame};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, Instant};
use tungstenite::Message;
use tungstenite::protocol::frame::coding::CloseCode;

/// Frame of the built-in session after which the face is lost: mid-expression, as it is fifty frames later.
const LOST_FROM: usize = 300;

/// Calls `act` with 0, 1, …, one each `interval`.
fn paced(count: u32, interval: Duration, mut act: impl FnMut(u32)) {
    let start = Instant::now();
    for i in 0..count {
        std::thread::sleep((start + interval * i).saturating_duration_since(Instant::now()));
        act(i);
    }
}

#[test]
fn fifty_viewers_see_one_face_and_nobody_hurts_another() {
    const FRAMES: u32 = 150;
    const LAST_T: u64 = 149 * 40_000;
    let server = Server::start();
    let readers: Vec<_> = (0..47)
        .map(|_| {
            let mut viewer = server.viewer("demo");
            std::thread::spawn(move || {
                let mut num_frames = 0;
                let mut last = None;
                while viewer.frame.captured_at_micros < LAST_T && viewer.next_packet() {
                    assert!(last.is_none_or(|last| viewer.frame.seq > last), "frames come in their order");
                    last = Some(viewer.frame.seq);
                    num_frames += 1;
                }
                (num_frames, viewer.frame.seq, viewer.frame.points.clone())
            })
        })
        .collect();
    let mut asleep = server.viewer("demo");
    let gone = server.viewer("demo");
    assert_eq!(server.room("demo").unwrap()["viewers"], 49);
    let mut gone = Some(gone);
    let mut late = None;
    let mut publisher = server.ready_publisher("demo");
    paced(FRAMES, Duration::from_millis(20), |i| {
        publisher.frame(f64::from(i) * 0.04, (f64::from(i) * 0.1).sin().abs());
        if i == 30 {
            // Without a close, as when a laptop's lid shuts.
            drop(gone.take());
        }
        if i == 100 {
            late = Some(server.viewer("demo"));
        }
    });
    let mut late = late.unwrap();
    while late.frame.captured_at_micros < LAST_T {
        assert!(late.next_packet());
    }
    for reader in readers {
        let (num_frames, seq, points) = reader.join().unwrap();
        assert_eq!((seq, &points), (FRAMES - 1, &late.frame.points), "all see the same face at the end");
        assert!(num_frames >= 75, "a reading viewer saw only {num_frames} of {FRAMES} frames");
    }
    // The sleeper wakes: a few old frames, then the newest.
    let mut num_frames = 0;
    while asleep.frame.captured_at_micros < LAST_T {
        assert!(asleep.next_packet());
        num_frames += 1;
    }
    assert!(num_frames <= 40, "the sleeper found {num_frames} frames");
    server.wait_for_metric("rhytid_frames_dropped_total{reason=\"slow_viewer\"}", |count| count >= 50.0);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["viewers"].as_u64() <= Some(2)));
}

#[test]
fn a_late_viewer_gets_the_last_frame_at_once() {
    let server = Server::start();
    let mut publisher = server.ready_publisher("demo");
    for i in 0..30 {
        publisher.frame(f64::from(i) * 0.04, f64::from(i) * 0.03);
    }
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == 29));
    // No other frame comes: what it gets, it gets for having joined.
    let mut late = server.viewer("demo");
    let mut num_packets = 0;
    while late.frame.seq < 29 {
        assert!(late.next_packet());
        num_packets += 1;
    }
    assert!(num_packets <= 2, "the key packet it needs and the newest, not {num_packets}");
    assert_eq!(server.json_viewer("demo").next_json().seq, 29);
}

/// Publishes `count` frames after number `from`, 20 ms apart or more.
fn publish_slowly(publisher: &mut Client, from: u32, count: u32) {
    for i in from..from + count {
        std::thread::sleep(Duration::from_millis(20));
        publisher.frame(f64::from(i) * 0.02, f64::from(i % 50) * 0.02);
    }
}

#[test]
fn a_viewer_that_sleeps_finds_half_a_second_of_old_frames_and_the_newest() {
    const AWAKE: u32 = 25;
    const ASLEEP: u32 = 100;
    let server = Server::start();
    let mut viewer = server.viewer("demo");
    let mut publisher = server.ready_publisher("demo");
    let mut next = 0;
    // A busy machine can only make it find more, by handing over several frames at once: the least of three sleeps counts.
    let num_old = (0..3).map(|_| {
        for _ in 0..AWAKE {
            publish_slowly(&mut publisher, next, 1);
            while viewer.frame.seq < next {
                assert!(viewer.next_packet());
            }
            next += 1;
        }
        // Two seconds of frames, far fewer than fit the kernel's buffers.
        publish_slowly(&mut publisher, next, ASLEEP);
        let last_awake = viewer.frame.seq;
        next += ASLEEP;
        server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == next - 1));
        let mut old = BTreeSet::new();
        while viewer.frame.seq < next - 1 {
            assert!(viewer.next_packet());
            old.insert(viewer.frame.seq);
        }
        // Key packets may come a second time.
        old.range(last_awake + 1..next - 1).count()
    });
    let num_old = num_old.min().unwrap();
    assert!(num_old <= 25, "{num_old} old frames of 20 ms");
}

#[test]
fn a_viewer_that_has_never_answered_a_ping_finds_little_too() {
    let server = Server::start();
    // It reads nothing, not even the first ping.
    let silent = server.connect("/v1/rooms/demo/view", &[]).unwrap();
    let mut publisher = server.ready_publisher("demo");
    publish_slowly(&mut publisher, 0, 200);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == 199));
    let mut viewer = Viewer::new(silent);
    let mut old = BTreeSet::new();
    while viewer.frame.seq < 199 {
        assert!(viewer.next_packet());
        old.insert(viewer.frame.seq);
    }
    let num_old = old.range(..199).count();
    // Fifteen in its window, one a second after that, and as much again for a busy machine.
    assert!((2..=40).contains(&num_old), "{num_old} old frames of 200");
}

#[test]
fn a_taken_room_is_refused_and_takeover_takes_it() {
    let server = Server::start();
    let mut viewer = server.viewer("demo");
    let mut first = server.ready_publisher("demo");
    for i in 0..3 {
        first.frame(f64::from(i), 0.5);
    }
    while viewer.frame.seq < 2 {
        assert!(viewer.next_packet());
    }

    let mut second = server.publisher("demo");
    second.send(r#"{"type":"hello","version":1,"source":"two"}"#);
    let (code, message) = second.error();
    assert_eq!(code, "room_taken");
    assert!(message.contains("\"takeover\":true"), "{message}");
    assert_eq!(second.close_frame().code, CloseCode::Policy);

    let mut third = server.publisher("demo");
    third.send(r#"{"type":"hello","version":1,"source":"three","takeover":true}"#);
    assert!(third.text().contains(r#""session":2"#));
    let (code, message) = first.error();
    assert_eq!((code.as_str(), message.as_str()), ("taken_over", "another publisher has taken the room over"));
    first.close_frame();
    third.frame(0.0, 0.1);
    while viewer.frame.session < 2 {
        assert!(viewer.next_packet());
    }
    assert_eq!((viewer.frame.seq, viewer.frame.captured_at_micros), (0, 0), "a new session starts anew");
    assert_eq!(server.room("demo").unwrap()["publisher"]["source"], "three");
}

#[test]
fn a_face_that_drops_out_is_said_to_be_lost_and_comes_back() {
    let server = Server::start();
    let mut viewer = server.json_viewer("demo");
    let mut publisher = server.ready_publisher("demo");
    for i in 0..90 {
        let t = f64::from(i) * 0.04;
        if (30..60).contains(&i) {
            publisher.send(&format!(r#"{{"type":"frame","t":{t},"face":false}}"#));
        } else {
            publisher.frame(t, 0.8);
        }
        let frame = viewer.next_json();
        assert_eq!((frame.seq, frame.face), (i, !(30..60).contains(&i)));
        assert!((frame.t - t).abs() <= 0.5e-6, "{} is not {t}", frame.t);
        assert_eq!(frame.influence.len(), viewer.hello.character.poses.len());
        assert!(frame.influence.iter().all(|row| row.len() == viewer.hello.character.bones.len()));
        if i == 59 {
            // Held for 250 ms and eased for 500: at rest by now.
            for (bone, point) in viewer.hello.character.bones.iter().zip(&frame.bones) {
                let far = bone.rest.iter().zip(point).any(|(rest, point)| (rest - point).abs() > 5e-5);
                assert!(!far, "{} is not back at rest: {point:?}", bone.name);
            }
        }
    }
}

/// Sends a feed's lines and takes a frame for each, as fast as both ends can.
fn play(server: &Server, room: &str, lines: &[String]) -> (Vec<JsonFrame>, Vec<[f32; 3]>) {
    let mut viewer = server.json_viewer(room);
    let mut publisher = server.publisher(room);
    publisher.send(&lines[0]);
    assert!(publisher.text().contains("ready"));
    let mut frames = Vec::new();
    for (i, line) in lines[1..].iter().enumerate() {
        publisher.send(line);
        frames.push(viewer.next_json());
        assert_eq!(frames[i].seq as usize, i, "every frame is seen");
    }
    (frames, viewer.hello.character.bones.iter().map(|bone| bone.rest).collect())
}

/// The largest distance between two faces' points, metres.
fn farthest(a: &[[f32; 3]], b: &[[f32; 3]]) -> f32 {
    let distance = |(a, b): (&[f32; 3], &[f32; 3])| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
    a.iter().zip(b).map(distance).fold(0.0, f32::max)
}

#[test]
fn a_tracker_that_loses_the_face_holds_eases_and_returns_without_a_jump() {
    // The built-in session, with two seconds cut out of a wide expression.
    let text = include_str!("../../../shared/assets/demo.ibug68.jsonl");
    let lost = LOST_FROM..LOST_FROM + 50;
    let lines: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(i, line)| match i.checked_sub(1).filter(|i| lost.contains(i)) {
            Some(_) => {
                let frame: Value = serde_json::from_str(line).unwrap();
                format!(r#"{{"type":"frame","t":{},"face":false}}"#, frame["t"])
            }
            None => line.to_owned(),
        })
        .collect();
    let server = Server::start();
    let (frames, rest) = play(&server, "cut", &lines[..lost.end + 50]);
    for (i, frame) in frames.iter().enumerate() {
        assert_eq!(frame.face, !lost.contains(&i), "frame {i}");
    }
    let last = &frames[lost.start - 1];
    let depth = farthest(&last.bones, &rest);
    assert!(depth > 2e-3, "the face is {depth} m away from rest, too little to see it ease");
    let since = |i: usize| frames[i].t - last.t;
    for i in lost.clone() {
        let left = farthest(&frames[i].bones, &rest);
        if since(i) <= 0.25 {
            assert_eq!((&frames[i].bones, &frames[i].head), (&last.bones, &last.head), "held at {i}");
        } else if since(i) >= 0.8 {
            assert!(left < 5e-5, "at rest at {i}, not {left} m away");
        } else {
            assert!(left <= farthest(&frames[i - 1].bones, &rest) + 5e-5, "eases at {i}");
            assert!(farthest(&frames[i].bones, &frames[i - 1].bones) < depth / 2.0, "no jump at {i}");
        }
    }
    // It comes back within a quarter of a second, blended in.
    let back = lost.end..lost.end + 10;
    let height = back.clone().map(|i| farthest(&frames[i].bones, &rest)).fold(0.0, f32::max);
    assert!(height > 2e-3, "the face that returns is {height} m away from rest");
    for i in back {
        let step = farthest(&frames[i].bones, &frames[i - 1].bones);
        assert!(step < height / 2.0, "a step of {step} m at {i} towards a face {height} m away");
    }
}

#[test]
fn a_face_that_appears_late_appears_without_a_jump() {
    // A recorded session that stands beside the checkout on some machines; the built-in one with its first seconds cut elsewhere.
    let recorded = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/feeds/dropout.ibug68.jsonl");
    let text = std::fs::read_to_string(recorded).unwrap_or_else(|_| {
        let text = include_str!("../../../shared/assets/demo.ibug68.jsonl");
        let blank = |i: usize| format!(r#"{{"type":"frame","t":{},"face":false}}"#, i as f64 * 0.04);
        let mut lines = text.lines().map(str::to_owned).take(200).collect::<Vec<_>>();
        (1..=90).for_each(|i| lines[i] = blank(i - 1));
        lines.join("\n")
    });
    let lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let server = Server::start();
    let (frames, rest) = play(&server, "demo", &lines);
    let first = frames.iter().position(|frame| frame.face).expect("a face appears");
    assert!(first > 50);
    for (i, frame) in frames[..first].iter().enumerate() {
        assert!(farthest(&frame.bones, &rest) < 5e-5, "at rest before there is a face, at {i}");
    }
    for i in first..frames.len() {
        let step = farthest(&frames[i].bones, &frames[i - 1].bones);
        // While it is blended in; later a blink may be faster.
        assert!(i >= first + 10 || step < 2e-3, "a step of {step} m at {i}");
        if !frames[i].face && frames[i - 1].face {
            assert_eq!(frames[i].bones, frames[i - 1].bones, "held at {i}");
        }
    }
    let moved = frames[first..].iter().map(|frame| farthest(&frame.bones, &rest)).fold(0.0, f32::max);
    assert!(moved > 1e-3, "the face moves, by {moved} m");
}

#[test]
fn packets_are_those_of_the_pipeline_at_any_speed() {
    let lines: Vec<String> = (0..60)
        .map(|i| format!(r#"{{"type":"frame","t":{},"weights":{{"jawOpen":{}}}}}"#, f64::from(i) * 0.04, f64::from(i % 10) * 0.1))
        .collect();
    let hello = r#"{"type":"hello","version":1}"#;
    let (character, _) = load_character(None).unwrap();
    let (mut reader, mut frame) = (PublishReader::new(&character), TrackingFrame::default());
    let Ok(PublishMessage::Hello(said)) = reader.read(hello, &mut frame) else { panic!("a good hello") };
    let mut pipeline = Pipeline::new(character, &SolveConfig::default(), &said, 1).unwrap();
    let wanted: Vec<Vec<u8>> = lines
        .iter()
        .map(|line| {
            let mut packet = Vec::new();
            reader.read(line, &mut frame).unwrap();
            pipeline.frame(&frame, &mut packet).unwrap();
            packet
        })
        .collect();

    let server = Server::start();
    for (room, pause) in [("fast", 0), ("slow", 15)] {
        let mut viewer = server.viewer(room);
        let mut publisher = server.publisher(room);
        publisher.send(hello);
        publisher.text();
        for line in &lines {
            publisher.send(line);
            std::thread::sleep(Duration::from_millis(pause));
        }
        let mut got = Vec::new();
        while got.last() != wanted.last() {
            got.push(viewer.next_bytes());
        }
        assert!(got.iter().all(|packet| wanted.contains(packet)), "{room}: a packet the pipeline did not make");
    }
}

#[test]
fn a_publisher_that_vanishes_frees_its_room() {
    let server = Server::with(|config| (config.timeouts.ping, config.timeouts.publisher_idle) = (0.1, 0.5));
    // Its connection is cut without a close frame.
    let publisher = server.ready_publisher("cut");
    drop(publisher);
    server.wait_for_room("cut", |room| room.is_some_and(|room| room["publisher"].is_null()));
    server.ready_publisher("cut");
    // Its connection stays and says nothing: pings are not answered, because nobody reads them.
    let mut silent = server.ready_publisher("silent");
    server.wait_for_room("silent", |room| room.is_some_and(|room| room["publisher"].is_null()));
    let (code, message) = silent.error();
    assert_eq!((code.as_str(), message.as_str()), ("idle", "nothing heard for 0.5 seconds"));
    silent.close_frame();
    server.ready_publisher("silent");
}

#[test]
fn a_publisher_that_answers_pings_may_be_silent() {
    let server = Server::with(|config| (config.timeouts.ping, config.timeouts.publisher_idle) = (0.1, 0.5));
    let mut publisher = server.ready_publisher("demo");
    publisher.socket.get_ref().set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(1500) {
        // A time-out is no failure here; a ping is answered with the next read.
        let _ = publisher.socket.read();
    }
    assert!(!server.room("demo").unwrap()["publisher"].is_null());
}

#[test]
fn a_viewer_that_never_reads_is_ended_and_the_others_see_every_frame() {
    let server = Server::with(|config| (config.timeouts.ping, config.timeouts.viewer_idle) = (0.1, 1.0));
    let mut deaf = server.viewer("demo");
    let mut viewer = server.viewer("demo");
    let mut publisher = server.ready_publisher("demo");
    for i in 0..100u32 {
        publisher.frame(f64::from(i), 0.5);
        while viewer.frame.seq < i {
            assert!(viewer.next_packet());
        }
        std::thread::sleep(Duration::from_millis(15));
    }
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["viewers"] == 1));
    let said = loop {
        if let Message::Text(text) = deaf.client.socket.read().unwrap() {
            break text;
        }
    };
    assert!(said.contains("no pong for 1 seconds"), "{said}");
    drop(viewer);
}

#[test]
fn empty_rooms_are_removed() {
    let server = Server::with(|config| config.timeouts.room_idle = 0.2);
    let publisher = server.ready_publisher("demo");
    let viewer = server.viewer("demo");
    std::thread::sleep(Duration::from_millis(600));
    assert!(server.room("demo").is_some(), "a room in use stays");
    drop((publisher, viewer));
    server.wait_for_room("demo", |room| room.is_none());
    assert_eq!(server.metric("rhytid_rooms"), 0.0);
}

#[test]
fn an_orderly_end_tells_every_socket_why() {
    let mut server = Server::start();
    let mut viewer = server.viewer("demo");
    let mut publisher = server.ready_publisher("demo");
    let mut undecided = server.publisher("demo");
    publisher.frame(0.0, 0.2);
    assert!(viewer.next_packet());
    server.stop();
    for client in [&mut viewer.client, &mut publisher, &mut undecided] {
        let frame = client.close_frame();
        assert_eq!((frame.code, frame.reason.as_str()), (CloseCode::Away, "server is shutting down"));
    }
    let start = Instant::now();
    server.wait();
    assert!(start.elapsed() < Duration::from_secs(2), "it ends with its last socket");
}

#[test]
fn a_calibration_is_answered() {
    let server = Server::start();
    let mut publisher = server.ready_publisher("demo");
    for i in 0..50 {
        publisher.frame(f64::from(i) * 0.04, 0.1);
    }
    publisher.send(r#"{"type":"calibrate"}"#);
    let answer: Value = serde_json::from_str(&publisher.text()).unwrap();
    assert_eq!((answer["type"].as_str(), answer["requested"].as_bool()), (Some("calibrated"), Some(true)), "{answer}");
    assert!(answer["t"].as_f64().is_some() && answer["frames"].as_u64().is_some(), "{answer}");
}

#[test]
fn session_of_a_server_that_was_started_anew_takes_no_strangers_slot() {
    let ready = |server: &Server, more: &Value| {
        let mut hello = json!({"type": "hello", "version": 1});
        hello.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        let mut publisher = server.publisher("demo");
        publisher.send(&hello.to_string());
        let answer: Value = serde_json::from_str(&publisher.text()).unwrap();
        (publisher, answer)
    };
    let before = Server::start();
    let (_own, told) = ready(&before, &json!({}));
    let (session, key) = (told["session"].clone(), told["resume_key"].clone());
    assert!(key.as_str().is_some_and(|key| key.len() == 32), "{told}");
    // Its connection breaks off, and its ghost gives way to it alone.
    let (_stranger, refused) = ready(&before, &json!({"resume": session, "resume_key": "0".repeat(32)}));
    assert_eq!(refused["code"], "room_taken", "{refused}");
    let (_back, told) = ready(&before, &json!({"resume": session, "resume_key": key}));
    assert_eq!(told["type"], "ready", "{told}");

    // Another start, where a stranger has come first: with the same number.
    let anew = Server::start();
    let (mut stranger, told) = ready(&anew, &json!({}));
    assert_eq!(told["session"], session);
    for resume in [json!({"resume": session, "resume_key": key}), json!({"resume": session})] {
        let (_own, refused) = ready(&anew, &resume);
        assert_eq!(refused["code"], "room_taken", "{resume}: {refused}");
    }
    let mut viewer = anew.json_viewer("demo");
    stranger.frame(1.0, 0.3);
    assert_eq!(viewer.next_json().session, 1);
}
