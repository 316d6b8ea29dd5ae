//! Tokens against the program itself: who gets in, with what, and until when.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

use rhytid_server::{Role, make_key_file, make_token};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::{self, HandshakeError, Message, WebSocket};

const PROGRAM: &str = env!("CARGO_BIN_EXE_rhytid-server");

struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("rhytid-tokens-{}-{name}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        Self(path)
    }

    fn shown(&self) -> &str {
        self.0.to_str().unwrap()
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A server process that ends with the test.
struct Served {
    child: Child,
    port: u16,
}

impl Served {
    fn start(args: &[&str]) -> Self {
        let mut child = Command::new(PROGRAM).arg("serve").args(args).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let port = line.trim().rsplit_once(':').expect("its first line says where it listens").1.parse().unwrap();
        Self { child, port }
    }

    /// Status and body of a GET.
    fn get(&self, path: &str, token: Option<&str>) -> (u16, String) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        let token = token.map(|token| format!("Authorization: Bearer {token}\r\n")).unwrap_or_default();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{token}\r\n").unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        (text[9..12].parse().unwrap(), text.split_once("\r\n\r\n").unwrap().1.to_owned())
    }

    /// A socket, or the code of the error that refused it.
    fn open(&self, path: &str, headers: &[(&'static str, String)]) -> Result<WebSocket<TcpStream>, String> {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let mut request = format!("ws://localhost:{}/v1/rooms/{path}", self.port).into_client_request().unwrap();
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse().unwrap());
        }
        match tungstenite::client(request, stream) {
            Ok((socket, _)) => Ok(socket),
            Err(HandshakeError::Failure(tungstenite::Error::Http(answer))) => {
                let error: serde_json::Value = serde_json::from_slice(answer.body().as_ref().unwrap()).unwrap();
                Err(error["code"].as_str().unwrap().to_owned())
            }
            Err(error) => panic!("{error}"),
        }
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn header(token: &str) -> [(&'static str, String); 1] {
    [("authorization", format!("Bearer {token}"))]
}

#[test]
fn sockets_and_pages_open_to_the_right_token_only() {
    let key = Scratch::new("right");
    make_key_file(&key.0).unwrap();
    let make = |role, room: &str| make_token(&key.0, role, &[room.to_owned()], Duration::from_secs(60)).unwrap();
    let (view, publish, admin) = (make(Role::View, "demo"), make(Role::Publish, "demo"), make(Role::Admin, "*"));
    let server = Served::start(&["--listen", "127.0.0.1:0", "--token-key", key.shown()]);
    let refused = |path: &str, headers: &[(&'static str, String)]| server.open(path, headers).err();

    assert_eq!(refused("demo/view", &[]).as_deref(), Some("token_missing"));
    assert_eq!(refused("demo/view", &header("a.b.c")).as_deref(), Some("token_bad"));
    assert_eq!(refused("demo/view", &header(&view)), None);
    assert_eq!(refused("other/view", &header(&view)).as_deref(), Some("token_room"));
    assert_eq!(refused("demo/publish", &header(&view)).as_deref(), Some("token_role"));
    assert_eq!(refused("demo/publish", &header(&publish)), None);
    assert_eq!(refused("demo/view", &header(&publish)), None);
    assert_eq!(refused("other/publish", &header(&admin)), None);
    // A browser's way. An address is no place for a token.
    let offer = |token: &str| [("sec-websocket-protocol", format!("rhytid.v1, rhytid.token.{token}"))];
    assert_eq!(refused("demo/view", &offer(&view)), None);
    // Who speaks for a source may do to its face what its publisher may.
    assert_eq!(refused("demo/control", &[]).as_deref(), Some("token_missing"));
    assert_eq!(refused("demo/control", &header(&view)).as_deref(), Some("token_role"));
    assert_eq!(refused("other/control", &header(&publish)).as_deref(), Some("token_room"));
    assert_eq!(refused("demo/control", &header(&publish)), None);
    assert_eq!(refused("demo/publish", &offer(&view)).as_deref(), Some("token_role"));
    assert_eq!(refused(&format!("demo/view?token={view}"), &[]).as_deref(), Some("token_missing"));

    assert_eq!(server.get("/healthz", None).0, 200);
    assert_eq!(server.get("/", None).0, 200);
    for path in ["/metrics", "/api/rooms", "/api/trackers", "/api/profiles"] {
        assert_eq!(server.get(path, None).0, 401, "{path}");
        assert_eq!(server.get(path, Some(&publish)).0, 403, "{path}");
        assert_eq!(server.get(path, Some(&admin)).0, 200, "{path}");
    }
    // Who watches a room sees who drives its face, and who publishes to it the profiles to choose from.
    for (path, token, status) in [
        ("/api/rooms?room=demo", &view, 200),
        ("/api/rooms?room=other", &admin, 200),
        ("/api/profiles?room=demo", &publish, 200),
        ("/api/rooms?room=a%20b", &admin, 400),
    ] {
        assert_eq!(server.get(path, Some(token)).0, status, "{path}");
    }
    let (_, metrics) = server.get("/metrics", Some(&admin));
    assert!(metrics.contains("reason=\"token_role\"} 7"), "three sockets and four pages: {metrics}");
    assert_eq!(server.get("/api/rooms?room=other", Some(&view)).0, 403);
    assert_eq!(server.get("/api/profiles?room=demo", Some(&view)).0, 403);
    // A page asks why it is not let in.
    for (query, token, status, said) in [
        ("role=view&room=demo", None, 401, "token_missing"),
        ("role=view&room=demo", Some(&view), 200, "\"tokens\":true"),
        ("role=publish&room=demo", Some(&view), 403, "token_role"),
        ("role=view&room=other", Some(&view), 403, "token_room"),
        ("role=king&room=demo", Some(&admin), 400, "unknown_role"),
        ("role=view&room=a%20b", Some(&admin), 400, "bad_room_name"),
    ] {
        let (got, body) = server.get(&format!("/api/access?{query}"), token.map(String::as_str));
        assert!(got == status && body.contains(said), "{query}: {got} {body}");
    }
}

#[test]
fn sockets_end_with_their_token() {
    let key = Scratch::new("end");
    make_key_file(&key.0).unwrap();
    let server = Served::start(&["--listen", "127.0.0.1:0", "--token-key", key.shown()]);
    for (role, end) in [(Role::View, "view"), (Role::Publish, "publish")] {
        let token = make_token(&key.0, role, &["demo".into()], Duration::from_secs(2)).unwrap();
        let start = Instant::now();
        let mut socket = server.open(&format!("demo/{end}"), &header(&token)).unwrap();
        if role == Role::Publish {
            socket.send(Message::text(r#"{"type":"hello","version":1}"#)).unwrap();
        }
        let mut said = String::new();
        while let Ok(message) = socket.read() {
            match message {
                Message::Text(text) => said = text.to_string(),
                Message::Close(_) => break,
                _ => {}
            }
        }
        assert!(said.contains("token_expired"), "{said}");
        assert!((0.9..10.0).contains(&start.elapsed().as_secs_f64()), "{:?}", start.elapsed());
    }
}

#[test]
fn server_that_others_reach_wants_tokens_or_to_be_told_otherwise() {
    let output = Command::new(PROGRAM).args(["serve", "--listen", "0.0.0.0:0"]).output().unwrap();
    assert!(!output.status.success() && output.stdout.is_empty());
    assert!(String::from_utf8_lossy(&output.stderr).contains("--token-key"), "{output:?}");
    // Datagrams bear no tokens.
    let key = Scratch::new("reach");
    make_key_file(&key.0).unwrap();
    let with_port = |port: &str| {
        let mut child = Command::new(PROGRAM)
            .args(["serve", "--listen", "127.0.0.1:0", "--token-key", key.shown(), "--listen-udp", port])
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let _ = child.kill();
        let mut said = String::new();
        child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
        child.wait().unwrap();
        (line.starts_with("listening"), said)
    };
    let (listens, said) = with_port("livelink=0.0.0.0:0");
    assert!(!listens && said.contains("allow=IP"), "{said}");
    assert!(with_port("livelink=0.0.0.0:0,allow=192.0.2.1").0);
    assert!(with_port("livelink=127.0.0.1:0").0);
    let server = Served::start(&["--listen", "0.0.0.0:0", "--insecure"]);
    assert!(server.open("demo/view", &[]).is_ok());
    assert_eq!(server.get("/metrics", None).0, 200);
}

#[test]
fn commands_make_keys_tokens_and_use_them() {
    let (key, feed, token_file) = (Scratch::new("commands"), Scratch::new("feed"), Scratch::new("token"));
    let run = |args: &[&str]| Command::new(PROGRAM).args(args).env_remove("RHYTID_TOKEN").output().unwrap();
    assert!(run(&["token", "--new-key", key.shown()]).status.success());
    assert!(!run(&["token", "--new-key", key.shown()]).status.success(), "a key is never replaced");
    let made = run(&["token", "--key", key.shown(), "--role", "publish", "--room", "demo", "--for", "1h"]);
    assert!(made.status.success(), "{made:?}");
    std::fs::write(&token_file.0, &made.stdout).unwrap();
    std::fs::write(&feed.0, "{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n").unwrap();
    let server = Served::start(&["--listen", "127.0.0.1:0", "--token-key", key.shown()]);
    let to = format!("ws://localhost:{}", server.port);
    let sent = run(&["send", feed.shown(), "--to", &to, "--token-file", token_file.shown()]);
    assert!(sent.status.success(), "{sent:?}");
    let refused = run(&["send", feed.shown(), "--to", &to]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("a token is needed"), "{refused:?}");
    let in_the_clear = run(&["send", feed.shown(), "--to", "ws://192.0.2.1:9", "--token-file", token_file.shown()]);
    assert!(String::from_utf8_lossy(&in_the_clear.stderr).contains("wss://"), "{in_the_clear:?}");
    for wrong in [
        &["token", "--key", key.shown(), "--role", "view"][..],
        &["token", "--key", key.shown(), "--role", "view", "--room", "a", "--for", "8"],
    ] {
        assert!(!run(wrong).status.success(), "{wrong:?}");
    }
}
