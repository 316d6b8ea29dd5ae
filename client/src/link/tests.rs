//! The link against a small server of its own, over real sockets.

#![allow(clippy::result_large_err, reason = "tungstenite's callbacks are declared so")]

use super::*;
use crate::spectator::{Spectator, Status, StatusKind, TokenArgs, WatchArgs};
use rhytid_shared::packet::{Encoder, PacketLayout};
use rhytid_shared::trust::Trust;
use rhytid_shared::view::{BoneHello, CharacterHello, PROTOCOL_VERSION, PoseHello, SUBPROTOCOL, ViewMessage};
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tungstenite::http::{HeaderValue, StatusCode};
use tungstenite::{Message, WebSocket};

type Socket = WebSocket<TcpStream>;

struct TestServer {
    listener: TcpListener,
}

impl TestServer {
    fn start() -> Self {
        Self { listener: TcpListener::bind("127.0.0.1:0").unwrap() }
    }

    fn options(&self, known_sha256: &str) -> LinkOptions {
        let server = format!("ws://{}", self.listener.local_addr().unwrap()).parse().unwrap();
        LinkOptions {
            servers: server,
            room: RoomName::new("demo").unwrap(),
            trust: Trust::Public,
            token: None,
            known_sha256: Some(known_sha256.to_owned()),
        }
    }

    /// The next connection, which must ask for the room's socket with the subprotocol.
    fn accept(&self) -> Socket {
        self.accept_with(|request, mut response| {
            assert_eq!(request.uri().path(), "/v1/rooms/demo/view");
            assert_eq!(request.headers()["Sec-WebSocket-Protocol"], SUBPROTOCOL);
            response.headers_mut().insert("Sec-WebSocket-Protocol", HeaderValue::from_static(SUBPROTOCOL));
            Ok(response)
        })
        .unwrap()
    }

    fn accept_with(&self, answer: impl FnOnce(&Request, Response) -> Result<Response, ErrorResponse> + Unpin) -> Option<Socket> {
        let (stream, _) = self.listener.accept().unwrap();
        tungstenite::accept_hdr(stream, answer).ok()
    }

    /// Answers one HTTP request with `body` and returns its first line.
    fn serve_file(&self, body: &[u8]) -> String {
        let (mut stream, _) = self.listener.accept().unwrap();
        let mut request = Vec::new();
        let mut byte = [0];
        while !request.ends_with(b"\r\n\r\n") && stream.read(&mut byte).unwrap() == 1 {
            request.push(byte[0]);
        }
        write!(stream, "HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len()).unwrap();
        stream.write_all(body).unwrap();
        String::from_utf8_lossy(&request).lines().next().unwrap_or_default().to_owned()
    }
}

fn hello(sha256: &str) -> ViewHello {
    let bone = |name: &str, x: f32| BoneHello { name: name.into(), rest: [x, 0.05, 0.09], pivot: None, turns_with: None };
    ViewHello {
        version: PROTOCOL_VERSION,
        room: "demo".into(),
        character: CharacterHello {
            name: "two bones".into(),
            url: "/characters/two.glb".into(),
            sha256: sha256.into(),
            bones: vec![bone("brow_l", 0.03), bone("brow_r", -0.03)],
            poses: vec![PoseHello { name: "up".into(), bones: BTreeMap::from([("brow_l".into(), [0.03, 0.06, 0.09])]) }],
            groups: Vec::new(),
            zones: Vec::new(),
            shapes: Vec::new(),
        },
    }
}

fn send_hello(socket: &mut Socket, hello: &ViewHello) {
    let text = serde_json::to_string(&ViewMessage::Hello(hello.clone())).unwrap();
    socket.send(Message::text(text)).unwrap();
}

/// Packets of `count` frames of session 1, whose first bone rises by 0.1 mm a frame.
fn packets(count: u32) -> Vec<Vec<u8>> {
    let layout = PacketLayout::try_from(&hello("a").character).unwrap();
    let mut frame = layout.frame_at_rest();
    let mut encoder = Encoder::new(layout);
    let rest = frame.points[0];
    (0..count)
        .map(|seq| {
            frame.session = 1;
            frame.seq = seq;
            frame.captured_at_micros = 40_000 * u64::from(seq);
            frame.points[0] = rest + glam::Vec3::Y * 1e-4 * seq as f32;
            let mut packet = Vec::new();
            encoder.encode(&frame, &mut packet);
            packet
        })
        .collect()
}

/// Waits until `done` says so; a link that takes 20 s for anything here is broken.
fn wait_for<T>(what: &str, mut done: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + Duration::from_secs(20);
    loop {
        if let Some(result) = done() {
            return result;
        }
        assert!(Instant::now() < until, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn frames(link: &mut Link, count: usize) -> Vec<FrameArrival> {
    let mut got = Vec::new();
    wait_for("frames", || {
        got.extend(link.take_news().frames);
        (got.len() >= count).then_some(())
    });
    got
}

#[test]
fn hello_then_packets_arrive_and_garbage_is_counted_and_skipped() {
    let server = TestServer::start();
    let mut link = Link::open(server.options("a"), || ());
    let mut socket = server.accept();
    send_hello(&mut socket, &hello("a"));
    let connected = wait_for("the hello", || link.take_news().connected);
    assert_eq!(connected, Connected { hello: hello("a"), character: CharacterSource::Known });
    assert_eq!(link.state(), LinkState::Live);

    let sent = packets(6);
    for (k, packet) in sent.iter().enumerate() {
        socket.send(Message::binary(packet.clone())).unwrap();
        if k == 2 {
            socket.send(Message::binary(vec![0xFF; 40])).unwrap();
            socket.send(Message::binary(Vec::new())).unwrap();
            socket.send(Message::text("no JSON")).unwrap();
        }
    }
    let got = frames(&mut link, 6);
    assert_eq!(got.iter().map(|arrival| arrival.frame.seq).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
    assert!((got[5].frame.points[0].y - 0.0505).abs() < 2e-5, "{}", got[5].frame.points[0]);
    let stats = link.stats();
    assert_eq!((stats.packets, stats.garbage, stats.connects), (8, 3, 1));
    assert_eq!(stats.bytes, sent.iter().map(Vec::len).sum::<usize>() as u64 + 40);
}

#[test]
fn packets_before_the_hello_are_garbage() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    let mut socket = server.accept();
    socket.send(Message::binary(packets(1).remove(0))).unwrap();
    wait_for("the count", || (link.stats().garbage == 1).then_some(()));
    assert_eq!(link.state(), LinkState::Connecting);
}

#[test]
fn lost_connection_comes_back_by_itself() {
    let server = TestServer::start();
    let mut link = Link::open(server.options("a"), || ());
    for round in 1..=3 {
        let mut socket = server.accept();
        send_hello(&mut socket, &hello("a"));
        wait_for("the hello", || link.take_news().connected);
        socket.send(Message::binary(packets(1).remove(0))).unwrap();
        assert_eq!(frames(&mut link, 1).len(), 1);
        assert_eq!(link.stats().connects, round);
        // Dropped without a word.
        drop(socket);
        let why = wait_for("the loss", || match link.state() {
            LinkState::Lost { why, .. } => Some(why),
            _ => None,
        });
        assert_eq!(why, "the connection broke");
    }
}

#[test]
fn reason_of_a_close_is_told() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    let mut socket = server.accept();
    send_hello(&mut socket, &hello("a"));
    let error = ViewMessage::Error { code: "too_many_viewers".into(), message: "room demo is full".into() };
    socket.send(Message::text(serde_json::to_string(&error).unwrap())).unwrap();
    socket.close(None).unwrap();
    // The close handshake ends when both sides have said it.
    while socket.read().is_ok() {}
    drop(socket);
    let why = wait_for("the loss", || match link.state() {
        LinkState::Lost { why, .. } => Some(why),
        _ => None,
    });
    assert_eq!(why, "room demo is full");
}

#[test]
fn refusal_is_final_and_says_what_the_server_said() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    let refused = server.accept_with(|_, _| {
        let mut response = ErrorResponse::new(Some("room name is not allowed".into()));
        *response.status_mut() = StatusCode::BAD_REQUEST;
        response.headers_mut().insert("Content-Length", HeaderValue::from_static("24"));
        Err(response)
    });
    assert!(refused.is_none());
    let message = wait_for("the refusal", || match link.state() {
        LinkState::Refused { message } => Some(message),
        _ => None,
    });
    assert_eq!(message, "room name is not allowed");
}

#[test]
fn server_that_is_busy_is_tried_again() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    server.accept_with(|_, _| {
        let mut response = ErrorResponse::new(None);
        *response.status_mut() = StatusCode::SERVICE_UNAVAILABLE;
        Err(response)
    });
    wait_for("the loss", || matches!(link.state(), LinkState::Lost { .. }).then_some(()));
    send_hello(&mut server.accept(), &hello("a"));
    wait_for("the second attempt", || (link.stats().connects == 1).then_some(()));
}

#[test]
fn server_of_another_protocol_is_refused() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    let _socket = server.accept_with(|_, response| Ok(response));
    let message = wait_for("the refusal", || match link.state() {
        LinkState::Refused { message } => Some(message),
        _ => None,
    });
    assert_eq!(message, "the server does not speak rhytid.v1");
}

#[test]
fn server_of_another_version_is_refused() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    send_hello(&mut server.accept(), &ViewHello { version: 9, ..hello("a") });
    let message = wait_for("the refusal", || match link.state() {
        LinkState::Refused { message } => Some(message),
        _ => None,
    });
    assert_eq!(message, "the server speaks version 9, this viewer version 1");
}

#[test]
fn nobody_there_is_said_in_plain_words() {
    let server = TestServer::start();
    let options = server.options("a");
    drop(server);
    let link = Link::open(options, || ());
    let (why, attempts) = wait_for("three attempts", || match link.state() {
        LinkState::Lost { why, attempts, .. } if attempts >= 3 => Some((why, attempts)),
        _ => None,
    });
    assert_eq!((why.as_str(), attempts), ("no server listens there", 3));
}

#[test]
fn unknown_character_is_fetched_once() {
    let glb = b"glTF in spirit".to_vec();
    let sha256: String = Sha256::digest(&glb).iter().map(|byte| format!("{byte:02x}")).collect();
    let server = TestServer::start();
    let mut link = Link::open(server.options("another"), || ());
    let mut socket = server.accept();
    send_hello(&mut socket, &hello(&sha256));
    assert_eq!(server.serve_file(&glb), "GET /characters/two.glb HTTP/1.1");
    let connected = wait_for("the hello", || link.take_news().connected);
    assert_eq!(connected.character, CharacterSource::Fetched(glb));
    // The next time it is known.
    drop(socket);
    send_hello(&mut server.accept(), &hello(&sha256));
    let connected = wait_for("the hello", || link.take_news().connected);
    assert_eq!(connected.character, CharacterSource::Known);
}

#[test]
fn fetched_character_waits_through_a_reconnection() {
    let glb = b"glTF in spirit".to_vec();
    let sha256: String = Sha256::digest(&glb).iter().map(|byte| format!("{byte:02x}")).collect();
    let server = TestServer::start();
    let mut link = Link::open(server.options("another"), || ());
    let mut socket = server.accept();
    send_hello(&mut socket, &hello(&sha256));
    server.serve_file(&glb);
    wait_for("the first hello", || (link.stats().connects == 1).then_some(()));
    // A busy window has taken nothing when the connection breaks and comes back.
    drop(socket);
    let mut socket = server.accept();
    send_hello(&mut socket, &hello(&sha256));
    wait_for("the second hello", || (link.stats().connects == 2).then_some(()));
    assert_eq!(link.take_news().connected.map(|connected| connected.character), Some(CharacterSource::Fetched(glb)));
}

#[test]
fn character_of_another_hash_is_not_taken() {
    let server = TestServer::start();
    let mut link = Link::open(server.options("a"), || ());
    send_hello(&mut server.accept(), &hello(&"0".repeat(64)));
    server.serve_file(b"something else");
    let why = wait_for("the loss", || match link.state() {
        LinkState::Lost { why, .. } => Some(why),
        _ => None,
    });
    assert!(why.contains("has SHA-256") && why.contains("expected 0000"), "{why}");
    // The next attempt may load as much again: it does not come within a blink as after a broken connection.
    let LinkState::Lost { retry_at, .. } = link.state() else { panic!("{:?}", link.state()) };
    assert!(retry_at.saturating_duration_since(Instant::now()) > Duration::from_secs(1));
    assert!(link.take_news().connected.is_none());
}

#[test]
fn character_elsewhere_is_not_fetched() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    let mut elsewhere = hello("b");
    elsewhere.character.url = "//elsewhere.example/x.glb".into();
    send_hello(&mut server.accept(), &elsewhere);
    let why = wait_for("the loss", || match link.state() {
        LinkState::Lost { why, .. } => Some(why),
        _ => None,
    });
    assert!(why.contains("expected a path"), "{why}");
}

/// A spectator of the two-bone character, its server's first connection accepted and greeted.
fn watch(server: &TestServer) -> (Spectator, Socket) {
    let character = two_bones();
    let spectator = Spectator::open(
        WatchArgs {
            servers: server.options("").servers,
            room: RoomName::new("demo").unwrap(),
            trust: Trust::Public,
            token: TokenArgs::default(),
        },
        Arc::new(character),
        || (),
    );
    let mut socket = server.accept();
    send_hello(&mut socket, &hello("a"));
    (spectator, socket)
}

/// The default character, cut down to what [`hello`] describes.
fn two_bones() -> Character {
    let mut character = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
    character.bones.truncate(2);
    character.poses.truncate(1);
    character.poses[0].points.truncate(2);
    character.shapes.clear();
    character.sha256 = "a".into();
    character
}

fn wait_for_status(spectator: &mut Spectator, kind: StatusKind) -> Status {
    wait_for(&format!("{kind:?}"), || {
        spectator.update(|_| Err("this test has one character".into()));
        let now = Instant::now();
        spectator.sample(now);
        let status = spectator.status(now);
        (status.kind == kind).then_some(status)
    })
}

#[test]
fn status_follows_the_sender_from_waiting_to_gone() {
    let server = TestServer::start();
    let (mut spectator, mut socket) = watch(&server);
    let status = wait_for_status(&mut spectator, StatusKind::Waiting);
    assert!(status.headline == "Waiting for a face" && status.detail.contains("room demo"), "{status:?}");

    socket.send(Message::binary(packets(1).remove(0))).unwrap();
    assert_eq!(wait_for_status(&mut spectator, StatusKind::Live).headline, "Live");
    // A sender that falls silent is told from one that has gone.
    assert_eq!(wait_for_status(&mut spectator, StatusKind::Silent).headline, "Sender silent");
    assert_eq!(wait_for_status(&mut spectator, StatusKind::Idle).headline, "Sender gone");
}

#[test]
fn status_says_face_lost_when_the_tracker_does() {
    let server = TestServer::start();
    let (mut spectator, mut socket) = watch(&server);
    let layout = PacketLayout::try_from(&hello("a").character).unwrap();
    let mut frame = layout.frame_at_rest();
    (frame.session, frame.face) = (1, false);
    let mut packet = Vec::new();
    Encoder::new(layout).encode(&frame, &mut packet);
    socket.send(Message::binary(packet)).unwrap();
    let status = wait_for_status(&mut spectator, StatusKind::FaceLost);
    assert!(status.headline == "Face lost" && status.detail.contains("sees no face"), "{status:?}");
}

#[test]
fn status_says_that_the_server_is_gone_and_when_it_is_back() {
    let server = TestServer::start();
    let (mut spectator, socket) = watch(&server);
    wait_for_status(&mut spectator, StatusKind::Waiting);
    drop(socket);
    let status = wait_for_status(&mut spectator, StatusKind::ServerGone);
    assert!(status.headline == "Server gone" && status.detail.contains("the connection broke; trying again"), "{status:?}");
    let mut socket = server.accept();
    send_hello(&mut socket, &hello("a"));
    wait_for_status(&mut spectator, StatusKind::Waiting);
    socket.send(Message::binary(packets(1).remove(0))).unwrap();
    wait_for_status(&mut spectator, StatusKind::Live);
}

#[test]
fn status_tells_attempts_in_vain_and_refusals() {
    let server = TestServer::start();
    let watched = WatchArgs {
        servers: server.options("").servers,
        room: RoomName::new("demo").unwrap(),
        trust: Trust::Public,
        token: TokenArgs::default(),
    };
    let mut spectator = Spectator::open(watched.clone(), Arc::new(two_bones()), || ());
    assert_eq!(spectator.status(Instant::now()).kind, StatusKind::Connecting);
    server.accept_with(|_, _| {
        let mut response = ErrorResponse::new(Some("go away".into()));
        *response.status_mut() = StatusCode::FORBIDDEN;
        response.headers_mut().insert("Content-Length", HeaderValue::from_static("7"));
        Err(response)
    });
    assert_eq!(wait_for_status(&mut spectator, StatusKind::Refused).detail, "go away");
    drop(server);
    let mut spectator = Spectator::open(watched, Arc::new(two_bones()), || ());
    wait_for("the third attempt in vain", || {
        let status = spectator.status(Instant::now());
        spectator.update(|_| Err(String::new()));
        status.detail.contains("attempt 3 failed").then_some(())
    });
}

#[test]
fn character_that_cannot_be_drawn_is_said() {
    let glb = b"glTF in spirit".to_vec();
    let sha256: String = Sha256::digest(&glb).iter().map(|byte| format!("{byte:02x}")).collect();
    let server = TestServer::start();
    let (mut spectator, socket) = watch(&server);
    wait_for_status(&mut spectator, StatusKind::Waiting);
    drop(socket);
    let mut socket = server.accept();
    send_hello(&mut socket, &hello(&sha256));
    server.serve_file(&glb);
    let status = wait_for_status(&mut spectator, StatusKind::Unusable);
    assert_eq!(status.detail, "this test has one character");
}

#[test]
fn way_is_measured_and_a_dropped_link_says_goodbye() {
    let server = TestServer::start();
    let link = Link::open(server.options("a"), || ());
    let mut socket = server.accept();
    send_hello(&mut socket, &hello("a"));
    let reader = std::thread::spawn(move || {
        loop {
            // Reading answers pings, too.
            match socket.read() {
                Ok(Message::Close(_)) => return true,
                Ok(_) => {}
                Err(_) => return false,
            }
        }
    });
    let round_trip = wait_for("a pong", || link.stats().round_trip);
    assert!(round_trip < Duration::from_secs(2));
    drop(link);
    assert!(reader.join().unwrap(), "the server must see a close frame");
}

/// Options for two nodes of a cluster.
fn two_nodes(first: &TestServer, second: &TestServer) -> LinkOptions {
    let address = |server: &TestServer| server.listener.local_addr().unwrap();
    let servers = format!("ws://{},ws://{}", address(first), address(second)).parse().unwrap();
    LinkOptions { servers, ..first.options("a") }
}

#[test]
fn link_goes_on_at_the_next_node_at_once_when_one_breaks() {
    let (first, second) = (TestServer::start(), TestServer::start());
    let mut link = Link::open(two_nodes(&first, &second), || ());
    let mut socket = first.accept();
    send_hello(&mut socket, &hello("a"));
    wait_for("the hello", || link.take_news().connected);
    let broken_at = Instant::now();
    drop(socket);
    let mut socket = second.accept();
    send_hello(&mut socket, &hello("a"));
    socket.send(Message::binary(packets(1).remove(0))).unwrap();
    frames(&mut link, 1);
    assert!(broken_at.elapsed() < Duration::from_millis(500), "{:?}", broken_at.elapsed());
    assert_eq!(link.stats().connects, 2);
    // And back again.
    drop(socket);
    send_hello(&mut first.accept(), &hello("a"));
    wait_for("the third hello", || (link.stats().connects == 3).then_some(()));
}

#[test]
fn link_leaves_a_node_that_falls_silent_within_two_seconds() {
    let (first, second) = (TestServer::start(), TestServer::start());
    let mut link = Link::open(two_nodes(&first, &second), || ());
    // Stopped: the connection stands, and nothing is ever read or sent.
    let mut stopped = first.accept();
    send_hello(&mut stopped, &hello("a"));
    wait_for("the hello", || link.take_news().connected);
    let stopped_at = Instant::now();
    let mut socket = second.accept();
    send_hello(&mut socket, &hello("a"));
    socket.send(Message::binary(packets(1).remove(0))).unwrap();
    frames(&mut link, 1);
    assert!(stopped_at.elapsed() < Duration::from_secs(2), "{:?}", stopped_at.elapsed());
}
