//! What a bad peer hears.

use super::harness::{Client, Server};
use std::io::{Read, Write};
use std::time::{Duration, Instant};
use tungstenite::Message;
use tungstenite::protocol::frame::coding::CloseCode;

/// A client's frame (RFC 6455, 5.2) with a mask of zeros, which leaves the payload as it is: `first` holds FIN and the
/// opcode, `len` is the length it claims.
fn raw_frame(first: u8, len: usize, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![first, 0x80 | 127];
    bytes.extend((len as u64).to_be_bytes());
    bytes.extend([0; 4]);
    bytes.extend(payload);
    bytes
}

/// FIN and the opcode of a text message.
const WHOLE_TEXT: u8 = 0x81;

/// A publisher of 68 landmarks.
fn landmark_publisher(server: &Server, room: &str) -> Client {
    let mut publisher = server.publisher(room);
    publisher.send(r#"{"type":"hello","version":1,"layout":"ibug68","image":[640,480]}"#);
    let ready = publisher.text();
    assert!(ready.contains("ready"), "{ready}");
    publisher
}

#[test]
fn bad_frames_are_answered_and_the_session_goes_on() {
    let server = Server::start();
    let mut publisher = landmark_publisher(&server, "demo");
    let frame = |t: f64, point: &str, count: usize| format!(r#"{{"type":"frame","t":{t},"landmarks":[{}]}}"#, vec![point; count].join(","));
    publisher.send(r#"{"type":"frame","t":1,"weights":{"jawOpen":0.5}}"#);
    let cases = [
        (r#"{"type":"frame","t":2"#.to_owned(), "malformed_json", "not JSON"),
        (frame(2.0, "[1,2]", 67), "wrong_count", "has 67 points, expected 68"),
        (frame(2.0, "[1,NaN]", 68), "malformed_json", "in field landmarks"),
        (frame(2.0, "[1,1e999]", 68), "malformed_json", "in field landmarks"),
        (frame(2.0, "[1,1e30]", 68), "out_of_range", "landmarks[0]"),
        (frame(1.0, "[1,2]", 68), "time_order", "field t is 1"),
        (frame(0.5, "[1,2]", 68), "time_order", "field t is 0.5"),
        (r#"{"type":"frame","t":2,"weights":{"jawOpen":-1000}}"#.to_owned(), "out_of_range", "weights.jawOpen"),
        (r#"{"type":"record","t":2}"#.to_owned(), "unknown_type", "\"record\""),
        (r#"{"type":"hello","version":1}"#.to_owned(), "repeated_hello", "one hello"),
        ("null".to_owned(), "wrong_type", "JSON object"),
    ];
    for (text, code, says) in &cases {
        publisher.send(text);
        let (got, message) = publisher.error();
        assert_eq!(got, *code, "{text}: {message}");
        assert!(message.contains(says), "{text}: {message}");
    }
    publisher.socket.send(Message::binary(vec![1, 2, 3])).unwrap();
    assert_eq!(publisher.error().0, "wrong_length");
    // Still there, and what was bad did not move its clock.
    let mut viewer = server.viewer("demo");
    publisher.send(r#"{"type":"frame","t":1.5,"weights":{"jawOpen":0.5},"unheard":{"of":[1,2]}}"#);
    while viewer.frame.seq < 1 {
        assert!(viewer.next_packet());
    }
    assert_eq!(viewer.frame.captured_at_micros, 1_500_000);
    let dropped: f64 = ["malformed_json", "wrong_count", "out_of_range", "time_order", "wrong_length"]
        .iter()
        .map(|reason| server.metric(&format!("rhytid_frames_dropped_total{{reason=\"{reason}\"}}")))
        .sum();
    assert_eq!(dropped, 9.0);
}

#[test]
fn bad_hellos_end_the_session_with_their_reason() {
    let server = Server::start();
    for (text, code, says) in [
        (r#"{"type":"frame","t":0,"face":false}"#, "no_hello", "first message must be"),
        (r#"{"type":"hello","version":7}"#, "unknown_version", "version is 7"),
        (r#"{"type":"hello","version":1,"layout":"dlib81","image":[1,1]}"#, "unknown_layout", "dlib81"),
        (
            r#"{"type":"hello","version":1,"layout":["brow_inner_l","nose_hair"],"image":[9,9]}"#,
            "unknown_layout",
            "layout[1] is \"nose_hair\"",
        ),
        ("hello", "malformed_json", "not JSON"),
    ] {
        let mut publisher = server.publisher("demo");
        publisher.send(text);
        let (got, message) = publisher.error();
        assert_eq!(got, code, "{text}: {message}");
        assert!(message.contains(says), "{text}: {message}");
        let close = publisher.close_frame();
        assert_eq!(close.code, CloseCode::Policy);
        assert!(message.starts_with(close.reason.as_str()), "the close says the same");
    }
    let mut publisher = server.publisher("demo");
    publisher.socket.send(Message::binary(vec![0; 10])).unwrap();
    assert_eq!(publisher.error().0, "binary_message");
    assert_eq!(publisher.close_frame().code, CloseCode::Unsupported);
    // None of them has claimed the room.
    server.ready_publisher("demo");
}

#[test]
fn a_takeover_that_cannot_work_leaves_the_old_publisher_alone() {
    let server = Server::start();
    let mut healthy = server.ready_publisher("demo");
    healthy.frame(0.0, 0.5);
    let mut bad = server.publisher("demo");
    bad.send(r#"{"type":"hello","version":1,"takeover":true,"layout":["brow_inner_l"],"image":[640,480]}"#);
    let (code, message) = bad.error();
    assert_eq!(code, "bad_hello");
    assert!(message.starts_with("hello: layout has 1 points, expected at least"), "{message}");
    assert_eq!(bad.close_frame().code, CloseCode::Policy);
    healthy.frame(1.0, 0.5);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["session"] == 1 && room["frame"]["seq"] == 1));
    assert!(!server.room("demo").unwrap()["publisher"].is_null());
}

#[test]
fn a_frame_that_the_solve_refuses_leaves_the_clock_as_it_was() {
    let server = Server::start();
    let mut publisher = landmark_publisher(&server, "demo");
    publisher.send(r#"{"type":"frame","t":1,"weights":{"jawOpen":0.5}}"#);
    // All points in one place are no face, at any time.
    publisher.send(&format!(r#"{{"type":"frame","t":8e9,"landmarks":[{}]}}"#, vec!["[1,2]"; 68].join(",")));
    let (code, message) = publisher.error();
    assert_eq!(code, "bad_frame", "{message}");
    publisher.send(r#"{"type":"frame","t":1.5,"weights":{"jawOpen":0.5}}"#);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["t"] == 1.5));
}

#[test]
fn the_last_word_reaches_a_publisher_that_is_still_writing() {
    let server = Server::start();
    let mut publisher = server.ready_publisher("demo");
    // Far over the limit, and written on and on after the server has said so.
    let len = 1 << 20;
    publisher.socket.get_mut().write_all(&raw_frame(WHOLE_TEXT, len, &[])).unwrap();
    for _ in 0..16 {
        publisher.socket.get_mut().write_all(&vec![b'x'; len / 16]).expect("the server still reads");
        std::thread::sleep(Duration::from_millis(5));
    }
    let (code, message) = publisher.error();
    assert_eq!(code, "too_long", "{message}");
    assert!(message.contains("at most 262144 are allowed"), "{message}");
    let frame = loop {
        if let Message::Close(frame) = publisher.socket.read().unwrap() {
            break frame.unwrap();
        }
    };
    assert_eq!(frame.code, CloseCode::Size);
    assert_eq!(publisher.socket.get_mut().read(&mut [0; 16]).expect("the connection ends, it is not reset"), 0);
}

#[test]
fn text_that_is_not_utf8_and_a_broken_protocol_are_told() {
    let server = Server::start();
    let not_utf8 = raw_frame(WHOLE_TEXT, 3, b"\xff\xfe{");
    // Bits that belong to extensions nobody agreed on, and a continuation of nothing.
    let reserved_bits = raw_frame(WHOLE_TEXT | 0x70, 2, b"{}");
    let continuation = raw_frame(0x80, 2, b"{}");
    for (bytes, code, says, close) in [
        (&not_utf8, "not_utf8", "text message is not UTF-8", CloseCode::Invalid),
        (&reserved_bits, "protocol", "Reserved bits", CloseCode::Protocol),
        (&continuation, "protocol", "Continue frame", CloseCode::Protocol),
    ] {
        let publisher = server.ready_publisher("demo");
        let viewer = server.viewer("demo").client;
        // Before the hello, as publisher and as viewer it is the same.
        for mut client in [server.publisher("other"), publisher, viewer] {
            // With more behind it, which nobody will read.
            client.socket.get_mut().write_all(&[bytes.as_slice(), &[0x55; 5000]].concat()).unwrap();
            let (got, message) = client.error();
            assert_eq!(got, code, "{message}");
            assert!(message.contains(says), "{message}");
            assert_eq!(client.close_frame().code, close);
        }
    }
}

#[test]
fn a_viewer_that_says_too_much_is_told() {
    let server = Server::start();
    let mut viewer = server.viewer("demo");
    viewer.client.send(&"x".repeat(1024));
    viewer.client.send(&"x".repeat(1025));
    let (code, message) = viewer.client.error();
    assert_eq!(code, "too_long");
    assert!(message.contains("at most 1024 are allowed"), "{message}");
    assert_eq!(viewer.client.close_frame().code, CloseCode::Size);
    assert_eq!(server.metric("rhytid_sessions_ended_total{reason=\"too_long\"}"), 1.0);
}

#[test]
fn bad_messages_are_held_back_like_frames() {
    let server = Server::with(|config| config.limits.frames_per_second = 50);
    let mut publisher = server.ready_publisher("demo");
    let start = Instant::now();
    for _ in 0..60 {
        publisher.send("{}");
    }
    let mut codes = vec![];
    while codes.len() < 61 {
        codes.push(publisher.error().0);
    }
    assert_eq!(codes.iter().filter(|code| *code == "too_fast").count(), 1);
    assert!(start.elapsed().as_secs_f64() > 0.9, "60 messages at 50 a second took {:?}", start.elapsed());
}

#[test]
fn calibrations_in_a_flood_are_refused() {
    let server = Server::start();
    let mut publisher = server.ready_publisher("demo");
    publisher.frame(0.0, 0.1);
    for _ in 0..50 {
        publisher.send(r#"{"type":"calibrate"}"#);
    }
    let (mut num_taken, mut num_refused) = (0, 0);
    while num_taken + num_refused < 50 {
        let answer: serde_json::Value = serde_json::from_str(&publisher.text()).unwrap();
        match answer["type"].as_str().unwrap() {
            "calibrated" => num_taken += 1,
            _ => {
                assert_eq!(answer["code"], "too_many_calibrations", "{answer}");
                assert!(answer["message"].as_str().unwrap().contains("more than 2 calibrations a second"), "{answer}");
                num_refused += 1;
            }
        }
    }
    assert!(num_taken >= 1 && num_refused >= 20, "{num_taken} taken, {num_refused} refused");
    publisher.frame(1.0, 0.1);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == 1));
}

#[test]
fn a_publisher_that_reads_no_answers_loses_its_room() {
    let server = Server::with(|config| {
        config.timeouts.publisher_idle = 0.5;
        (config.limits.bad_frames_in_a_row, config.limits.frames_per_second) = (1_000_000, 1_000_000);
    });
    let mut publisher = server.ready_publisher("demo");
    // Answers fill its buffers until the server cannot write, so it reads nothing more either.
    let flood = std::thread::spawn(move || {
        publisher.socket.get_ref().set_write_timeout(Some(Duration::from_secs(20))).unwrap();
        while publisher.socket.send(Message::text("{}")).is_ok() {}
    });
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["publisher"].is_null()));
    server.wait_for_metric("rhytid_sessions_ended_total{reason=\"idle\"}", |count| count == 1.0);
    flood.join().unwrap();
}

#[test]
fn a_hundred_bad_frames_in_a_row_end_the_session() {
    // A rate that nobody reaches.
    let server = Server::with(|config| config.limits.frames_per_second = 1_000_000);
    let mut publisher = server.ready_publisher("demo");
    for _ in 0..99 {
        publisher.send("{}");
        publisher.error();
    }
    publisher.frame(1.0, 0.5);
    for _ in 0..100 {
        publisher.send("{}");
        assert_eq!(publisher.error().0, "missing_field");
    }
    let (code, message) = publisher.error();
    assert_eq!(code, "too_many_bad_frames");
    assert!(message.starts_with("100 bad messages in a row, the last one: field type"), "{message}");
    assert_eq!(publisher.close_frame().code, CloseCode::Policy);
}

#[test]
fn messages_over_the_limit_end_the_session() {
    let server = Server::start();
    let mut publisher = server.ready_publisher("demo");
    let long = format!(r#"{{"type":"frame","t":1,"face":false,"pad":"{}"}}"#, "x".repeat(200 << 10));
    publisher.send(&long);
    let longer = long.replace("\"t\":1", "\"t\":2").replace("xxx", "xxxxx");
    assert!(longer.len() > 256 << 10);
    publisher.send(&longer);
    let (code, message) = publisher.error();
    assert_eq!(code, "too_long");
    assert!(message.contains("at most 262144 are allowed"), "{message}");
    assert_eq!(publisher.close_frame().code, CloseCode::Size);
    assert_eq!(server.metric("rhytid_frames_in_total"), 1.0);
}

#[test]
fn limits_are_told() {
    let server = Server::with(|config| {
        (config.limits.rooms, config.limits.viewers_per_room, config.limits.frames_per_second) = (1, 1, 50);
        config.timeouts.hello = 0.5;
    });
    let _viewer = server.viewer("demo");
    for (path, code, says) in
        [("/v1/rooms/demo/view", "too_many_viewers", "1 viewers already"), ("/v1/rooms/other/view", "too_many_rooms", "1 rooms already")]
    {
        let mut refused = server.connect(path, &[]).unwrap();
        let (got, message) = refused.error();
        assert_eq!(got, code);
        assert!(message.contains(says), "{message}");
        assert_eq!(refused.close_frame().code, CloseCode::Again);
    }
    let mut publisher = server.publisher("other");
    publisher.send(r#"{"type":"hello","version":1}"#);
    assert_eq!(publisher.error().0, "too_many_rooms");
    // Says no hello.
    let mut silent = server.publisher("demo");
    assert_eq!(silent.error(), ("hello_timeout".into(), "no hello within 0.5 seconds".into()));
    // Too fast: told once, slowed, and no frame is lost.
    let mut publisher = server.ready_publisher("demo");
    let start = Instant::now();
    for i in 0..60 {
        publisher.frame(f64::from(i), 0.5);
    }
    let (code, message) = publisher.error();
    assert_eq!(code, "too_fast");
    assert!(message.contains("more than 50 messages a second"), "{message}");
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == 59));
    assert!(start.elapsed().as_secs_f64() > 0.9, "60 frames at 50 a second took {:?}", start.elapsed());
}
