//! Several `nats-server`s that are one cluster.

use super::http;
use super::nats::{Nats, free_port};
use serde_json::Value;
use std::sync::Arc;
use std::time::{Duration, Instant};

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
