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
        let has_nats = nats_server().arg("--version").stdout(Stdio::null()).status().is_ok();
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
            trial("face_is_back_with_its_neutral_when_its_node_is_killed", face_is_back_with_its_neutral_when_its_node_is_killed),
            trial("face_is_back_when_its_node_is_stopped_and_nothing_old_comes_when_it_goes_on", stopped_node),
            trial("own_rooms_go_on_without_nats_and_all_joins_again_when_it_is_back", nats_dies),
            trial("rolling_restart_under_load_is_hardly_seen", rolling_restart),
            trial("tracker_over_udp_holds_its_room_before_all_nodes", tracker_over_udp),
            trial("password_and_certificates_of_nats_are_passed_through", password_and_certificates),
            trial("credentials_of_an_account_are_passed_through", credentials),
            trial("node_whose_link_is_cut_goes_on_alone_and_joins_again", cut_link)
                .with_ignored_flag(!has_nats || !Namespace::is_possible()),
        ];
        libtest_mimic::run(&Arguments::from_args(), trials).exit_code()
    }

    /// Debian puts it where only root's path leads.
    fn nats_server() -> Command {
        let path = Path::new("/usr/sbin/nats-server");
        Command::new(if path.is_file() { path } else { Path::new("nats-server") })
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
            let address = more.iter().skip_while(|word| *word != "-a").nth(1).map_or("127.0.0.1", String::as_str).to_owned();
            let child = nats_server()
                .args(["-js", "-p", &port.to_string(), "-sd"])
                .arg(folder.path())
                .args(if more.iter().any(|word| word == "-a") { &[][..] } else { &["-a", "127.0.0.1"] })
                .args(&more)
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            let nats = Self { process: Process(child), port, folder, more };
            wait_for("NATS", || TcpStream::connect((address.as_str(), port)).ok());
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
            Self::spawn(Command::new(env!("CARGO_BIN_EXE_rhytid-server")), nats, folder, listen, more)
        }

        /// In a network of its own.
        fn inside(namespace: &str, nats: &str, folder: &Path, address: &str) -> Self {
            let mut command = Command::new("ip");
            command.args(["netns", "exec", namespace, env!("CARGO_BIN_EXE_rhytid-server")]);
            Self::spawn(command, nats, folder, &format!("{address}:0"), &["--insecure", "--max-connection-rate", "1000"])
        }

        fn spawn(mut command: Command, nats: &str, folder: &Path, listen: &str, more: &[&str]) -> Self {
            static NEXT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
            let log = folder.join(format!("node-{}.log", NEXT.fetch_add(1, Ordering::Relaxed)));
            let mut child = command
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

    /// Writes a feed of weights at 60 Hz: a neutral that is asked for, then a mouth that never rests.
    fn write_feed(folder: &Path, seconds: u32) -> PathBuf {
        let mut feed = HELLO.to_owned();
        for k in 0..seconds * 60 {
            let (t, moves) = (f64::from(k) / 60.0, k > 60);
            let jaw = if moves { 0.5 + 0.4 * (t * 5.0).sin() } else { 0.02 };
            write!(feed, "\n{{\"type\":\"frame\",\"t\":{t:.4},\"weights\":{{\"jawOpen\":{jaw:.4},\"browInnerUp\":0.05}}}}").unwrap();
            if k == 20 {
                feed += "\n{\"type\":\"calibrate\"}";
            }
            if k == 70 {
                feed += "\n{\"type\":\"settings\",\"gains\":{\"mouth\":0.75}}";
            }
        }
        let path = folder.join(format!("feed-{seconds}.jsonl"));
        std::fs::write(&path, feed).unwrap();
        path
    }

    /// The program as users start it, sending to one of `nodes` after the other.
    fn send(feed: &Path, nodes: &[&str], room: &str, log: &Path) -> Process {
        let to: Vec<String> = nodes.iter().map(|node| format!("ws://{node}")).collect();
        let child = Command::new(env!("CARGO_BIN_EXE_rhytid-server"))
            .arg("send")
            .arg(feed)
            .args(["--to", &to.join(","), "--room", room])
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(log).unwrap())
            .spawn()
            .unwrap();
        Process(child)
    }

    /// A packet as a viewer saw it.
    #[derive(Debug, Clone, Copy)]
    struct Seen {
        at: Instant,
        session: u32,
        seq: u32,
        t: u64,
        /// Counts the viewer's connections.
        connection: u32,
    }

    /// Watches a room for as long as it lives, at one of several nodes after the other.
    struct Watch {
        seen: Arc<Mutex<Vec<Seen>>>,
        is_over: Arc<AtomicBool>,
        thread: Option<JoinHandle<()>>,
    }

    impl Watch {
        fn start(nodes: &[&str], room: &str) -> Self {
            let nodes: Vec<String> = nodes.iter().map(|node| (*node).to_owned()).collect();
            let (seen, is_over, room) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)), room.to_owned());
            let thread = std::thread::spawn({
                let (seen, is_over) = (seen.clone(), is_over.clone());
                move || {
                    for (connection, node) in (0..).zip(nodes.iter().cycle()) {
                        if is_over.load(Ordering::Relaxed) {
                            return;
                        }
                        if Self::watch(node, &room, connection, &seen, &is_over).is_none() {
                            std::thread::sleep(Duration::from_millis(20));
                        }
                    }
                }
            });
            Self { seen, is_over, thread: Some(thread) }
        }

        /// One connection. Everything that comes can be read.
        fn watch(node: &str, room: &str, connection: u32, seen: &Mutex<Vec<Seen>>, is_over: &AtomicBool) -> Option<()> {
            let stream = TcpStream::connect(node).ok()?;
            stream.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
            let (mut socket, _) = tungstenite::client(format!("ws://{node}/v1/rooms/{room}/view"), stream).ok()?;
            socket.get_ref().set_read_timeout(Some(Duration::from_millis(100))).unwrap();
            let mut decoder = None;
            while !is_over.load(Ordering::Relaxed) {
                match socket.read() {
                    Ok(Message::Text(text)) => {
                        let Ok(ViewMessage::Hello(hello)) = serde_json::from_str(&text) else { panic!("{text}") };
                        let layout = PacketLayout::try_from(&hello.character).unwrap();
                        decoder = Some((layout.frame_at_rest(), Decoder::new(layout)));
                    }
                    Ok(Message::Binary(packet)) => {
                        let (frame, decoder) = decoder.as_mut().expect("the hello comes first");
                        decoder.decode(&packet, frame).expect("every packet can be read when it comes");
                        let (session, seq, t) = (frame.session, frame.seq, frame.captured_at_micros);
                        seen.lock().unwrap().push(Seen { at: Instant::now(), session, seq, t, connection });
                    }
                    Ok(_) => {}
                    Err(tungstenite::Error::Io(error))
                        if matches!(error.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => {}
                    Err(_) => return Some(()),
                }
            }
            Some(())
        }

        fn last(&self) -> Option<Seen> {
            self.seen.lock().unwrap().last().copied()
        }

        /// Waits for a packet that is sent after now.
        fn wait_for_more(&self, what: &str) -> Seen {
            let now = Instant::now();
            wait_for(what, || self.last().filter(|seen| seen.at > now))
        }

        /// Ends it. Nothing was seen that goes backwards: of sessions, of sequence numbers and times within one. The newest state
        /// may come once more, when the viewer is at another node.
        fn finish(mut self) -> Vec<Seen> {
            self.is_over.store(true, Ordering::Relaxed);
            self.thread.take().unwrap().join().unwrap();
            let mut seen = std::mem::take(&mut *self.seen.lock().unwrap());
            // A new connection begins with the key packet that the newest one needs.
            let mut connection = 0;
            let mut newest = (0, 0);
            seen.retain(|seen| {
                let is_first = std::mem::replace(&mut connection, seen.connection) != seen.connection;
                let is_old = is_first && (seen.session, seen.seq) < newest;
                newest = newest.max((seen.session, seen.seq));
                !is_old
            });
            for pair in seen.windows(2) {
                let [before, after] = pair else { unreachable!() };
                let is_next = (after.session, after.seq) >= (before.session, before.seq);
                assert!(is_next && (after.session > before.session || after.t >= before.t), "{before:?} before {after:?}");
            }
            seen
        }
    }

    /// The longest pause between packets, and how many of them there were more than once.
    fn pause(seen: &[Seen]) -> Duration {
        seen.windows(2).map(|pair| pair[1].at - pair[0].at).max().unwrap_or_default()
    }

    fn num_twice(seen: &[Seen]) -> usize {
        seen.windows(2).filter(|pair| (pair[0].session, pair[0].seq) == (pair[1].session, pair[1].seq)).count()
    }

    /// What a room's home says of the settings in use.
    fn settings(node: &Node, room: &str) -> Value {
        let mut socket = node.socket(&format!("{room}/control"));
        socket.send(Message::text(r#"{"type":"settings"}"#)).unwrap();
        loop {
            match socket.read().unwrap() {
                Message::Text(text) => return serde_json::from_str(&text).unwrap(),
                Message::Close(frame) => panic!("{frame:?}"),
                _ => {}
            }
        }
    }

    fn neutral(node: &Node, room: &str) -> Option<Value> {
        Some(node.room(room)?["neutral"].clone()).filter(|neutral| !neutral.is_null())
    }

    fn face_is_back_with_its_neutral_when_its_node_is_killed() {
        let mut cluster = Cluster::start();
        let addresses: Vec<String> = cluster.nodes.iter().map(|node| node.address.clone()).collect();
        let [a, b, c] = &addresses.iter().map(String::as_str).collect::<Vec<_>>()[..] else { unreachable!() };
        let feed = write_feed(cluster.folder.path(), 30);
        let log = cluster.folder.path().join("send.log");
        let watches = [Watch::start(&[b], "demo"), Watch::start(&[c], "demo"), Watch::start(&[a, c], "demo")];
        let mut sender = send(&feed, &[a, b, c], "demo", &log);
        let neutral_before = wait_for("a neutral", || neutral(&cluster.nodes[0], "demo"));
        // The settings of the feed have come, too.
        wait_for("the settings", || {
            // So many may be asked for.
            std::thread::sleep(Duration::from_millis(100));
            (settings(&cluster.nodes[0], "demo")["gains"]["mouth"] == 0.75).then_some(())
        });
        std::thread::sleep(Duration::from_millis(300));
        let session = watches[0].last().expect("it is seen").session;

        cluster.nodes[0].process.kill();
        for watch in &watches {
            wait_for("the next session", || watch.last().filter(|seen| seen.session > session));
        }
        std::thread::sleep(Duration::from_millis(500));
        let neutral_after = neutral(&cluster.nodes[1], "demo").expect("it is kept");
        assert_eq!((&neutral_after["t"], &neutral_after["num_frames"]), (&neutral_before["t"], &neutral_before["num_frames"]));
        assert_eq!(settings(&cluster.nodes[1], "demo")["gains"]["mouth"], 0.75);
        assert!(sender.0.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
        for (watch, node) in watches.into_iter().zip(["b", "c", "a, then c"]) {
            let seen = watch.finish();
            println!("killed: viewer at {node}: the face was gone for {:?}", pause(&seen));
            assert!(pause(&seen) < BACK_WITHIN, "{node}: {:?}", pause(&seen));
        }
    }

    fn stopped_node() {
        let cluster = Cluster::start();
        let [a, b, c] = &cluster.nodes[..] else { unreachable!() };
        let feed = write_feed(cluster.folder.path(), 30);
        let watches = [Watch::start(&[&b.address], "demo"), Watch::start(&[&c.address], "demo")];
        // Stays where it is, with its connection.
        let at_stopped = Watch::start(&[&a.address], "demo");
        let _sender = send(&feed, &[&a.address, &b.address, &c.address], "demo", &cluster.folder.path().join("send.log"));
        wait_for("a neutral", || neutral(a, "demo"));
        for watch in &watches {
            watch.wait_for_more("a face");
        }
        let session = at_stopped.wait_for_more("a face").session;

        a.process.signal(Signal::STOP);
        for watch in &watches {
            wait_for("the next session", || watch.last().filter(|seen| seen.session > session));
        }
        std::thread::sleep(Duration::from_millis(500));
        a.process.signal(Signal::CONT);
        wait_for("the new session at the node that goes on", || at_stopped.last().filter(|seen| seen.session > session));
        std::thread::sleep(Duration::from_millis(500));
        assert!(b.room("demo").unwrap()["publisher"]["source"] == "test", "{}", b.rooms());
        for (watch, node) in watches.into_iter().zip(["b", "c"]) {
            let seen = watch.finish();
            println!("stopped: viewer at {node}: the face was gone for {:?}", pause(&seen));
            assert!(pause(&seen) < BACK_WITHIN, "{node}: {:?}", pause(&seen));
            assert_eq!(num_twice(&seen), 0);
        }
        assert_eq!(num_twice(&at_stopped.finish()), 0);
    }

    fn nats_dies() {
        let mut cluster = Cluster::start();
        let feed = write_feed(cluster.folder.path(), 60);
        let (a, b, c) = (&cluster.nodes[0], &cluster.nodes[1], &cluster.nodes[2]);
        let log = cluster.folder.path().join("send.log");
        let mut sender = send(&feed, &[&a.address], "demo", &log);
        let (near, far) = (Watch::start(&[&a.address], "demo"), Watch::start(&[&b.address], "demo"));
        far.wait_for_more("a face elsewhere");
        let health = |node: &Node| node.get("/healthz").expect("it says 200");
        // Once with what it has kept, and once without.
        for keeps in [true, false] {
            cluster.nats.process.kill();
            for node in [a, b, c] {
                wait_for("the health to tell it", || health(node).starts_with("degraded").then_some(()));
            }
            let mut alone = b.publisher("alone", HELLO).ready();
            alone.frame(0.3);
            near.wait_for_more("the face at its own node");
            std::thread::sleep(Duration::from_secs(1));
            let before = far.last().unwrap().at;
            if !keeps {
                cluster.nats.folder = Arc::new(tempfile::tempdir().unwrap());
            }
            cluster.nats.restart();
            let start = Instant::now();
            for node in [a, b, c] {
                wait_for("all to join again", || (health(node) == "ok\n").then_some(()));
            }
            wait_for("the face elsewhere", || far.last().filter(|seen| seen.at > before));
            println!("nats: all have joined again after {:?}, its data {}", start.elapsed(), if keeps { "kept" } else { "lost" });
            // What was opened in between is the cluster's, too.
            wait_for("the leases", || {
                let log = std::fs::read_to_string(&b.log).unwrap();
                let num_claimed = log.lines().filter(|line| line.contains("before all nodes") && line.contains("alone")).count();
                (num_claimed >= if keeps { 1 } else { 2 }).then_some(())
            });
            let refused = c.publisher("alone", HELLO).answer();
            assert_eq!(refused["code"], "room_taken", "{refused}");
            alone.socket.close(None).unwrap();
            while alone.socket.read().is_ok() {}
        }
        let refused = c.publisher("demo", HELLO).answer();
        assert_eq!(refused["code"], "room_taken", "{refused}");
        assert!(sender.0.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
        let near = near.finish();
        assert!(pause(&near) < Duration::from_millis(700), "the room's own viewer: {:?}", pause(&near));
        let sessions = near.iter().map(|seen| seen.session).collect::<std::collections::BTreeSet<_>>();
        assert_eq!((sessions.len(), num_twice(&near), num_twice(&far.finish())), (1, 0, 0));
    }

    fn rolling_restart() {
        let mut cluster = Cluster::start();
        let addresses: Vec<String> = cluster.nodes.iter().map(|node| node.address.clone()).collect();
        let from = |k: usize| (0..3).map(|i| addresses[(k + i) % 3].as_str()).collect::<Vec<_>>();
        let feed = write_feed(cluster.folder.path(), 60);
        let folder = cluster.folder.clone();
        let log = |k: usize| folder.path().join(format!("send-{k}.log"));
        let mut senders: Vec<Process> = (0..6).map(|k| send(&feed, &from(k), &format!("room-{k}"), &log(k))).collect();
        let watches: Vec<Watch> = (0..18).map(|k| Watch::start(&from(k / 6), &format!("room-{}", k % 6))).collect();
        for watch in &watches {
            watch.wait_for_more("a face");
        }
        for k in 0..3 {
            cluster.nodes[k].process.signal(Signal::TERM);
            let status = cluster.nodes[k].process.0.wait().unwrap();
            assert!(status.success(), "{status}");
            cluster.nodes[k] = Node::with(&cluster.nats.url(), folder.path(), &addresses[k], &[]).ready();
            std::thread::sleep(Duration::from_millis(500));
            for watch in &watches {
                watch.wait_for_more("a face after a restart");
            }
        }
        for (k, sender) in senders.iter_mut().enumerate() {
            assert!(sender.0.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(log(k)).unwrap());
        }
        let pauses: Vec<Duration> = watches.into_iter().map(|watch| pause(&watch.finish())).collect();
        println!("rolling restart: 6 rooms, 18 viewers, longest pause {:?}", pauses.iter().max().unwrap());
        assert!(pauses.iter().all(|pause| *pause < BACK_WITHIN), "{pauses:?}");
    }

    fn tracker_over_udp() {
        let nats = Nats::start();
        let folder = nats.folder.path();
        let port = free_port();
        let a = Node::with(&nats.url(), folder, "127.0.0.1:0", &["--listen-udp", &format!("livelink=127.0.0.1:{port},room=demo")]).ready();
        let b = Node::start(&nats.url(), folder).ready();
        let child = Command::new(env!("CARGO_BIN_EXE_rhytid-server"))
            .arg("fake")
            .arg(write_feed(folder, 20))
            .args(["--as", "livelink", "--to", &format!("127.0.0.1:{port}")])
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let phone = Process(child);
        let watch = Watch::start(&[&b.address], "demo");
        watch.wait_for_more("a phone's face at another node");
        let refused = b.publisher("demo", HELLO).answer();
        assert_eq!(refused["code"], "room_elsewhere", "{refused}");
        // A room that is another node's is not the phone's.
        drop(phone);
        let mut publisher = b.publisher("demo", &HELLO.replace('}', r#","takeover":true}"#)).ready();
        let _phone = Process(
            Command::new(env!("CARGO_BIN_EXE_rhytid-server"))
                .arg("fake")
                .arg(write_feed(folder, 20))
                .args(["--as", "livelink", "--to", &format!("127.0.0.1:{port}")])
                .stderr(Stdio::null())
                .spawn()
                .unwrap(),
        );
        wait_for("the phone's refusal", || {
            let metrics = a.get("/metrics")?;
            metrics.lines().any(|line| line.contains("room_elsewhere") && !line.ends_with(" 0")).then_some(())
        });
        publisher.frame(0.3);
        assert_eq!(a.room("demo").unwrap()["publisher"]["source"], "test");
        watch.finish();
    }

    fn password_and_certificates() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let (authority_key, key) = (rcgen::KeyPair::generate().unwrap(), rcgen::KeyPair::generate().unwrap());
        let mut authority = rcgen::CertificateParams::new([]).unwrap();
        authority.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        std::fs::write(path("ca.pem"), authority.self_signed(&authority_key).unwrap().pem()).unwrap();
        let issuer = rcgen::Issuer::new(authority, authority_key);
        let mut params = rcgen::CertificateParams::new(["127.0.0.1".to_owned()]).unwrap();
        params.distinguished_name = rcgen::DistinguishedName::new();
        let cert = params.signed_by(&key, &issuer).unwrap();
        std::fs::write(path("cert.pem"), cert.pem()).unwrap();
        std::fs::write(path("key.pem"), key.serialize_pem()).unwrap();
        let (ca, cert, key) = (path("ca.pem"), path("cert.pem"), path("key.pem"));
        let nats = Nats::with(&["--tls", "--tlscert", &cert, "--tlskey", &key, "--user", "node", "--pass", "s3cret"]);
        let url = |word: &str| format!("tls://node:{word}@127.0.0.1:{}", nats.port);
        let a = Node::with(&url("s3cret"), folder.path(), "127.0.0.1:0", &["--cluster-ca", &ca]).ready();
        let mut publisher = a.publisher("demo", HELLO).ready();
        let watch = Watch::start(&[&a.address], "demo");
        publisher.frame(0.3);
        watch.wait_for_more("a face");
        for (word, more) in [("wrong", &["--cluster-ca", &ca][..]), ("s3cret", &[])] {
            let outside = Node::with(&url(word), folder.path(), "127.0.0.1:0", more);
            std::thread::sleep(Duration::from_millis(500));
            assert!(outside.get("/healthz").unwrap().starts_with("degraded"), "{word} {more:?}");
            assert!(!std::fs::read_to_string(&outside.log).unwrap().contains("s3cret"), "passwords are not logged");
        }
        watch.finish();
    }

    /// Text of a JSON Web Token as NATS signs it.
    fn signed(by: &nkeys::KeyPair, subject: &str, claims: &Value) -> String {
        let claims =
            json!({ "jti": subject, "iat": 1_700_000_000, "iss": by.public_key(), "sub": subject, "name": "test", "nats": claims });
        let text = format!("{}.{}", base64url(br#"{"typ":"JWT","alg":"ed25519-nkey"}"#), base64url(claims.to_string().as_bytes()));
        format!("{text}.{}", base64url(&by.sign(text.as_bytes()).unwrap()))
    }

    /// RFC 4648, 5, without padding.
    fn base64url(bytes: &[u8]) -> String {
        const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
        let mut text = String::new();
        for three in bytes.chunks(3) {
            let bits = (0..3).fold(0_u32, |bits, k| bits << 8 | u32::from(three.get(k).copied().unwrap_or(0)));
            text.extend((0..=three.len()).map(|k| char::from(LETTERS[(bits >> (18 - 6 * k)) as usize & 63])));
        }
        text
    }

    fn credentials() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let (operator, account, system) = (nkeys::KeyPair::new_operator(), nkeys::KeyPair::new_account(), nkeys::KeyPair::new_account());
        let user = nkeys::KeyPair::new_user();
        let limits = json!({
            "subs": -1, "data": -1, "payload": -1, "imports": -1, "exports": -1, "wildcards": true, "conn": -1, "leaf": -1,
            "mem_storage": -1, "disk_storage": -1, "streams": -1, "consumer": -1,
        });
        let of_account = json!({ "type": "account", "version": 2, "limits": limits });
        let plain = json!({ "type": "account", "version": 2, "limits": { "subs": -1, "data": -1, "payload": -1, "conn": -1, "leaf": -1 } });
        let of_operator = json!({ "type": "operator", "version": 2, "system_account": system.public_key() });
        let config = format!(
            "operator: {}\nsystem_account: {}\nresolver: MEMORY\nresolver_preload: {{\n  {}: {}\n  {}: {}\n}}\n",
            signed(&operator, &operator.public_key(), &of_operator),
            system.public_key(),
            account.public_key(),
            signed(&operator, &account.public_key(), &of_account),
            system.public_key(),
            signed(&operator, &system.public_key(), &plain),
        );
        std::fs::write(path("nats.conf"), config).unwrap();
        let of_user = json!({ "type": "user", "version": 2, "subs": -1, "data": -1, "payload": -1 });
        let jwt = signed(&account, &user.public_key(), &of_user);
        let dashes = "-----";
        let creds = format!(
            "{dashes}BEGIN NATS USER JWT{dashes}\n{jwt}\n{dashes}-END NATS USER JWT-{dashes}\n\n\
             {dashes}BEGIN USER NKEY SEED{dashes}\n{}\n{dashes}-END USER NKEY SEED-{dashes}\n",
            user.seed().unwrap()
        );
        std::fs::write(path("node.creds"), creds).unwrap();
        let nats = Nats::with(&["-c", &path("nats.conf")]);
        let a = Node::with(&nats.url(), folder.path(), "127.0.0.1:0", &["--cluster-creds", &path("node.creds")]).ready();
        a.publisher("demo", HELLO).ready();
        let outside = Node::start(&nats.url(), folder.path());
        std::thread::sleep(Duration::from_millis(500));
        assert!(outside.get("/healthz").unwrap().starts_with("degraded"), "without them nobody comes in");
    }

    /// A network of its own with two cables to this one.
    struct Namespace {
        name: String,
        cables: [(String, String, String); 2],
    }

    fn ip(words: &str) -> bool {
        let status = Command::new("ip").args(words.split(' ')).stdout(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success())
    }

    impl Namespace {
        /// This machine lets it be made.
        fn is_possible() -> bool {
            Self::make().is_some()
        }

        fn make() -> Option<Self> {
            static NEXT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
            let number = (std::process::id() + 7 * NEXT.fetch_add(1, Ordering::Relaxed)) % 250;
            let name = format!("rhytid{number}");
            // Addresses for tests of networks: RFC 2544.
            let cable =
                |k: u32| (format!("rhy{number}-{k}"), format!("198.18.{number}.{}", 1 + 4 * k), format!("198.18.{number}.{}", 2 + 4 * k));
            let namespace = Self { name, cables: [cable(0), cable(1)] };
            let is_made = ip(&format!("netns add {}", namespace.name))
                && namespace.cables.iter().all(|(cable, here, there)| {
                    let name = &namespace.name;
                    ip(&format!("link add {cable} type veth peer name {cable}p netns {name}"))
                        && ip(&format!("addr add {here}/30 dev {cable}"))
                        && ip(&format!("link set {cable} up"))
                        && ip(&format!("-n {name} addr add {there}/30 dev {cable}p"))
                        && ip(&format!("-n {name} link set {cable}p up"))
                })
                && ip(&format!("-n {} link set lo up", namespace.name));
            is_made.then_some(namespace)
        }
    }

    impl Drop for Namespace {
        fn drop(&mut self) {
            for (cable, ..) in &self.cables {
                ip(&format!("link del {cable}"));
            }
            ip(&format!("netns del {}", self.name));
        }
    }

    fn cut_link() {
        let namespace = Namespace::make().expect("it was possible before");
        let [(to_nats, nats_address, _), (_, _, node_address)] = &namespace.cables;
        let nats = Nats::with(&["-a", nats_address]);
        let folder = nats.folder.path();
        let url = format!("nats://{nats_address}:{}", nats.port);
        let b = Node::start(&url, folder).ready();
        let inside = Node::inside(&namespace.name, &url, folder, node_address).ready();
        let feed = write_feed(folder, 60);
        let log = folder.join("send.log");
        let mut sender = send(&feed, &[&inside.address], "demo", &log);
        let (near, far) = (Watch::start(&[&inside.address], "demo"), Watch::start(&[&b.address], "demo"));
        far.wait_for_more("a face elsewhere");
        assert!(ip(&format!("link set {to_nats} down")));
        wait_for("the health to tell it", || inside.get("/healthz").unwrap().starts_with("degraded").then_some(()));
        near.wait_for_more("the face at its own node");
        let before = far.last().unwrap().at;
        assert!(ip(&format!("link set {to_nats} up")));
        let start = Instant::now();
        wait_for("it to join again", || (inside.get("/healthz").unwrap() == "ok\n").then_some(()));
        wait_for("the face elsewhere", || far.last().filter(|seen| seen.at > before));
        println!("cut link: joined again after {:?}", start.elapsed());
        assert!(sender.0.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
        let near = near.finish();
        assert!(pause(&near) < Duration::from_millis(700), "the room's own viewer: {:?}", pause(&near));
        assert_eq!((num_twice(&near), num_twice(&far.finish())), (0, 0));
    }
}
