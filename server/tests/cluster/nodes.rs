//! Nodes of a cluster, and who connects to them.

use super::nats::Nats;
use super::process::{PATIENCE, Server, wait_for};
use super::{http, socket};
use rhytid_shared::view::{ViewHello, ViewMessage};
use serde_json::{Value, json};
use std::net::TcpStream;
use std::ops::{Deref, DerefMut};
use std::sync::Arc;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Message, WebSocket};

/// Of a publisher of weights.
pub const HELLO: &str = r#"{"type":"hello","version":1,"source":"test","fps":60}"#;

pub struct Node(Server);

impl Node {
    pub fn start(nats: &str) -> Self {
        Self::with(nats, &[])
    }

    pub fn with(nats: &str, more: &[&str]) -> Self {
        Self(Server::start(&[&["serve", "-v", "--cluster", nats], more].concat()))
    }

    /// In a network of its own.
    pub fn inside(namespace: &str, nats: &str, address: &str) -> Self {
        let listen = format!("{address}:0");
        let args = ["serve", "-v", "--cluster", nats, "--listen", &listen, "--insecure", "--max-connection-rate", "1000"];
        Self(Server::try_start(&["ip", "netns", "exec", namespace], &args).unwrap_or_else(|log| panic!("it does not serve: {log}")))
    }

    /// Waits until it has joined.
    pub fn ready(self) -> Self {
        wait_for("a node's joining", || (self.get("/healthz")?.trim() == "ok").then_some(()));
        self
    }

    /// The body of an answer of status 200.
    pub fn get(&self, path: &str) -> Option<String> {
        let (status, body) = http::ask(&self.address, "GET", path, &[], "").ok()?;
        (status == 200).then_some(body)
    }

    pub fn rooms(&self) -> Value {
        serde_json::from_str(&self.get("/api/rooms").unwrap()).unwrap()
    }

    pub fn room(&self, name: &str) -> Option<Value> {
        self.rooms()["rooms"].as_array().unwrap().iter().find(|room| room["name"] == name).cloned()
    }

    pub fn socket(&self, path: &str) -> WebSocket<TcpStream> {
        socket::open(&self.address, path, &[], PATIENCE).unwrap()
    }

    pub fn publisher(&self, room: &str, hello: &str) -> Publisher {
        let mut publisher = self.silent_publisher(room);
        publisher.socket.send(Message::text(hello)).unwrap();
        publisher
    }

    /// One that has yet to say its hello.
    pub fn silent_publisher(&self, room: &str) -> Publisher {
        Publisher { socket: self.socket(&format!("{room}/publish")), t: 0.0 }
    }

    pub fn viewer(&self, room: &str) -> RawViewer {
        RawViewer::new(self.socket(&format!("{room}/view")))
    }
}

impl Deref for Node {
    type Target = Server;

    fn deref(&self) -> &Server {
        &self.0
    }
}

impl DerefMut for Node {
    fn deref_mut(&mut self) -> &mut Server {
        &mut self.0
    }
}

/// Three nodes and their NATS.
pub struct Cluster {
    pub nodes: Vec<Node>,
    pub nats: Nats,
    pub folder: Arc<tempfile::TempDir>,
}

impl Cluster {
    pub fn start() -> Self {
        let nats = Nats::start();
        let folder = nats.folder.clone();
        let nodes: Vec<Node> = (0..3).map(|_| Node::start(&nats.url())).collect();
        Self { nodes: nodes.into_iter().map(Node::ready).collect(), nats, folder }
    }
}

/// A publisher that waits for answers.
pub struct Publisher {
    pub socket: WebSocket<TcpStream>,
    t: f64,
}

impl Publisher {
    /// The next message of the server's.
    pub fn answer(&mut self) -> Value {
        loop {
            match self.socket.read().unwrap() {
                Message::Text(text) => return serde_json::from_str(&text).unwrap(),
                Message::Close(frame) => panic!("closed: {frame:?}"),
                _ => {}
            }
        }
    }

    pub fn ready(mut self) -> Self {
        let answer = self.answer();
        assert_eq!(answer["type"], "ready", "{answer}");
        self
    }

    /// The last message of a server that ends the session.
    pub fn last_answer(&mut self) -> Value {
        self.ending().0
    }

    /// The same with the code of its close.
    pub fn ending(&mut self) -> (Value, Option<CloseCode>) {
        let mut last = Value::Null;
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => last = serde_json::from_str(&text).unwrap(),
                Ok(Message::Close(frame)) => return (last, frame.map(|frame| frame.code)),
                Err(_) => return (last, None),
                Ok(_) => {}
            }
        }
    }

    pub fn frame(&mut self, jaw: f64) {
        assert!(self.try_frame(jaw), "the session has ended");
    }

    /// False where the session has ended.
    pub fn try_frame(&mut self, jaw: f64) -> bool {
        self.t += 1.0 / 60.0;
        let frame = json!({ "type": "frame", "t": self.t, "weights": { "jawOpen": jaw, "browInnerUp": 0.5 } });
        self.socket.send(Message::text(frame.to_string())).is_ok()
    }
}

/// A viewer that gets packets as they are.
pub struct RawViewer {
    socket: WebSocket<TcpStream>,
    pub hello: ViewHello,
}

impl RawViewer {
    fn new(mut socket: WebSocket<TcpStream>) -> Self {
        loop {
            if let Message::Text(text) = socket.read().unwrap() {
                let Ok(ViewMessage::Hello(hello)) = serde_json::from_str(&text) else { panic!("{text}") };
                socket.flush().unwrap();
                return Self { socket, hello };
            }
        }
    }

    pub fn packet(&mut self) -> Vec<u8> {
        loop {
            if let Message::Binary(packet) = self.socket.read().unwrap() {
                return packet.to_vec();
            }
        }
    }
}
