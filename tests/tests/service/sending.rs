//! The sender, against a real server.

use super::harness::Server;
use rhytid_server::{SendError, SendOptions, SendReport, SendSource, send};
use rhytid_shared::trust::Trust;
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};
use tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tungstenite::{Message, WebSocket};

fn feed(frames: u32, interval: f64) -> String {
    let mut text = String::from("{\"type\":\"hello\",\"version\":1,\"source\":\"feed\"}\n");
    for i in 0..frames {
        text += &format!("{{\"type\":\"frame\",\"t\":{},\"weights\":{{\"jawOpen\":0.5}}}}\n", f64::from(i) * interval);
    }
    text
}

fn options(server: &Server, text: String) -> SendOptions {
    SendOptions {
        source: SendSource::Text(text, "test feed".into()),
        to: format!("ws://{}", server.address),
        room: "demo".into(),
        speed: f64::INFINITY,
        repeats: false,
        takeover: false,
        binary: false,
        profile: None,
        timeout: Duration::from_secs(15),
        trust: Trust::Public,
        token: None,
    }
}

#[test]
fn a_feed_sent_in_the_binary_form_gives_nearly_the_same_face() {
    let lines: Vec<&str> = include_str!("../../../shared/assets/demo.ibug68.jsonl").lines().take(1 + 60).collect();
    let server = Server::start();
    let mut last = Vec::new();
    for (room, binary) in [("text", false), ("bytes", true)] {
        let mut viewer = server.viewer(room);
        let options = SendOptions { binary, room: room.into(), ..options(&server, lines.join("\n")) };
        let before = server.metric("rhytid_in_bytes_total");
        assert_eq!(send_now(&options).unwrap(), SendReport { frames: 60, errors: 0 });
        let num_bytes = server.metric("rhytid_in_bytes_total") - before;
        while viewer.frame.seq < 59 {
            assert!(viewer.next_packet());
        }
        last.push((viewer.frame, num_bytes));
    }
    let farthest = last[0].0.points.iter().zip(&last[1].0.points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
    assert!(farthest < 2e-4, "{farthest} m apart");
    assert!(last[1].1 < 0.5 * last[0].1, "{} bytes as text, {} as bytes", last[0].1, last[1].1);
}

fn send_now(options: &SendOptions) -> Result<SendReport, SendError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(send(options, &indicatif::ProgressBar::hidden(), std::future::pending()))
}

#[test]
fn a_feed_is_sent_whole_at_full_speed_and_in_time_at_a_given_one() {
    let server = Server::start();
    let mut options = options(&server, feed(400, 0.01));
    assert_eq!(send_now(&options).unwrap(), SendReport { frames: 400, errors: 0 });
    assert_eq!(server.metric("rhytid_frames_in_total"), 400.0, "the server has read all of it when the sender ends");
    options.source = SendSource::Text(feed(61, 0.05), "test feed".into());
    options.speed = 4.0;
    let start = Instant::now();
    send_now(&options).unwrap();
    let took = start.elapsed();
    assert!((Duration::from_millis(740)..Duration::from_millis(2500)).contains(&took), "3 s at four times the speed took {took:?}");
    assert_eq!(server.room("demo").unwrap()["session"], 2);
}

#[test]
fn the_servers_words_reach_the_sender() {
    let server = Server::start();
    let _first = server.ready_publisher("demo");
    let mut options = options(&server, feed(10, 0.04));
    let error = send_now(&options).unwrap_err().to_string();
    assert!(error.contains("the room has a publisher already"), "{error}");
    options.takeover = true;
    assert_eq!(send_now(&options).unwrap().frames, 10);
    options.room = "no room".into();
    let error = send_now(&options).unwrap_err().to_string();
    assert!(error.contains("cannot connect"), "{error}");
    // The sender cannot know this character's bones; the server does.
    options.room = "demo".into();
    options.source = SendSource::Text(feed(1, 0.0) + "{\"type\":\"frame\",\"t\":1,\"bones\":{\"tail\":[0,0,0]}}\n", "test feed".into());
    assert_eq!(send_now(&options).unwrap(), SendReport { frames: 2, errors: 1 });
    options.source = SendSource::Text(feed(2, 0.04) + "{\"type\":\"frame\",\"t\":1,\"landmarks\":7}\n", "test feed".into());
    let error = send_now(&options).unwrap_err().to_string();
    assert!(error.starts_with("feed test feed, line 4: field landmarks: invalid type"), "{error}");
}

#[test]
fn each_loop_is_a_session_of_its_own() {
    let server = Server::start();
    let mut options = options(&server, feed(5, 0.01));
    options.repeats = true;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let sending = runtime.spawn(async move { send(&options, &indicatif::ProgressBar::hidden(), std::future::pending()).await });
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["session"].as_u64() >= Some(3)));
    sending.abort();
    runtime.shutdown_background();
}

#[test]
fn a_server_that_does_not_answer_is_given_up() {
    let server = Server::start();
    let mut options = options(&server, feed(100_000, 0.01));
    options.timeout = Duration::from_millis(300);
    // It accepts and says nothing, or shakes hands and says nothing.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    options.to = format!("ws://{}", listener.local_addr().unwrap());
    let error = send_now(&options).unwrap_err().to_string();
    assert!(error.starts_with("cannot connect to ws://127.0.0.1:") && error.ends_with("no answer within 0.3 s"), "{error}");
    let accept = std::thread::spawn(move || {
        // The connection that was given up still stands in the queue.
        drop(listener.accept().unwrap());
        accept_publisher(listener.accept().unwrap().0)
    });
    let error = send_now(&options).unwrap_err().to_string();
    assert_eq!(error, "the server ended the session: no answer to the hello within 0.3 s");
    accept.join().unwrap();
}

#[test]
fn a_server_that_stops_reading_is_given_up() {
    let server = Server::start();
    let mut options = options(&server, feed(200_000, 0.01));
    options.timeout = Duration::from_millis(300);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    options.to = format!("ws://{}", listener.local_addr().unwrap());
    let accept = std::thread::spawn(move || {
        let mut socket = accept_publisher(listener.accept().unwrap().0);
        socket.send(Message::text(r#"{"type":"ready","session":1}"#)).unwrap();
        socket
    });
    let error = send_now(&options).unwrap_err().to_string();
    assert_eq!(error, "the server ended the session: it read nothing within 0.3 s");
    accept.join().unwrap();
}

/// A server's end of a publish socket; the sender offers our subprotocol.
#[allow(clippy::result_large_err, reason = "tungstenite's callbacks are declared so")]
fn accept_publisher(stream: TcpStream) -> WebSocket<TcpStream> {
    tungstenite::accept_hdr(stream, |request: &Request, mut response: Response| {
        let offered = request.headers().get("Sec-WebSocket-Protocol").cloned().expect("the sender offers a subprotocol");
        assert_eq!(offered, "rhytid.v1");
        response.headers_mut().insert("Sec-WebSocket-Protocol", offered);
        Ok::<_, ErrorResponse>(response)
    })
    .unwrap()
}

#[test]
fn a_sender_that_is_stopped_closes_its_session() {
    let server = Server::start();
    let mut options = options(&server, feed(3, 100.0));
    options.speed = 1.0;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let stopper = std::thread::spawn({
        let mut viewer = server.viewer("demo");
        move || {
            // The first frame has come, the second is due in a hundred seconds.
            assert!(viewer.next_packet());
            stop.send(()).unwrap();
        }
    });
    let report = runtime.block_on(send(&options, &indicatif::ProgressBar::hidden(), async { drop(stopped.await) })).unwrap();
    stopper.join().unwrap();
    assert_eq!(report.frames, 1);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["publisher"].is_null()));
    server.wait_for_metric("rhytid_sessions_ended_total{reason=\"closed\"}", |count| count >= 1.0);
}
