//! Rooms with more viewers than one task of the server's holds: everybody ends on the newest frame, and learns of the end.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]
// A server is stopped by a signal.
#![cfg(unix)]

#[path = "process/http.rs"]
mod http;
mod process;
#[path = "process/signal.rs"]
mod signal;
#[path = "process/socket.rs"]
mod socket;

use process::{PATIENCE, Server, wait_for};
use rhytid_shared::packet::{Decoder, PacketLayout};
use rhytid_shared::view::ViewMessage;
use signal::Signal;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::{Message, WebSocket};

/// More than two of the server's groups.
const VIEWERS: usize = 600;
const TEXT: u8 = 1;
const BINARY: u8 = 2;
const CLOSE: u8 = 8;
const PING: u8 = 9;

/// A viewer that answers pings only when it is told to: what comes besides, it is sent unasked.
struct Watcher {
    stream: TcpStream,
    bytes: Vec<u8>,
    /// Once the hello has come.
    decoder: Option<Decoder>,
    /// Sequence number of the newest frame.
    seq: Option<u32>,
    close: Option<u16>,
}

impl Watcher {
    /// Joins `demo`, and has answered the first ping.
    fn join(server: &Server) -> Self {
        let mut stream = TcpStream::connect(&server.address).unwrap();
        write!(
            stream,
            "GET /v1/rooms/demo/view HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
            server.address
        )
        .unwrap();
        stream.set_nonblocking(true).unwrap();
        let mut watcher = Self { stream, bytes: Vec::new(), decoder: None, seq: None, close: None };
        wait_for("the answer", || {
            watcher.read();
            let end = watcher.bytes.windows(4).position(|window| window == b"\r\n\r\n")?;
            let answer: Vec<u8> = watcher.bytes.drain(..end + 4).collect();
            answer.starts_with(b"HTTP/1.1 101").then_some(())
        });
        wait_for("the hello", || {
            watcher.look();
            watcher.decoder.as_ref().map(|_| ())
        });
        watcher.answer_ping();
        watcher
    }

    fn read(&mut self) {
        let mut buffer = [0; 4096];
        loop {
            match self.stream.read(&mut buffer) {
                Ok(0) => return,
                Ok(num_bytes) => self.bytes.extend_from_slice(&buffer[..num_bytes]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// Reads what has come.
    fn look(&mut self) {
        self.read();
        while let Some((opcode, payload, rest)) = frame(&self.bytes) {
            match (opcode, &mut self.decoder) {
                (BINARY, Some(decoder)) => {
                    let mut face = decoder.layout().frame_at_rest();
                    decoder.decode(payload, &mut face).unwrap();
                    // A key packet that a delta is read with may have been seen before.
                    self.seq = self.seq.max(Some(face.seq));
                }
                (CLOSE, _) => self.close = Some(u16::from_be_bytes([payload[0], payload[1]])),
                (TEXT, decoder @ None) => {
                    let Ok(ViewMessage::Hello(hello)) = serde_json::from_slice(payload) else { panic!("{payload:?}") };
                    *decoder = Some(Decoder::new(PacketLayout::try_from(&hello.character).unwrap()));
                }
                (PING, _) => {}
                _ => panic!("{opcode}: {}", String::from_utf8_lossy(payload)),
            }
            self.bytes = rest.to_vec();
        }
    }

    /// Whether there was a ping or not: a pong that nobody asked for is one all the same (RFC 6455, 5.5.3).
    fn answer_ping(&mut self) {
        const MASKED_PONG: [u8; 6] = [0x8A, 0x80, 0, 0, 0, 0];
        self.stream.write_all(&MASKED_PONG).unwrap();
    }
}

/// Opcode and payload of the first frame of a server's `bytes`, and what is behind it.
fn frame(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (head, rest) = bytes.split_at_checked(2)?;
    let (len, rest) = match head[1] {
        126 => {
            let (len, rest) = rest.split_at_checked(2)?;
            (usize::from(u16::from_be_bytes([len[0], len[1]])), rest)
        }
        len => (usize::from(len), rest),
    };
    let (payload, rest) = rest.split_at_checked(len)?;
    Some((head[0] & 0xF, payload, rest))
}

struct Publisher {
    socket: WebSocket<TcpStream>,
    num_frames: u32,
}

impl Publisher {
    fn start(server: &Server) -> Self {
        let mut socket = socket::open(&server.address, "demo/publish", &[], PATIENCE).unwrap();
        socket.send(Message::text(r#"{"type":"hello","version":1,"source":"test","fps":200}"#)).unwrap();
        while !matches!(socket.read().unwrap(), Message::Text(text) if text.contains("\"ready\"")) {}
        Self { socket, num_frames: 0 }
    }

    /// Frames between which there is hardly time for all viewers.
    fn burst(&mut self, count: u32) {
        for k in 0..count {
            let t = f64::from(self.num_frames) / 200.0;
            let frame = format!(r#"{{"type":"frame","t":{t:.4},"weights":{{"jawOpen":{:.3}}}}}"#, 0.5 + 0.5 * (9.0 * t).sin());
            self.socket.send(Message::text(frame)).unwrap();
            self.num_frames += 1;
            std::thread::sleep(Duration::from_millis(u64::from(k % 3)));
        }
    }

    fn newest(&self) -> Option<u32> {
        self.num_frames.checked_sub(1)
    }
}

/// All see frame `newest`, with nothing that would make the server look at them again.
fn wait_for_all(watchers: &mut [Watcher], newest: Option<u32>) {
    let start = Instant::now();
    loop {
        watchers.iter_mut().for_each(Watcher::look);
        let num_behind = watchers.iter().filter(|watcher| watcher.seq != newest).count();
        if num_behind == 0 {
            return;
        }
        assert!(start.elapsed() < Duration::from_secs(3), "{num_behind} viewers have not seen frame {newest:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn every_viewer_of_a_large_room_ends_on_the_last_frame_and_learns_of_the_end() {
    let mut server = Server::start(&["serve", "--ping-interval", "60", "--viewer-timeout", "120", "--max-viewers", "2000"]);
    let mut watchers: Vec<Watcher> = (0..VIEWERS).map(|_| Watcher::join(&server)).collect();
    let mut publisher = Publisher::start(&server);
    for burst in [1, 7, 20, 2, 30] {
        publisher.burst(burst);
        wait_for_all(&mut watchers, publisher.newest());
        // Else these would be all the frames they get.
        watchers.iter_mut().for_each(Watcher::answer_ping);
        std::thread::sleep(Duration::from_millis(100));
    }

    // Every other one goes, and others take their seats.
    let mut turn = 0;
    watchers.retain(|_| {
        turn += 1;
        turn % 2 == 0
    });
    let viewers = |server: &Server| {
        let (_, metrics) = http::ask(&server.address, "GET", "/metrics", &[], "").unwrap();
        let line = metrics.lines().find(|line| line.starts_with("rhytid_viewers ")).unwrap_or_else(|| panic!("{metrics}"));
        line["rhytid_viewers ".len()..].parse::<usize>().unwrap()
    };
    wait_for("half of them to be gone", || (viewers(&server) == watchers.len()).then_some(()));
    watchers.extend((watchers.len()..VIEWERS).map(|_| Watcher::join(&server)));
    publisher.burst(10);
    wait_for_all(&mut watchers, publisher.newest());
    assert_eq!(viewers(&server), VIEWERS);

    // The end comes in the middle of what a frame costs.
    publisher.burst(1);
    signal::signal(&server.process, Signal::TERM);
    wait_for("the end's being told to all", || {
        watchers.iter_mut().for_each(Watcher::look);
        watchers.iter().all(|watcher| watcher.close.is_some()).then_some(())
    });
    assert!(watchers.iter().all(|watcher| watcher.close == Some(1001)));
    drop(watchers);
    assert!(server.process.wait().unwrap().success());
}

#[test]
fn viewer_that_asks_while_it_does_not_read_gets_whole_messages() {
    let server = Server::start(&["serve", "--viewer-timeout", "120"]);
    let address: std::net::SocketAddr = server.address.parse().unwrap();
    let small = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
    small.set_recv_buffer_size(2048).unwrap();
    small.connect(&address.into()).unwrap();
    let request = format!("ws://{address}/v1/rooms/demo/view?format=json");
    let (mut socket, _) = tokio_tungstenite::tungstenite::client(request, TcpStream::from(small)).unwrap();
    let mut publisher = Publisher::start(&server);
    for _ in 0..20 {
        publisher.burst(10);
        for _ in 0..3 {
            socket.send(Message::Ping(vec![7; 100].into())).unwrap();
        }
    }
    let (mut num_pongs, mut newest) = (0, None);
    while num_pongs < 60 || newest != publisher.newest() {
        match socket.read().unwrap() {
            Message::Text(text) => {
                let message: serde_json::Value = serde_json::from_str(&text).unwrap();
                let seq = message["seq"].as_u64().map(|seq| seq as u32);
                assert!(seq >= newest || message["type"] == "hello", "{seq:?} after {newest:?}");
                newest = seq.or(newest);
            }
            Message::Pong(payload) => {
                assert_eq!(&payload[..], [7; 100]);
                num_pongs += 1;
            }
            Message::Close(frame) => panic!("{frame:?}"),
            _ => {}
        }
    }
}
