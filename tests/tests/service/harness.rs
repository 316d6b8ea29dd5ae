//! A server on a free port, and clients for it.

use rhytid_server::{Identity, ServerConfig, bind, load_character, run};
use rhytid_shared::FaceFrame;
use rhytid_shared::packet::{Decoder, PacketKind, PacketLayout};
use rhytid_shared::view::{JsonFrame, ViewHello, ViewMessage};
use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::sync::oneshot;
use tungstenite::client::IntoClientRequest;
use tungstenite::http::Response;
use tungstenite::protocol::CloseFrame;
use tungstenite::{HandshakeError, Message, WebSocket};

/// Longer than anything here takes; a test that waits for it has failed.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server in this process. Stops on drop.
pub struct Server {
    pub address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    pub fn start() -> Self {
        Self::with(|_| {})
    }

    /// A server whose settings `change` has changed.
    pub fn with(change: impl FnOnce(&mut ServerConfig)) -> Self {
        let mut config = ServerConfig { listen: "127.0.0.1:0".into(), ..ServerConfig::default() };
        change(&mut config);
        let (stop, stopped) = oneshot::channel();
        let (bound, address) = mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
            runtime.block_on(async {
                let listener = bind(&config.listen).await.unwrap();
                let mut address = listener.local_addr().unwrap();
                if address.ip().is_unspecified() {
                    address.set_ip(Ipv4Addr::LOCALHOST.into());
                }
                bound.send(address).unwrap();
                let character = load_character(config.character.as_deref()).unwrap();
                let identity = Identity::load(&config.tls, address, &[]).unwrap();
                run(listener, config, character, identity, async { drop(stopped.await) }).await.unwrap();
            });
        });
        Self { address: address.recv().unwrap(), stop: Some(stop), thread: Some(thread) }
    }

    /// Asks it to stop; it goes on until its sockets are closed.
    pub fn stop(&mut self) {
        if let Some(stop) = self.stop.take() {
            stop.send(()).unwrap();
        }
    }

    /// Waits for its end.
    pub fn wait(&mut self) {
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }

    /// A WebSocket to `path`, or the answer that refused it.
    pub fn connect(&self, path: &str, headers: &[(&'static str, &str)]) -> Result<Client, Box<Response<Option<Vec<u8>>>>> {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.set_nodelay(true).unwrap();
        let mut request = format!("ws://{}{path}", self.address).into_client_request().unwrap();
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse().unwrap());
        }
        match tungstenite::client(request, stream) {
            Ok((socket, answer)) => Ok(Client {
                socket,
                protocol: answer.headers().get("sec-websocket-protocol").map(|value| value.to_str().unwrap().to_owned()),
            }),
            Err(HandshakeError::Failure(tungstenite::Error::Http(answer))) => Err(answer),
            Err(other) => panic!("the handshake failed: {other}"),
        }
    }

    /// A publisher that has not said anything yet.
    pub fn publisher(&self, room: &str) -> Client {
        self.connect(&format!("/v1/rooms/{room}/publish"), &[]).expect("publishers may connect")
    }

    /// A publisher that is ready.
    pub fn ready_publisher(&self, room: &str) -> Client {
        let mut publisher = self.publisher(room);
        publisher.send(r#"{"type":"hello","version":1,"source":"test","fps":25}"#);
        let ready = publisher.text();
        assert!(ready.contains(r#""type":"ready""#), "{ready}");
        publisher
    }

    /// A viewer of packets that has its hello.
    pub fn viewer(&self, room: &str) -> Viewer {
        Viewer::new(self.connect(&format!("/v1/rooms/{room}/view"), &[]).expect("viewers may connect"))
    }

    /// A viewer of JSON that has its hello.
    pub fn json_viewer(&self, room: &str) -> Viewer {
        Viewer::new(self.connect(&format!("/v1/rooms/{room}/view?format=json"), &[]).expect("viewers may connect"))
    }

    /// Status line, headers and body of a plain request.
    pub fn get(&self, path: &str, headers: &str) -> (String, Vec<u8>) {
        let host = if headers.contains("Host:") { String::new() } else { format!("Host: {}\r\n", self.address) };
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(format!("GET {path} HTTP/1.1\r\n{host}{headers}Connection: close\r\n\r\n").as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("an answer has a head");
        (String::from_utf8(answer[..end].to_vec()).unwrap(), answer[end + 4..].to_vec())
    }

    /// The room's listing.
    pub fn room(&self, name: &str) -> Option<serde_json::Value> {
        let (_, body) = self.get("/api/rooms", "");
        let list: serde_json::Value = serde_json::from_slice(&body).unwrap();
        list["rooms"].as_array().unwrap().iter().find(|room| room["name"] == name).cloned()
    }

    /// Waits until the room's listing is as `is_so` wants it.
    pub fn wait_for_room(&self, name: &str, is_so: impl Fn(Option<&serde_json::Value>) -> bool) {
        for _ in 0..400 {
            if is_so(self.room(name).as_ref()) {
                return;
            }
            std::thread::sleep(Duration::from_millis(25));
        }
        panic!("room {name} stays {:?}", self.room(name));
    }

    /// The value of a metric, by the start of its line; 0 where it is not there.
    pub fn metric(&self, start: &str) -> f64 {
        let (_, body) = self.get("/metrics", "");
        let text = String::from_utf8(body).unwrap();
        text.lines().find(|line| line.starts_with(start)).and_then(|line| line.rsplit(' ').next()?.parse().ok()).unwrap_or(0.0)
    }

    /// Waits until a metric is as `is_so` wants it: the server counts after it has acted.
    pub fn wait_for_metric(&self, start: &str, is_so: impl Fn(f64) -> bool) {
        for _ in 0..400 {
            if is_so(self.metric(start)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(25));
        }
        panic!("metric {start} stays {}", self.metric(start));
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(stop) = self.stop.take() {
            // It may have ended by itself.
            let _ = stop.send(());
        }
        if let Some(thread) = self.thread.take()
            && !std::thread::panicking()
        {
            thread.join().unwrap();
        }
    }
}

/// One end of a WebSocket.
pub struct Client {
    pub socket: WebSocket<TcpStream>,
    /// The subprotocol that the server chose.
    pub protocol: Option<String>,
}

impl Client {
    pub fn send(&mut self, text: &str) {
        self.socket.send(Message::text(text)).expect("the server reads");
    }

    /// Sends a frame of weights at `t`, the jaw as wide as `jaw`.
    pub fn frame(&mut self, t: f64, jaw: f64) {
        self.send(&format!(r#"{{"type":"frame","t":{t},"weights":{{"jawOpen":{jaw},"browInnerUp":{jaw}}}}}"#));
    }

    /// The next text message.
    pub fn text(&mut self) -> String {
        loop {
            match self.socket.read().expect("a message comes") {
                Message::Text(text) => return text.to_string(),
                Message::Close(frame) => panic!("closed instead of a text: {frame:?}"),
                _ => {}
            }
        }
    }

    /// The next error's code and message.
    pub fn error(&mut self) -> (String, String) {
        let text = self.text();
        let value: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(value["type"], "error", "{text}");
        (value["code"].as_str().unwrap().to_owned(), value["message"].as_str().unwrap().to_owned())
    }

    /// The server's close frame, after anything else it still says.
    pub fn close_frame(&mut self) -> CloseFrame {
        let frame = loop {
            match self.socket.read().expect("a close frame comes before the end") {
                Message::Close(frame) => break frame.expect("it says why"),
                _ => continue,
            }
        };
        // Answers the close.
        while self.socket.read().is_ok() {}
        frame
    }
}

/// A viewer and what it has learnt.
pub struct Viewer {
    pub client: Client,
    pub hello: ViewHello,
    pub frame: FaceFrame,
    pub at_rest: FaceFrame,
    pub num_keys: usize,
    decoder: Decoder,
}

impl Viewer {
    /// Takes the hello.
    pub fn new(mut client: Client) -> Self {
        let text = client.text();
        let Ok(ViewMessage::Hello(hello)) = serde_json::from_str(&text) else { panic!("the first message is no hello: {text}") };
        // The pong that the ping before the hello asks for.
        client.socket.flush().unwrap();
        let decoder = Decoder::new(PacketLayout::try_from(&hello.character).unwrap());
        Self { frame: decoder.layout().frame_at_rest(), at_rest: decoder.layout().frame_at_rest(), decoder, hello, client, num_keys: 0 }
    }

    /// The next packet, decoded into `self.frame`; false where the socket closed.
    pub fn next_packet(&mut self) -> bool {
        loop {
            match self.client.socket.read() {
                Ok(Message::Binary(packet)) => {
                    let kind = self.decoder.decode(&packet, &mut self.frame).expect("every packet can be read when it comes");
                    self.num_keys += usize::from(kind == PacketKind::Key);
                    return true;
                }
                Ok(Message::Close(_)) => return false,
                Ok(_) => {}
                Err(error) => panic!("viewer: {error}"),
            }
        }
    }

    /// As [`Self::next_packet`], but false where none comes within the socket's read time-out.
    pub fn try_packet(&mut self) -> bool {
        loop {
            match self.client.socket.read() {
                Ok(Message::Binary(packet)) => {
                    self.decoder.decode(&packet, &mut self.frame).expect("every packet can be read when it comes");
                    return true;
                }
                Ok(Message::Close(frame)) => panic!("closed: {frame:?}"),
                Ok(_) => {}
                Err(tungstenite::Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => return false,
                Err(error) => panic!("viewer: {error}"),
            }
        }
    }

    /// The bytes of the next packet.
    pub fn next_bytes(&mut self) -> Vec<u8> {
        loop {
            if let Message::Binary(packet) = self.client.socket.read().expect("a packet comes") {
                return packet.to_vec();
            }
        }
    }

    /// The next frame of a JSON viewer.
    pub fn next_json(&mut self) -> JsonFrame {
        let text = self.client.text();
        match serde_json::from_str(&text) {
            Ok(ViewMessage::Frame(frame)) => frame,
            _ => panic!("not a frame: {text}"),
        }
    }
}
