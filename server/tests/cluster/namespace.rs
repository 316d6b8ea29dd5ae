//! Networks beside the one of this machine, to be cut off from it.

use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// A network of its own with two cables to this one.
pub struct Namespace {
    pub name: String,
    pub cables: [(String, String, String); 2],
}

pub fn ip(words: &str) -> bool {
    let status = Command::new("ip").args(words.split(' ')).stdout(Stdio::null()).stderr(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}

impl Namespace {
    /// This machine lets it be made.
    pub fn is_possible() -> bool {
        Self::make().is_some()
    }

    pub fn make() -> Option<Self> {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = (std::process::id() + 7 * NEXT.fetch_add(1, Ordering::Relaxed)) % 250;
        let name = format!("rhytid{number}");
        // Addresses for tests of networks: RFC 2544.
        let cable =
            |k: u32| (format!("rhy{number}-{k}"), format!("198.18.{number}.{}", 1 + 4 * k), format!("198.18.{number}.{}", 2 + 4 * k));
        let namespace = Self { name, cables: [cable(0), cable(1)] };
        let is_made = ip(&format!("netns add {}", namespace.name))
            && namespace.cables.iter().all(|(cable, here, there)| {
                let name = &namespace.name;
                ip(&format!("link add {cable} type veth peer name {cable}p netns {name}"))
                    && ip(&format!("addr add {here}/30 dev {cable}"))
                    && ip(&format!("link set {cable} up"))
                    && ip(&format!("-n {name} addr add {there}/30 dev {cable}p"))
                    && ip(&format!("-n {name} link set {cable}p up"))
            })
            && ip(&format!("-n {} link set lo up", namespace.name));
        is_made.then_some(namespace)
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        for (cable, ..) in &self.cables {
            ip(&format!("link del {cable}"));
        }
        ip(&format!("netns del {}", self.name));
    }
}
