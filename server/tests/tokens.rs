//! Tokens against the program itself: who gets in, with what, and until when.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

#[path = "process/http.rs"]
mod http;
mod process;
#[path = "process/socket.rs"]
mod socket;

use process::{PATIENCE, Server, program};
use rhytid_server::{Role, make_key_file, make_token};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

/// A folder that goes with the test, and a new key in it.
struct Folder(TempDir);

impl Folder {
    fn with_key() -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        make_key_file(Path::new(&folder.key())).unwrap();
        folder
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).to_str().unwrap().to_owned()
    }

    fn key(&self) -> String {
        self.path("key")
    }

    /// A token of its key.
    fn token(&self, role: Role, room: &str, time: Duration) -> String {
        make_token(Path::new(&self.key()), role, &[room.to_owned()], time).unwrap()
    }
}

/// A server that wants tokens.
fn serve(key: &str, args: &[&str]) -> Server {
    Server::start(&[&["serve", "--token-key", key], args].concat())
}

/// Its address, by name.
fn url(server: &Server) -> String {
    server.address.replace("127.0.0.1", "ws://localhost")
}

/// Status and body of a GET.
fn get(server: &Server, path: &str, token: Option<&str>) -> (u16, String) {
    ask(server, "GET", path, token, "")
}

/// Status and body of any request.
fn ask(server: &Server, method: &str, path: &str, token: Option<&str>, body: &str) -> (u16, String) {
    let token = token.map(|token| format!("Authorization: Bearer {token}"));
    http::ask(&server.address, method, path, &token.as_deref().into_iter().collect::<Vec<_>>(), body).unwrap()
}

/// A socket, or the code of the error that refused it.
fn open(server: &Server, path: &str, headers: &[(&'static str, String)]) -> Result<WebSocket<TcpStream>, String> {
    socket::open(&server.address, path, headers, PATIENCE).map_err(|error| {
        let tungstenite::Error::Http(answer) = error else { panic!("{error}") };
        let error: serde_json::Value = serde_json::from_slice(answer.body().as_ref().unwrap()).unwrap();
        error["code"].as_str().unwrap().to_owned()
    })
}

fn header(token: &str) -> [(&'static str, String); 1] {
    [("authorization", format!("Bearer {token}"))]
}

#[test]
fn sockets_and_pages_open_to_the_right_token_only() {
    let folder = Folder::with_key();
    let make = |role, room: &str| folder.token(role, room, Duration::from_secs(60));
    let (view, publish, admin) = (make(Role::View, "demo"), make(Role::Publish, "demo"), make(Role::Admin, "*"));
    let server = serve(&folder.key(), &[]);
    let refused = |path: &str, headers: &[(&'static str, String)]| open(&server, path, headers).err();

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

    assert_eq!(get(&server, "/healthz", None).0, 200);
    assert_eq!(get(&server, "/", None).0, 200);
    for path in ["/metrics", "/api/rooms", "/api/trackers", "/api/profiles"] {
        assert_eq!(get(&server, path, None).0, 401, "{path}");
        assert_eq!(get(&server, path, Some(&publish)).0, 403, "{path}");
        assert_eq!(get(&server, path, Some(&admin)).0, 200, "{path}");
    }
    // Who watches a room sees who drives its face, and who publishes to it the profiles to choose from.
    for (path, token, status) in [
        ("/api/rooms?room=demo", &view, 200),
        ("/api/rooms?room=other", &admin, 200),
        ("/api/profiles?room=demo", &publish, 200),
        ("/api/rooms?room=a%20b", &admin, 400),
    ] {
        assert_eq!(get(&server, path, Some(token)).0, status, "{path}");
    }
    let (_, metrics) = get(&server, "/metrics", Some(&admin));
    assert!(metrics.contains("reason=\"token_role\"} 7"), "three sockets and four pages: {metrics}");
    assert_eq!(get(&server, "/api/rooms?room=other", Some(&view)).0, 403);
    assert_eq!(get(&server, "/api/profiles?room=demo", Some(&view)).0, 403);
    // A page asks why it is not let in.
    for (query, token, status, said) in [
        ("role=view&room=demo", None, 401, "token_missing"),
        ("role=view&room=demo", Some(&view), 200, "\"tokens\":true"),
        ("role=publish&room=demo", Some(&view), 403, "token_role"),
        ("role=view&room=other", Some(&view), 403, "token_room"),
        ("role=king&room=demo", Some(&admin), 400, "unknown_role"),
        ("role=view&room=a%20b", Some(&admin), 400, "bad_room_name"),
    ] {
        let (got, body) = get(&server, &format!("/api/access?{query}"), token.map(String::as_str));
        assert!(got == status && body.contains(said), "{query}: {got} {body}");
    }
}

/// A room's face is in its recordings: they open to no more tokens than the room does.
#[test]
fn recordings_open_to_the_right_token_only() {
    let folder = Folder::with_key();
    let make = |role, room: &str| folder.token(role, room, Duration::from_secs(60));
    let (view, publish, other) = (make(Role::View, "demo"), make(Role::Publish, "demo"), make(Role::Publish, "other"));
    let admin = make(Role::Admin, "*");
    let takes = folder.path("takes");
    std::fs::create_dir(&takes).unwrap();
    let server = serve(&folder.key(), &["--record", &takes, "--record-rooms", "none"]);
    let code = |(status, body): (u16, String)| {
        let said: serde_json::Value = serde_json::from_str(&body).unwrap_or_else(|error| panic!("{error}: {body}"));
        (status, said["code"].as_str().unwrap_or_default().to_owned())
    };
    let (ok, missing) = ((200, String::new()), (401, "token_missing".to_owned()));
    let (role, room) = ((403, "token_role".to_owned()), (403, "token_room".to_owned()));

    // Who publishes to a room records it.
    for (token, expected) in [(None, &missing), (Some(&view), &role), (Some(&other), &room), (Some(&publish), &ok)] {
        let token = token.map(String::as_str);
        assert_eq!(code(ask(&server, "POST", "/api/rooms/demo/record/start", token, "")), *expected, "{token:?}");
    }
    for (token, expected) in [(None, &missing), (Some(&view), &role), (Some(&other), &room), (Some(&publish), &ok)] {
        let token = token.map(String::as_str);
        assert_eq!(code(ask(&server, "POST", "/api/rooms/demo/record/stop", token, "")), *expected, "{token:?}");
    }
    // Which recordings there are, admins see; those of a room, who publishes to it.
    for (path, token, expected) in [
        ("/api/recordings", None, &missing),
        ("/api/recordings", Some(&view), &role),
        ("/api/recordings", Some(&publish), &role),
        ("/api/recordings", Some(&admin), &ok),
        ("/api/recordings?room=demo", Some(&view), &role),
        ("/api/recordings?room=demo", Some(&other), &room),
        ("/api/recordings?room=demo", Some(&publish), &ok),
    ] {
        assert_eq!(code(get(&server, path, token.map(String::as_str))), *expected, "{path} {token:?}");
    }
    let listed: serde_json::Value = serde_json::from_str(&get(&server, "/api/recordings?room=demo", Some(&publish)).1).unwrap();
    let file = listed["recordings"][0]["file"].as_str().unwrap().to_owned();
    let of_other: serde_json::Value = serde_json::from_str(&get(&server, "/api/recordings?room=other", Some(&other)).1).unwrap();
    assert!(file.starts_with("demo-") && of_other["recordings"].as_array().unwrap().is_empty(), "{of_other}");

    // What is played into a room, whoever watches it may know; who plays must publish there, and may watch what is played.
    for (token, expected) in [(None, &missing), (Some(&other), &room), (Some(&view), &ok)] {
        assert_eq!(code(get(&server, "/api/rooms/demo/replay", token.map(String::as_str))), *expected, "{token:?}");
    }
    assert!(get(&server, "/api/rooms/demo/replay", Some(&view)).1.contains("\"control\":false"));
    assert!(get(&server, "/api/rooms/demo/replay", Some(&publish)).1.contains("\"control\":true"));
    let body = serde_json::json!({ "file": file }).to_string();
    let played = |path: &str, token: Option<&String>| code(ask(&server, "POST", path, token.map(String::as_str), &body));
    assert_eq!(played("/api/rooms/demo/replay", None), missing);
    assert_eq!(played("/api/rooms/demo/replay", Some(&view)), role);
    assert_eq!(played("/api/rooms/demo/replay", Some(&other)), room);
    // A recording of another room is not there, whatever state it is in, nor is one that is nobody's.
    let broken = |name: &str| std::fs::write(format!("{takes}/{name}"), b"nonsense").unwrap();
    let play = |name: &str, room: &str, token: &String| {
        let body = serde_json::json!({ "file": name }).to_string();
        let (status, answer) = ask(&server, "POST", &format!("/api/rooms/{room}/replay"), Some(token), &body);
        assert!(!answer.contains(&takes), "it does not say where recordings are kept: {answer}");
        (status, answer.replace(name, "NAME"))
    };
    let absent = play("demo-20260131T235959Z-7.mcap", "other", &other);
    assert!(absent.0 == 404 && absent.1.contains("no_such_recording"), "{absent:?}");
    broken("demo-20260131T235959Z.mcap");
    broken("a.mcap");
    for name in [file.as_str(), "demo-20260131T235959Z.mcap", "a.mcap"] {
        assert_eq!(play(name, "other", &other), absent, "{name}");
    }
    for (name, token) in [("demo-20260131T235959Z.mcap", &publish), ("a.mcap", &admin)] {
        let told = play(name, "demo", token);
        assert!(told.0 == 422 && told.1.contains("recording NAME: it is no MCAP file"), "{told:?}");
    }
    assert_eq!(played("/api/rooms/other/replay", Some(&admin)), ok);
    assert_eq!(played("/api/rooms/demo/replay", Some(&publish)), ok);
    for (token, expected) in [(None, &missing), (Some(&view), &role), (Some(&other), &room), (Some(&publish), &ok)] {
        let token = token.map(String::as_str);
        assert_eq!(code(ask(&server, "DELETE", "/api/rooms/demo/replay", token, "")), *expected, "{token:?}");
    }
    // A program records as a viewer, with a token as every other.
    let (out, to) = (folder.path("taken.mcap"), url(&server));
    let record = |token: &[&str]| program(&["record", &out, "--seconds", "0.3", "--server", &to]).args(token).output().unwrap();
    let refused = record(&[]);
    assert!(!refused.status.success() && String::from_utf8_lossy(&refused.stderr).contains("a token is needed"), "{refused:?}");
    let taken = record(&["--token", &view]);
    assert!(taken.status.success(), "{taken:?}");
}

#[test]
fn sockets_end_with_their_token() {
    let folder = Folder::with_key();
    let server = serve(&folder.key(), &[]);
    for (role, end) in [(Role::View, "view"), (Role::Publish, "publish")] {
        let token = folder.token(role, "demo", Duration::from_secs(2));
        let start = Instant::now();
        let mut socket = open(&server, &format!("demo/{end}"), &header(&token)).unwrap();
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
    let output = program(&["serve", "--listen", "0.0.0.0:0"]).output().unwrap();
    assert!(!output.status.success() && output.stdout.is_empty());
    assert!(String::from_utf8_lossy(&output.stderr).contains("--token-key"), "{output:?}");
    // Datagrams bear no tokens.
    let folder = Folder::with_key();
    let key = folder.key();
    let refused = |port: &str| Server::try_start(&[], &["serve", "--token-key", &key, "--listen-udp", port]).err();
    let said = refused("livelink=0.0.0.0:0").expect("forged addresses are to be expected");
    assert!(said.contains("allow=IP"), "{said}");
    assert_eq!(refused("livelink=0.0.0.0:0,allow=192.0.2.1"), None);
    assert_eq!(refused("livelink=127.0.0.1:0"), None);
    let server = Server::start(&["serve", "--listen", "0.0.0.0:0", "--insecure"]);
    assert!(open(&server, "demo/view", &[]).is_ok());
    assert_eq!(get(&server, "/metrics", None).0, 200);
}

#[test]
fn commands_make_keys_tokens_and_use_them() {
    let folder = Folder(tempfile::tempdir().unwrap());
    let (key, feed, token_file) = (folder.key(), folder.path("feed"), folder.path("token"));
    let run = |args: &[&str]| program(args).output().unwrap();
    assert!(run(&["token", "--new-key", &key]).status.success());
    assert!(!run(&["token", "--new-key", &key]).status.success(), "a key is never replaced");
    let made = run(&["token", "--key", &key, "--role", "publish", "--room", "demo", "--for", "1h"]);
    assert!(made.status.success(), "{made:?}");
    std::fs::write(&token_file, &made.stdout).unwrap();
    std::fs::write(&feed, "{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{}}\n").unwrap();
    let server = serve(&key, &[]);
    let to = url(&server);
    let sent = run(&["send", &feed, "--to", &to, "--token-file", &token_file]);
    assert!(sent.status.success(), "{sent:?}");
    let refused = run(&["send", &feed, "--to", &to]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("a token is needed"), "{refused:?}");
    let in_the_clear = run(&["send", &feed, "--to", "ws://192.0.2.1:9", "--token-file", &token_file]);
    assert!(String::from_utf8_lossy(&in_the_clear.stderr).contains("wss://"), "{in_the_clear:?}");
    for wrong in [&["token", "--key", &key, "--role", "view"][..], &["token", "--key", &key, "--role", "view", "--room", "a", "--for", "8"]]
    {
        assert!(!run(wrong).status.success(), "{wrong:?}");
    }
}
