//! Signals to processes.

pub use rustix::process::Signal;
use rustix::process::{Pid, kill_process};
use std::process::Child;

/// Sends it to a process that has not ended.
pub fn signal(process: &Child, signal: Signal) {
    let pid = Pid::from_raw(process.id() as i32).expect("not 0");
    kill_process(pid, signal).expect("it still runs");
}
