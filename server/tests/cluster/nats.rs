//! A `nats-server` for each test.

use super::http;
use super::process::{Process, wait_for};
use serde_json::Value;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

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

    fn at(port: u16, folder: Arc<tempfile::TempDir>, more: Vec<String>) -> Self {
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

/// NATS servers that are one cluster.
pub struct NatsCluster {
    pub servers: Vec<Nats>,
    monitors: Vec<u16>,
    more: Vec<Vec<String>>,
}

impl NatsCluster {
    /// Starts `num` of `of` servers, which all know of each other.
    pub fn start(num: usize, of: usize) -> Self {
        let ports = |_| (0..of).map(|_| free_port()).collect::<Vec<_>>();
        let [routes, monitors] = [(), ()].map(ports);
        let all = routes.iter().map(|port| format!("nats://127.0.0.1:{port}")).collect::<Vec<_>>();
        let more = all.iter().zip(&monitors).enumerate().map(|(k, (own, monitor))| {
            let (name, monitor, routes) = (server_name(k), monitor.to_string(), all.join(","));
            let words = ["--server_name", &name, "--cluster_name", "test", "-cluster", own, "-routes", &routes, "-m", &monitor];
            words.map(str::to_owned).to_vec()
        });
        let more = more.collect();
        let mut cluster = Self { servers: Vec::new(), monitors, more };
        (0..num).for_each(|_| cluster.start_another());
        wait_long("a leader of JetStream", || cluster.leader());
        cluster
    }

    pub fn start_another(&mut self) {
        let more = self.more[self.servers.len()].clone();
        self.servers.push(Nats::at(free_port(), Arc::new(tempfile::tempdir().unwrap()), more));
    }

    /// All addresses, of which a client takes any.
    pub fn url(&self) -> String {
        self.servers.iter().map(Nats::url).collect::<Vec<_>>().join(",")
    }

    /// Which server leads JetStream, where all that answer are of one mind.
    pub fn leader(&self) -> Option<usize> {
        let said = self.monitors.iter().filter_map(|port| {
            let (_, body) = http::ask(&format!("127.0.0.1:{port}"), "GET", "/jsz", &[], "").ok()?;
            serde_json::from_str::<Value>(&body).ok()
        });
        let leaders: Vec<_> = said.map(|jsz| jsz["meta_cluster"]["leader"].as_str().unwrap_or_default().to_owned()).collect();
        let leader = leaders.first().filter(|leader| leaders.iter().all(|other| other == *leader))?;
        (0..self.servers.len()).find(|k| server_name(*k) == *leader)
    }
}

/// What the server of a [`NatsCluster`] is called.
pub fn server_name(k: usize) -> String {
    format!("server-{k}")
}

/// As [`wait_for`], for servers that choose who leads them: they wait for nine seconds first, and may have to choose again.
pub fn wait_long<T>(what: &str, mut find: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = find() {
            return found;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "{what} does not come");
        std::thread::sleep(Duration::from_millis(50));
    }
}
