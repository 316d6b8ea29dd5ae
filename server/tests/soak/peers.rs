//! Who comes to the servers of a soak, and leaves.

use super::socket;
use super::viewer::{Sight, Viewer};
use std::fmt::{Display, Formatter};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

const ROOMS: u64 = 3;
pub const VIEWERS: u32 = 24;
const FPS: f64 = 60.0;

/// The same numbers in every run: splitmix64.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % end
    }
}

/// What happened, over all peers.
#[derive(Default)]
struct Counters {
    frames: AtomicU64,
    joins: AtomicU64,
    sessions: AtomicU64,
    takeovers: AtomicU64,
    dropouts: AtomicU64,
}

/// How often it happened.
#[derive(Debug)]
pub struct Seen {
    pub frames: u64,
    pub joins: u64,
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// All of them, each in a thread of its own.
pub struct Peers {
    threads: Vec<JoinHandle<()>>,
    everybody: Arc<Everybody>,
}

/// What they share.
struct Everybody {
    /// Of the servers, each of which is as good as another.
    addresses: Vec<String>,
    counters: Counters,
    is_over: AtomicBool,
}

impl Peers {
    /// Sends them to the servers at `addresses`.
    pub fn start(addresses: Vec<String>) -> Self {
        let everybody = Arc::new(Everybody { addresses, counters: Counters::default(), is_over: AtomicBool::new(false) });
        let spawn = |act: fn(&Everybody, u64), k: u64| {
            let everybody = everybody.clone();
            std::thread::spawn(move || act(&everybody, k))
        };
        let publishers = (0..ROOMS).map(|room| spawn(Everybody::publish, room));
        let threads = publishers.chain((0..u64::from(VIEWERS)).map(|k| spawn(Everybody::watch, 1000 + k))).collect();
        Self { threads, everybody }
    }

    /// One of them has seen something wrong.
    pub fn are_broken(&self) -> bool {
        self.threads.iter().any(JoinHandle::is_finished)
    }

    /// Sends them away.
    pub fn finish(self) -> Seen {
        self.everybody.is_over.store(true, Ordering::Relaxed);
        self.threads.into_iter().for_each(|peer| peer.join().expect("nobody saw anything wrong"));
        let counters = &self.everybody.counters;
        Seen { frames: counters.frames.load(Ordering::Relaxed), joins: counters.joins.load(Ordering::Relaxed) }
    }
}

impl Display for Peers {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        let Counters { frames, joins, sessions, takeovers, dropouts } = &self.everybody.counters;
        let of = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        write!(
            formatter,
            "{} frames, {} joins, {} sessions, {} takeovers, {} drop-outs",
            of(frames),
            of(joins),
            of(sessions),
            of(takeovers),
            of(dropouts)
        )
    }
}

impl Everybody {
    fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    fn open(&self, random: &mut Random, path: &str) -> tungstenite::Result<WebSocket<TcpStream>> {
        let address = &self.addresses[random.below(self.addresses.len() as u64) as usize];
        socket::open(address, path, &[], Duration::from_millis(200))
    }

    /// Publishes to a room, session after session. Each ends by a close, by silence, or by the next one's takeover.
    fn publish(&self, room: u64) {
        let mut random = Random(room);
        // What nobody reads or writes any more: the server's own time-outs end it.
        let mut silent: Vec<(Instant, WebSocket<TcpStream>)> = Vec::new();
        while !self.is_over() {
            silent.retain(|(since, _)| since.elapsed() < Duration::from_secs(8));
            let Ok(mut socket) = self.open(&mut random, &format!("soak-{room}/publish")) else { continue };
            let hello = r#"{"type":"hello","version":1,"source":"soak","fps":60,"takeover":true,"keep_neutral":true}"#;
            if socket.send(Message::text(hello)).is_err() {
                continue;
            }
            count(&self.counters.sessions);
            let frames = 30 + random.below(300);
            let start = Instant::now();
            for k in 0..frames {
                let t = k as f64 / FPS;
                let weight = 0.5 - 0.5 * (3.0 * t).cos();
                let frame =
                    format!(r#"{{"type":"frame","t":{t:.4},"weights":{{"jawOpen":{weight:.3},"browInnerUp":{:.3}}}}}"#, 1.0 - weight);
                if socket.send(Message::text(frame)).is_err() {
                    break;
                }
                std::thread::sleep((start + Duration::from_secs_f64(t)).saturating_duration_since(Instant::now()));
            }
            match random.below(3) {
                0 => {
                    let _ = socket.close(None);
                    let _ = socket.flush();
                }
                1 => {
                    count(&self.counters.takeovers);
                    silent.push((Instant::now(), socket));
                }
                // The connection is cut, with answers unread: a reset.
                _ => count(&self.counters.dropouts),
            }
        }
    }

    /// Watches rooms, one after the other, for a while each; some stop reading. Checks the order of what comes.
    fn watch(&self, seed: u64) {
        let mut random = Random(seed);
        while !self.is_over() {
            let room = random.below(ROOMS);
            let Ok(mut viewer) = self.open(&mut random, &format!("soak-{room}/view")).map(Viewer::new) else { continue };
            count(&self.counters.joins);
            let until = Instant::now() + Duration::from_millis(200 + random.below(6000));
            let stops_reading = random.below(8) == 0;
            let mut last = None;
            while Instant::now() < until && !self.is_over() {
                match viewer.look() {
                    Sight::Face(frame) => {
                        let now = (frame.session, frame.seq);
                        // A key that goes before its delta again is the frame that a delta is read with.
                        assert!(last.is_none_or(|last| last <= now), "{now:?} after {last:?}");
                        last = Some(now);
                        count(&self.counters.frames);
                    }
                    Sight::Nothing => {}
                    Sight::Refused(error) => {
                        println!("a viewer is sent away: {error}");
                        break;
                    }
                    Sight::Gone => break,
                }
                if stops_reading && last.is_some() {
                    std::thread::sleep(until.saturating_duration_since(Instant::now()));
                }
            }
            // Half of them leave without a word.
            if random.below(2) == 0 {
                let _ = viewer.socket.close(None);
                let _ = viewer.socket.flush();
            }
        }
    }
}
