//! The server under test: a process of its own on a core of its own, so that its time and memory are its own.

use super::LoadError;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};

/// Where the two sides run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cores {
    pub server: usize,
    pub generator: usize,
}

impl Cores {
    /// The last core for the server and the first for the generator (interrupts like the first); none where there is but one.
    pub fn choose() -> Option<Self> {
        let allowed = sched_getaffinity(None).ok()?;
        let mut cores = (0..CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core));
        let generator = cores.next()?;
        Some(Self { server: cores.next_back()?, generator })
    }
}

/// Keeps this thread, and what it starts from now on, on `core`.
fn pin(core: usize) -> Result<(), LoadError> {
    let mut set = CpuSet::new();
    set.set(core);
    sched_setaffinity(None, &set).map_err(|error| LoadError::System { what: "pin a process to a core", source: error.into() })
}

/// A server process; killed on drop.
pub(super) struct ServerProcess {
    child: Child,
    pub address: SocketAddr,
}

impl ServerProcess {
    /// Starts this program with `arguments` on the server's core, and waits for its address.
    pub fn start(arguments: &[String], cores: Option<Cores>) -> Result<Self, LoadError> {
        let system = |what: &'static str| move |source: std::io::Error| LoadError::System { what, source };
        let program = std::env::current_exe().map_err(system("find this program"))?;
        // What is started inherits the cores of the thread that starts it.
        if let Some(cores) = cores {
            pin(cores.server)?;
        }
        let log = std::env::var_os("RUST_LOG").unwrap_or_else(|| "warn".into());
        let spawned = Command::new(program).args(arguments).env("RUST_LOG", log).stdin(Stdio::null()).stdout(Stdio::piped()).spawn();
        if let Some(cores) = cores {
            pin(cores.generator)?;
        }
        let mut child = spawned.map_err(system("start a server"))?;
        let stdout = child.stdout.take().expect("it has been asked for");
        let mut server = Self { child, address: SocketAddr::from(([127, 0, 0, 1], 0)) };
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).map_err(system("read a server's address"))?;
        server.address = line
            .trim()
            .strip_prefix("listening on http://")
            .and_then(|address| address.parse().ok())
            .ok_or_else(|| LoadError::Server(format!("it said {:?} in place of its address", line.trim())))?;
        Ok(server)
    }

    /// What it has used by now.
    pub fn usage(&self) -> Result<Usage, LoadError> {
        Usage::of(&self.child.id().to_string())
            .map_err(|source| LoadError::System { what: "read a server's use of memory and time", source })
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What a process has used.
#[derive(Debug, Clone, Copy)]
pub(super) struct Usage {
    /// Seconds of a core, in the process and in the kernel for it.
    pub cpu_seconds: f64,
    /// Resident bytes.
    pub memory_bytes: u64,
}

impl Usage {
    /// Of process `id`, which may be `self`.
    pub fn of(id: &str) -> std::io::Result<Self> {
        let broken = || std::io::Error::other("/proc has another form than expected");
        let stat = std::fs::read_to_string(format!("/proc/{id}/stat"))?;
        // The name may hold blanks and brackets, so counting starts behind it: utime and stime are fields 14 and 15.
        let fields: Vec<&str> = stat.rsplit_once(')').ok_or_else(broken)?.1.split_whitespace().collect();
        let ticks = |at: usize| fields.get(at).and_then(|field| field.parse::<u64>().ok()).ok_or_else(broken);
        let cpu_seconds = (ticks(11)? + ticks(12)?) as f64 / rustix::param::clock_ticks_per_second() as f64;
        let status = std::fs::read_to_string(format!("/proc/{id}/status"))?;
        let kib = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB")?.parse::<u64>().ok());
        Ok(Self { cpu_seconds, memory_bytes: kib.ok_or_else(broken)? << 10 })
    }
}

/// Seconds for which `core` has been busy since the machine started.
pub(super) fn busy_seconds(core: usize) -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/stat").ok()?;
    let line = stat.lines().find_map(|line| line.strip_prefix(&format!("cpu{core} ")))?;
    let ticks: Vec<u64> = line.split_whitespace().map_while(|field| field.parse().ok()).collect();
    // user nice system idle iowait irq softirq steal; the guests' are in the user's.
    let busy: u64 = ticks.iter().take(8).sum::<u64>() - ticks.get(3)? - ticks.get(4)?;
    Some(busy as f64 / rustix::param::clock_ticks_per_second() as f64)
}
