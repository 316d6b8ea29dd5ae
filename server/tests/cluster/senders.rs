//! The program as users start it, as a publisher.

use super::nodes::HELLO;
use super::process::{Process, program};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;

/// Writes a feed of weights at 60 Hz: a neutral that is asked for, then a mouth that never rests.
pub fn write_feed(folder: &Path, seconds: u32) -> PathBuf {
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
pub fn send(feed: &Path, nodes: &[&str], room: &str, log: &Path) -> Process {
    let to: Vec<String> = nodes.iter().map(|node| format!("ws://{node}")).collect();
    let (feed, log) = (feed.to_str().unwrap(), std::fs::File::create(log).unwrap());
    Process::start(program(&["send", feed, "--to", &to.join(","), "--room", room]).stdout(Stdio::null()).stderr(log))
}

/// A phone's app that sends datagrams to a port of this machine.
pub fn fake(feed: &Path, port: u16) -> Process {
    let (feed, to) = (feed.to_str().unwrap(), format!("127.0.0.1:{port}"));
    Process::start(program(&["fake", feed, "--as", "livelink", "--to", &to]).stderr(Stdio::null()))
}
