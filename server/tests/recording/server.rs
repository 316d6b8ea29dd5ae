//! Servers that record, and what they leave.

use crate::fixture::demo;
use crate::http::ask;
use crate::process::{Process, Server, program, wait_for};
use crate::signal::{Signal, signal};
use serde_json::Value;
use std::ops::Deref;
use std::path::PathBuf;
use std::process::{Output, Stdio};
use tempfile::TempDir;

/// A folder that goes with the test.
pub struct Folder(TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn shown(&self) -> &str {
        self.0.path().to_str().unwrap()
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// All that is in it, by name.
    pub fn files(&self) -> Vec<PathBuf> {
        let mut files: Vec<PathBuf> = std::fs::read_dir(self.0.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        files
    }

    /// Its only recording.
    pub fn recording(&self) -> PathBuf {
        let mut files = self.files();
        files.retain(|path| path.extension().is_some_and(|extension| extension == "mcap"));
        assert_eq!(files.len(), 1, "{files:?}");
        files.remove(0)
    }
}

/// A server that can be asked about its recordings.
pub struct Recorder(Server);

impl Recorder {
    pub fn start(args: &[&str]) -> Self {
        Self(Server::start(args))
    }

    /// As [`Server::try_start`].
    pub fn try_start(runner: &[&str], args: &[&str]) -> Result<Self, String> {
        Server::try_start(runner, args).map(Self)
    }

    pub fn into(folder: &Folder) -> Self {
        Self::start(&["serve", "--record", folder.shown()])
    }

    pub fn url(&self) -> String {
        format!("ws://{}", self.address)
    }

    pub fn request(&self, method: &str, path: &str, body: &str) -> (u16, String) {
        ask(&self.address, method, path, &[], body).unwrap()
    }

    pub fn json(&self, method: &str, path: &str, body: &str) -> Value {
        let (status, text) = self.request(method, path, body);
        assert_eq!(status, 200, "{method} {path}: {text}");
        serde_json::from_str(&text).unwrap()
    }

    pub fn metric(&self, name: &str) -> f64 {
        let text = self.request("GET", "/metrics", "").1;
        let line = text.lines().find(|line| line.starts_with(&format!("{name} "))).unwrap_or_else(|| panic!("{name} in {text}"));
        line.rsplit(' ').next().unwrap().parse().unwrap()
    }

    pub fn send(&self, args: &[&str]) -> Output {
        program(&["send", demo().to_str().unwrap(), "--to", &self.url()]).args(args).output().unwrap()
    }

    /// Publishes the demo again and again until it is dropped.
    pub fn keep_sending(&self, speed: &str) -> Process {
        let mut command = program(&["send", demo().to_str().unwrap(), "--loop", "--speed", speed, "--to", &self.url()]);
        Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()))
    }

    /// Ends it in order.
    pub fn end(mut self) {
        signal(&self.0.process, Signal::TERM);
        assert!(self.0.process.wait().unwrap().success());
    }
}

impl Deref for Recorder {
    type Target = Server;

    fn deref(&self) -> &Server {
        &self.0
    }
}

pub fn run(args: &[&str]) -> Output {
    program(args).output().unwrap()
}

pub fn says(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    wait_for(what, || is_so().then_some(()));
}
