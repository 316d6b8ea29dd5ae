//! Viewers that watch a room for as long as it lives.

use super::process::wait_for;
use super::socket;
use super::viewer::{Sight, Viewer};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A packet as a viewer saw it.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    pub at: Instant,
    pub session: u32,
    seq: u32,
    t: u64,
    /// Counts the viewer's connections.
    connection: u32,
}

/// Watches a room for as long as it lives, at one of several nodes after the other.
pub struct Watch {
    seen: Arc<Mutex<Vec<Seen>>>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    pub fn start(nodes: &[&str], room: &str) -> Self {
        let nodes: Vec<String> = nodes.iter().map(|node| (*node).to_owned()).collect();
        let (seen, is_over, room) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)), room.to_owned());
        let thread = std::thread::spawn({
            let (seen, is_over) = (seen.clone(), is_over.clone());
            move || {
                for (connection, node) in (0..).zip(nodes.iter().cycle()) {
                    if is_over.load(Ordering::Relaxed) {
                        return;
                    }
                    if Self::watch(node, &room, connection, &seen, &is_over).is_none() {
                        std::thread::sleep(Duration::from_millis(20));
                    }
                }
            }
        });
        Self { seen, is_over, thread: Some(thread) }
    }

    /// One connection. Everything that comes can be read.
    fn watch(node: &str, room: &str, connection: u32, seen: &Mutex<Vec<Seen>>, is_over: &AtomicBool) -> Option<()> {
        let socket = socket::open(node, &format!("{room}/view"), &[], Duration::from_secs(1)).ok()?;
        socket.get_ref().set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let mut viewer = Viewer::new(socket);
        while !is_over.load(Ordering::Relaxed) {
            match viewer.look() {
                Sight::Face(frame) => {
                    let (session, seq, t) = (frame.session, frame.seq, frame.captured_at_micros);
                    seen.lock().unwrap().push(Seen { at: Instant::now(), session, seq, t, connection });
                }
                Sight::Nothing => {}
                Sight::Refused(error) => panic!("{error}"),
                Sight::Gone => return Some(()),
            }
        }
        Some(())
    }

    pub fn last(&self) -> Option<Seen> {
        self.seen.lock().unwrap().last().copied()
    }

    /// Waits for a packet that is sent after now.
    pub fn wait_for_more(&self, what: &str) -> Seen {
        let now = Instant::now();
        wait_for(what, || self.last().filter(|seen| seen.at > now))
    }

    /// What it has seen in each connection goes on from what it had seen in that.
    pub fn assert_onward(&self) {
        for pair in self.seen.lock().unwrap().windows(2) {
            let [before, after] = pair else { unreachable!() };
            let is_next = (after.session, after.seq) >= (before.session, before.seq);
            assert!(is_next || after.connection > before.connection, "{before:?} before {after:?}");
        }
    }

    /// Ends it. Nothing was seen that goes backwards: of sessions, of sequence numbers and times within one. The newest state
    /// may come once more, when the viewer is at another node.
    pub fn finish(mut self) -> Vec<Seen> {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        let mut seen = std::mem::take(&mut *self.seen.lock().unwrap());
        // A new connection begins with the key packet that the newest one needs.
        let mut connection = 0;
        let mut newest = (0, 0);
        seen.retain(|seen| {
            let is_first = std::mem::replace(&mut connection, seen.connection) != seen.connection;
            let is_old = is_first && (seen.session, seen.seq) < newest;
            newest = newest.max((seen.session, seen.seq));
            !is_old
        });
        for pair in seen.windows(2) {
            let [before, after] = pair else { unreachable!() };
            let is_next = (after.session, after.seq) >= (before.session, before.seq);
            assert!(is_next && (after.session > before.session || after.t >= before.t), "{before:?} before {after:?}");
        }
        seen
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

/// The longest pause between packets.
pub fn pause(seen: &[Seen]) -> Duration {
    seen.windows(2).map(|pair| pair[1].at - pair[0].at).max().unwrap_or_default()
}

/// How many packets were seen more than once.
pub fn num_twice(seen: &[Seen]) -> usize {
    seen.windows(2).filter(|pair| (pair[0].session, pair[0].seq) == (pair[1].session, pair[1].seq)).count()
}
