//! What a process takes of the machine, as Linux tells it.

use std::process::Child;

/// Resident memory, bytes.
pub fn resident(process: &Child) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", process.id())).expect("it still runs");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    line.and_then(|kib| kib.parse::<u64>().ok()).expect("a number of KiB") << 10
}
