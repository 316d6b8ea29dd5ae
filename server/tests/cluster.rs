//! Three nodes and a real `nats-server`: one face for all of them, whichever dies, stops or is cut off. Where there is no
//! `nats-server`, all of it shows as ignored.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

fn main() -> std::process::ExitCode {
    #[cfg(target_os = "linux")]
    return linux::main();
    #[cfg(not(target_os = "linux"))]
    std::process::ExitCode::SUCCESS
}

#[cfg(target_os = "linux")]
mod linux {
    use libtest_mimic::{Arguments, Trial};
    use rhytid_shared::packet::{Decoder, PacketLayout};
    use rhytid_shared::view::{ViewHello, ViewMessage};
    use rustix::process::{Pid, Signal, kill_process};
    use serde_json::{Value, json};
    use std::fmt::Write as _;
    use std::io::{BufRead, BufReader, Read, Write as _};
    use std::net::{TcpListener, TcpStream};
    use std::path::{Path, PathBuf};
    use std::process::{Child, Command, ExitCode, Stdio};
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::sync::{Arc, Mutex};
    use std::thread::JoinHandle;
    use std::time::{Duration, Instant};
    use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

    /// Longer than anything here takes; a test that waits for it has failed.
    const PATIENCE: Duration = Duration::from_secs(15);
    /// A node is lost: so soon its viewers see the face again.
    const BACK_WITHIN: Duration = Duration::from_secs(2);
    const HELLO: &str = r#"{"type":"hello","version":1,"source":"test","fps":60}"#;

    pub fn main() -> ExitCode {
        let has_nats = Command::new("nats-server").arg("--version").stdout(Stdio::null()).status().is_ok();
        if !has_nats {
            println!("no nats-server on this machine (Debian: apt-get install nats-server): the cluster's tests are ignored");
        }
        let trial = |name: &str, test: fn()| {
            Trial::test(name, move || {
                test();
                Ok(())
            })
            .with_ignored_flag(!has_nats)
        };
        let trials = vec![
            trial("viewers_at_all_nodes_get_the_same_packets", viewers_at_all_nodes_get_the_same_packets),
            trial("late_viewer_elsewhere_gets_the_newest_face_at_once", late_viewer_elsewhere_gets_the_newest_face_at_once),
            trial("room_has_one_publisher_in_the_whole_cluster", room_has_one_publisher_in_the_whole_cluster),
        ];
        libtest_mimic::run(&Arguments::from_args(), trials).exit_code()
    }

    fn free_port() -> u16 {
        TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
    }

    fn wait_for<T>(what: &str, mut find: impl FnMut() -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            if let Some(found) = find() {
                return found;
            }
            assert!(start.elapsed() < PATIENCE, "{what} does not come");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// A process that ends with the test.
    struct Process(Child);

    impl Process {
        fn signal(&self, signal: Signal) {
            kill_process(Pid::from_raw(self.0.id() as i32).unwrap(), signal).unwrap();
        }

        fn kill(&mut self) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }

    impl Drop for Process {
        fn drop(&mut self) {
            self.kill();
        }
    }

    /// A NATS server with JetStream.
    struct Nats {
        process: Process,
        port: u16,
        folder: Arc<tempfile::TempDir>,
        more: Vec<String>,
    }

    impl Nats {
        fn start() -> Self {
            Self::with(&[])
        }

        fn with(more: &[&str]) -> Self {
            let more = more.iter().map(|word| (*word).to_owned()).collect();
            Self::at(free_port(), Arc::new(tempfile::tempdir().unwrap()), more)
        }

        fn at(port: u16, folder: Arc<tempfile::TempDir>, more: Vec<String>) -> Self {
            let child = Command::new("nats-server")
                .args(["-js", "-a", "127.0.0.1", "-p", &port.to_string(), "-sd"])
                .arg(folder.path())
                .args(&more)
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            let nats = Self { process: Process(child), port, folder, more };
            wait_for("NATS", || TcpStream::connect(("127.0.0.1", port)).ok());
            nats
        }

        fn restart(&mut self) {
            *self = Self::at(self.port, self.folder.clone(), self.more.clone());
        }

        fn url(&self) -> String {
            format!("nats://127.0.0.1:{}", self.port)
        }
    }

    struct Node {
        process: Process,
        address: String,
        log: PathBuf,
    }

    impl Node {
        fn start(nats: &str, folder: &Path) -> Self {
            Self::with(nats, folder, "127.0.0.1:0", &[])
        }

        fn with(nats: &str, folder: &Path, listen: &str, more: &[&str]) -> Self {
            static NEXT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
            let log = folder.join(format!("node-{}.log", NEXT.fetch_add(1, Ordering::Relaxed)));
            let mut child = Command::new(env!("CARGO_BIN_EXE_rhytid-server"))
                .args(["serve", "--listen", listen, "--cluster", nats])
                .args(more)
                .env("RUST_LOG", "rhytid_server=debug,info")
                .stdout(Stdio::piped())
                .stderr(std::fs::File::create(&log).unwrap())
                .spawn()
                .unwrap();
            let mut line = String::new();
            BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
            let address = line.trim().strip_prefix("listening on http://").unwrap_or_else(|| panic!("{line:?}")).to_owned();
            Self { process: Process(child), address, log }
        }

        /// Waits until it has joined.
        fn ready(self) -> Self {
            wait_for("a node's joining", || (self.get("/healthz")?.trim() == "ok").then_some(()));
            self
        }

        /// The body of an answer of status 200.
        fn get(&self, path: &str) -> Option<String> {
            let mut stream = TcpStream::connect(&self.address).ok()?;
            stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
            write!(stream, "GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n", self.address).ok()?;
            let mut answer = String::new();
            stream.read_to_string(&mut answer).ok()?;
            let (head, body) = answer.split_once("\r\n\r\n")?;
            head.starts_with("HTTP/1.1 200").then(|| body.to_owned())
        }

        fn rooms(&self) -> Value {
            serde_json::from_str(&self.get("/api/rooms").unwrap()).unwrap()
        }

        fn room(&self, name: &str) -> Option<Value> {
            self.rooms()["rooms"].as_array().unwrap().iter().find(|room| room["name"] == name).cloned()
        }

        fn socket(&self, path: &str) -> WebSocket<TcpStream> {
            let stream = TcpStream::connect(&self.address).unwrap();
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
            stream.set_nodelay(true).unwrap();
            tungstenite::client(format!("ws://{}/v1/rooms/{path}", self.address), stream).unwrap().0
        }

        fn publisher(&self, room: &str, hello: &str) -> Publisher {
            let mut publisher = Publisher { socket: self.socket(&format!("{room}/publish")), t: 0.0 };
            publisher.socket.send(Message::text(hello)).unwrap();
            publisher
        }

        fn viewer(&self, room: &str) -> Viewer {
            Viewer::new(self.socket(&format!("{room}/view")))
        }
    }

    struct Cluster {
        nodes: Vec<Node>,
        nats: Nats,
        folder: Arc<tempfile::TempDir>,
    }

    impl Cluster {
        fn start() -> Self {
            let nats = Nats::start();
            let folder = nats.folder.clone();
            let nodes: Vec<Node> = (0..3).map(|_| Node::start(&nats.url(), folder.path())).collect();
            Self { nodes: nodes.into_iter().map(Node::ready).collect(), nats, folder }
        }
    }

    struct Publisher {
        socket: WebSocket<TcpStream>,
        t: f64,
    }

    impl Publisher {
        /// The next message of the server's.
        fn answer(&mut self) -> Value {
            loop {
                match self.socket.read().unwrap() {
                    Message::Text(text) => return serde_json::from_str(&text).unwrap(),
                    Message::Close(frame) => panic!("closed: {frame:?}"),
                    _ => {}
                }
            }
        }

        fn ready(mut self) -> Self {
            let answer = self.answer();
            assert_eq!(answer["type"], "ready", "{answer}");
            self
        }

        fn frame(&mut self, jaw: f64) {
            self.t += 1.0 / 60.0;
            let frame = json!({ "type": "frame", "t": self.t, "weights": { "jawOpen": jaw, "browInnerUp": 0.5 } });
            self.socket.send(Message::text(frame.to_string())).unwrap();
        }
    }

    struct Viewer {
        socket: WebSocket<TcpStream>,
        hello: ViewHello,
    }

    impl Viewer {
        fn new(mut socket: WebSocket<TcpStream>) -> Self {
            loop {
                if let Message::Text(text) = socket.read().unwrap() {
                    let Ok(ViewMessage::Hello(hello)) = serde_json::from_str(&text) else { panic!("{text}") };
                    socket.flush().unwrap();
                    return Self { socket, hello };
                }
            }
        }

        fn packet(&mut self) -> Vec<u8> {
            loop {
                if let Message::Binary(packet) = self.socket.read().unwrap() {
                    return packet.to_vec();
                }
            }
        }
    }

    fn viewers_at_all_nodes_get_the_same_packets() {
        let cluster = Cluster::start();
        let [a, b, c] = &cluster.nodes[..] else { unreachable!() };
        let mut publisher = a.publisher("demo", HELLO).ready();
        let mut viewers = [a.viewer("demo"), b.viewer("demo"), c.viewer("demo")];
        // Until the subscriptions stand: the first packets that all have.
        publisher.frame(0.0);
        viewers.iter_mut().for_each(|viewer| drop(viewer.packet()));
        for k in 1..200 {
            publisher.frame(f64::from(k % 50) / 50.0);
            let [first, second, third] = viewers.each_mut().map(Viewer::packet);
            assert_eq!((&first, &first), (&second, &third), "packet {k}");
        }
        let room = wait_for("the listing of the whole cluster", || {
            let room = c.room("demo")?;
            (room["viewers"] == 3 && room["publisher"]["source"] == "test").then_some(room)
        });
        assert_eq!(room["nodes"].as_object().unwrap().len(), 3, "{room}");
        assert_eq!(c.rooms()["nodes"].as_object().unwrap().len(), 3);
        // Nobody hears what nobody watches there.
        let unwatched = a.publisher("other", HELLO).ready();
        drop(unwatched);
        assert!(!std::fs::read_to_string(&b.log).unwrap().contains("panicked"));
    }

    fn late_viewer_elsewhere_gets_the_newest_face_at_once() {
        let cluster = Cluster::start();
        let [a, b, _] = &cluster.nodes[..] else { unreachable!() };
        let mut publisher = a.publisher("demo", HELLO).ready();
        for k in 0..90 {
            publisher.frame(f64::from(k) / 90.0);
        }
        let mut near = a.viewer("demo");
        let layout = PacketLayout::try_from(&near.hello.character).unwrap();
        let newest = |viewer: &mut Viewer| {
            let (mut decoder, mut frame) = (Decoder::new(layout.clone()), layout.frame_at_rest());
            while frame.seq < 89 {
                decoder.decode(&viewer.packet(), &mut frame).unwrap();
            }
            frame
        };
        let expected = newest(&mut near);
        // Nothing more is sent: what comes is what the room's home had.
        let start = Instant::now();
        let got = newest(&mut b.viewer("demo"));
        assert_eq!(got, expected);
        assert!(start.elapsed() < Duration::from_secs(1), "{:?}", start.elapsed());
    }

    fn room_has_one_publisher_in_the_whole_cluster() {
        let cluster = Cluster::start();
        let [a, b, c] = &cluster.nodes[..] else { unreachable!() };
        let mut first = a.publisher("demo", HELLO).ready();
        let refused = b.publisher("demo", HELLO).answer();
        assert_eq!((&refused["type"], &refused["code"]), (&json!("error"), &json!("room_taken")), "{refused}");
        let elsewhere = HELLO.replace('}', r#","slot":"phone"}"#);
        let refused = b.publisher("demo", &elsewhere).answer();
        assert_eq!(refused["code"], "room_elsewhere", "{refused}");
        assert!(refused["message"].as_str().unwrap().contains(&a.address), "{refused}");
        let mut viewer = c.viewer("demo");
        first.frame(0.2);
        let before = viewer.packet();
        let mut second = b.publisher("demo", &HELLO.replace('}', r#","takeover":true}"#)).ready();
        let told = first.answer();
        assert_eq!(told["code"], "taken_over", "{told}");
        second.frame(0.7);
        let after = viewer.packet();
        let session = |packet: &[u8]| u32::from_le_bytes(packet[1..5].try_into().unwrap());
        assert!(session(&after) > session(&before), "{} after {}", session(&after), session(&before));
        // One who leaves gives the room back.
        second.socket.close(None).unwrap();
        while second.socket.read().is_ok() {}
        a.publisher("demo", HELLO).ready();
    }
}
