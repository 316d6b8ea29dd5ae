//! What a bad peer hears.

use super::harness::{Client, Server};
use tungstenite::Message;
use tungstenite::protocol::frame::coding::CloseCode;

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
    assert_eq!(publisher.error().0, "binary_message");
    // Still there, and what was bad did not move its clock.
    let mut viewer = server.viewer("demo");
    publisher.send(r#"{"type":"frame","t":1.5,"weights":{"jawOpen":0.5},"unheard":{"of":[1,2]}}"#);
    while viewer.frame.seq < 1 {
        assert!(viewer.next_packet());
    }
    assert_eq!(viewer.frame.captured_at_micros, 1_500_000);
    let dropped: f64 = ["malformed_json", "wrong_count", "out_of_range", "time_order", "binary_message"]
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
fn a_hundred_bad_frames_in_a_row_end_the_session() {
    let server = Server::start();
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
    let start = std::time::Instant::now();
    for i in 0..60 {
        publisher.frame(f64::from(i), 0.5);
    }
    let (code, message) = publisher.error();
    assert_eq!(code, "too_fast");
    assert!(message.contains("more than 50 frames a second"), "{message}");
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == 59));
    assert!(start.elapsed().as_secs_f64() > 0.9, "60 frames at 50 a second took {:?}", start.elapsed());
}
