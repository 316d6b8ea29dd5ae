//! A `nats-server` for each test.

use super::process::{Process, wait_for};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

/// Debian puts it where only root's path leads.
pub fn nats_server() -> Command {
    let path = Path::new("/usr/sbin/nats-server");
    Command::new(if path.is_file() { path } else { Path::new("nats-server") })
}

pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A NATS server with JetStream.
pub struct Nats {
    pub process: Process,
    pub port: u16,
    pub folder: Arc<tempfile::TempDir>,
    more: Vec<String>,
}

impl Nats {
    pub fn start() -> Self {
        Self::with(&[])
    }

    pub fn with(more: &[&str]) -> Self {
        let more = more.iter().map(|word| (*word).to_owned()).collect();
        Self::at(free_port(), Arc::new(tempfile::tempdir().unwrap()), more)
    }

    pub fn at(port: u16, folder: Arc<tempfile::TempDir>, more: Vec<String>) -> Self {
        let address = more.iter().skip_while(|word| *word != "-a").nth(1).map_or("127.0.0.1", String::as_str).to_owned();
        let mut command = nats_server();
        command.args(["-js", "-p", &port.to_string(), "-sd"]).arg(folder.path());
        command.args(if more.iter().any(|word| word == "-a") { &[][..] } else { &["-a", "127.0.0.1"] }).args(&more);
        let process = Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
        let nats = Self { process, port, folder, more };
        wait_for("NATS", || TcpStream::connect((address.as_str(), port)).ok());
        nats
    }

    pub fn kill(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }

    pub fn restart(&mut self) {
        *self = Self::at(self.port, self.folder.clone(), self.more.clone());
    }

    pub fn url(&self) -> String {
        format!("nats://127.0.0.1:{}", self.port)
    }
}
