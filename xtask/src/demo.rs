//! The main job, shown: a server, a tracker session published over a real WebSocket, and the face it gives.

use crate::{setup, web, workspace_root};
use anyhow::{Context, Result, ensure};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How long a child may take to end after it was asked to: a film has its contact sheet to draw.
const GRACE: Duration = Duration::from_secs(30);
/// How long a viewer may take to open its adapter and to join the room; the session starts without it then.
const VIEWER_TIMEOUT: Duration = Duration::from_secs(60);
/// How long the server may take to load the character and listen.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Where OpenSeeFace sends by itself; whatever tracker sends there drives the demo's room.
const TRACKERS: &str = "127.0.0.1:11573";

/// Sets up, builds, serves, publishes and shows. Returns when the window is closed, the film is finished or Ctrl-C is pressed.
pub fn run() -> Result<()> {
    let is_stopped = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&is_stopped);
    // SIGTERM and SIGHUP, too: whoever ends the demo ends its children.
    ctrlc::set_handler(move || flag.store(true, Ordering::SeqCst)).context("cannot listen for signals")?;

    setup::run()?;
    web::run_where_possible();
    println!("demo: building (the first time takes some minutes)");
    let root = workspace_root();
    let status = Command::new(env!("CARGO"))
        .current_dir(&root)
        .args(["build", "--release", "-p", "rhytid-server", "-p", "rhytid-client"])
        .status()
        .context("cannot run cargo")?;
    if is_stopped.load(Ordering::SeqCst) {
        return Ok(());
    }
    ensure!(status.success(), "the build failed ({status})");

    let bin = target_dir(&root).join("release");
    let mut serve = Command::new(bin.join("rhytid-server"));
    serve.args(["serve", "--listen", "127.0.0.1:0"]).stdout(Stdio::piped());
    // Another server on this machine may have the port.
    let takes_trackers = UdpSocket::bind(TRACKERS).is_ok();
    if takes_trackers {
        serve.args(["--listen-udp", &format!("any={TRACKERS},room=demo")]);
    }
    let mut server = Running::start("rhytid-server", &mut serve)?;
    let url = server.listening_url()?.replacen("http://", "ws://", 1);
    println!("demo: serving at {url}, room demo; in a browser: {}/?room=demo", url.replacen("ws://", "http://", 1));
    if takes_trackers {
        println!(
            "demo: trackers' datagrams drive the face, too, at {TRACKERS} (to try: target/release/rhytid-server fake shared/assets/demo.ibug68.jsonl --as openseeface --to {TRACKERS} --loop)"
        );
    }

    let feed = root.join("shared/assets/demo.ibug68.jsonl");
    // Whoever publishes from a browser or a tracker has the face while they do.
    let mut sender = Command::new(bin.join("rhytid-server"));
    sender.arg("send").arg(&feed).args(["--to", &url, "--room", "demo", "--slot", "session", "--priority", "10"]);
    let mut viewer = Command::new(bin.join("rhytid-client"));
    let has_display = setup::has_display();
    if has_display {
        sender.args(["--loop"]).stderr(Stdio::null());
        viewer.args(["view", &url, "--room", "demo"]);
        println!("demo: opening a window; close it or press Ctrl-C to end");
    } else {
        let out = root.join("target/demo");
        println!("demo: no display here, so the session is filmed as it plays, into {}", out.display());
        viewer.args(["film", &url, "--room", "demo", "--seconds", "20", "--out"]).arg(out);
    }
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // Without it the software Vulkan driver prints two lines that look like errors and are none.
        viewer.env("XDG_RUNTIME_DIR", std::env::temp_dir());
    }
    // The viewer first, so that it sees the session from its first frame.
    let mut viewer = Running::start("rhytid-client", &mut viewer)?;
    let deadline = Instant::now() + VIEWER_TIMEOUT;
    while !is_stopped.load(Ordering::SeqCst) && viewer.child.try_wait()?.is_none() && Instant::now() < deadline && !is_watched(&url) {
        std::thread::sleep(Duration::from_millis(100));
    }
    let mut sender = Running::start("rhytid-server send", &mut sender)?;

    let outcome = loop {
        if is_stopped.load(Ordering::SeqCst) {
            break Ok(());
        }
        if let Some(status) = viewer.child.try_wait()? {
            break if status.success() { Ok(()) } else { Err(anyhow::anyhow!("the viewer ended with {status}")) };
        }
        if let Some(status) = server.child.try_wait()? {
            break Err(anyhow::anyhow!("the server ended with {status}"));
        }
        if let Some(status) = sender.child.try_wait()?
            && !status.success()
        {
            break Err(anyhow::anyhow!("the sender ended with {status}"));
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    for running in [&mut sender, &mut viewer, &mut server] {
        running.stop()?;
    }
    outcome
}

/// True once somebody watches the room, by the server's own list of rooms.
fn is_watched(url: &str) -> bool {
    let Some(address) = url.strip_prefix("ws://") else { return false };
    let rooms = || -> std::io::Result<String> {
        let mut socket = TcpStream::connect(address)?;
        socket.set_read_timeout(Some(Duration::from_secs(2)))?;
        write!(socket, "GET /api/rooms HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        socket.read_to_string(&mut answer)?;
        Ok(answer)
    };
    let Ok(answer) = rooms() else { return false };
    let Some((_, body)) = answer.split_once("\r\n\r\n") else { return false };
    let Ok(rooms) = serde_json::from_str::<serde_json::Value>(body) else { return false };
    rooms["rooms"].as_array().is_some_and(|rooms| rooms.iter().any(|room| room["viewers"].as_u64() > Some(0)))
}

/// Where Cargo puts what it builds.
pub fn target_dir(root: &Path) -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), PathBuf::from)
}

/// A child that does not outlive the demo.
struct Running {
    name: &'static str,
    child: Child,
}

impl Running {
    fn start(name: &'static str, command: &mut Command) -> Result<Self> {
        let child = command.stdin(Stdio::null()).spawn().with_context(|| format!("cannot start {name}"))?;
        Ok(Self { name, child })
    }

    /// The address in the server's first line.
    fn listening_url(&mut self) -> Result<String> {
        let output = self.child.stdout.take().context("the server's output is not piped")?;
        let (sender, receiver) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let mut lines = BufReader::new(output).lines();
            let first = lines.next();
            // Nobody waits any more if this fails.
            let _ = sender.send(first);
            // The rest is read so that the server never blocks on a full pipe.
            lines.map_while(Result::ok).for_each(drop);
        });
        let line = receiver.recv_timeout(START_TIMEOUT).context("the server did not say where it listens")?;
        let line = line.context("the server ended before it listened")??;
        line.strip_prefix("listening on ").map(str::to_owned).with_context(|| format!("the server's first line was {line:?}"))
    }

    /// Asks the child to end, and ends it if it does not.
    fn stop(&mut self) -> Result<()> {
        if self.child.try_wait()?.is_some() {
            return Ok(());
        }
        #[cfg(unix)]
        {
            let pid = nix::unistd::Pid::from_raw(self.child.id().try_into().context("process ids fit an i32")?);
            nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGTERM).ok();
            let deadline = Instant::now() + GRACE;
            while Instant::now() < deadline {
                if self.child.try_wait()?.is_some() {
                    return Ok(());
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            println!("demo: {} did not end by itself", self.name);
        }
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // Only after an error on the way: the ordinary end has stopped it.
        if matches!(self.child.try_wait(), Ok(None)) {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}
