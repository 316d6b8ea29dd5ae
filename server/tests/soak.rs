//! A server that people come to and leave, for as long as one likes: publishers that stay, are taken over, or fall silent without a
//! word; viewers that read, come and go, or stop reading. Its memory stays flat, nobody sees an older frame after a newer one, and
//! nothing panics.
//!
//! `cargo test --release -p rhytid-server --test soak -- --ignored --nocapture` runs for half an hour, or for as many seconds as
//! `RHYTID_SOAK_SECONDS` says.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]
// Memory is read as Linux tells it.
#![cfg(target_os = "linux")]

#[path = "process/memory.rs"]
mod memory;
mod process;
#[path = "process/socket.rs"]
mod socket;
#[path = "process/viewer.rs"]
mod viewer;

use process::Server;
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};
use viewer::{Sight, Viewer};

const ROOMS: u32 = 3;
const VIEWERS: u32 = 24;
const FPS: f64 = 60.0;
/// What the memory may grow by after the first minute of half an hour.
const MOST_GROWTH: f64 = 0.02;

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
struct Seen {
    frames: AtomicU64,
    joins: AtomicU64,
    sessions: AtomicU64,
    takeovers: AtomicU64,
    dropouts: AtomicU64,
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

fn open(address: &str, path: &str) -> tungstenite::Result<WebSocket<TcpStream>> {
    socket::open(address, path, &[], Duration::from_millis(200))
}

/// Publishes to a room, session after session. Each ends by a close, by silence, or by the next one's takeover.
fn publish(address: &str, room: u32, seed: u64, seen: &Seen, is_over: &AtomicBool) {
    let mut random = Random(seed);
    // What nobody reads or writes any more: the server's own time-outs end it.
    let mut silent: Vec<(Instant, WebSocket<TcpStream>)> = Vec::new();
    while !is_over.load(Ordering::Relaxed) {
        silent.retain(|(since, _)| since.elapsed() < Duration::from_secs(8));
        let Ok(mut socket) = open(address, &format!("soak-{room}/publish")) else { continue };
        let hello = r#"{"type":"hello","version":1,"source":"soak","fps":60,"takeover":true,"keep_neutral":true}"#;
        if socket.send(Message::text(hello)).is_err() {
            continue;
        }
        count(&seen.sessions);
        let frames = 30 + random.below(300);
        let start = Instant::now();
        for k in 0..frames {
            let t = k as f64 / FPS;
            let weight = 0.5 - 0.5 * (3.0 * t).cos();
            let frame = format!(r#"{{"type":"frame","t":{t:.4},"weights":{{"jawOpen":{weight:.3},"browInnerUp":{:.3}}}}}"#, 1.0 - weight);
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
                count(&seen.takeovers);
                silent.push((Instant::now(), socket));
            }
            // The connection is cut, with answers unread: a reset.
            _ => count(&seen.dropouts),
        }
    }
}

/// Watches rooms, one after the other, for a while each; some stop reading. Checks the order of what comes.
fn watch(address: &str, seed: u64, seen: &Seen, is_over: &AtomicBool) {
    let mut random = Random(seed);
    while !is_over.load(Ordering::Relaxed) {
        let room = random.below(u64::from(ROOMS));
        let Ok(mut viewer) = open(address, &format!("soak-{room}/view")).map(Viewer::new) else { continue };
        count(&seen.joins);
        let until = Instant::now() + Duration::from_millis(200 + random.below(6000));
        let stops_reading = random.below(8) == 0;
        let mut last = None;
        while Instant::now() < until && !is_over.load(Ordering::Relaxed) {
            match viewer.look() {
                Sight::Face(frame) => {
                    let now = (frame.session, frame.seq);
                    // A key that goes before its delta again is the frame that a delta is read with.
                    assert!(last.is_none_or(|last| last <= now), "{now:?} after {last:?}");
                    last = Some(now);
                    count(&seen.frames);
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

/// Runs for `time`; the memory at each tenth of it, bytes.
fn soak(time: Duration) -> Vec<u64> {
    let mut server = Server::start(
        &[
            &["serve", "--publisher-timeout", "3", "--viewer-timeout", "6", "--write-timeout", "6"][..],
            &["--ping-interval", "1", "--room-timeout", "2"],
        ]
        .concat(),
    );
    let (seen, is_over) = (Seen::default(), AtomicBool::new(false));
    let mut memory = Vec::new();
    std::thread::scope(|scope| {
        let (seen, is_over, address) = (&seen, &is_over, server.address.as_str());
        let mut peers: Vec<_> =
            (0..ROOMS).map(|room| scope.spawn(move || publish(address, room, u64::from(room), seen, is_over))).collect();
        peers.extend((0..VIEWERS).map(|k| scope.spawn(move || watch(address, 1000 + u64::from(k), seen, is_over))));
        let (start, mut is_broken) = (Instant::now(), false);
        while start.elapsed() < time && !is_broken {
            std::thread::sleep(time / 30);
            memory.push(memory::resident(&server.process));
            is_broken = peers.iter().any(std::thread::ScopedJoinHandle::is_finished);
            let of = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
            println!(
                "{:.0} s: {:.2} MiB, {} frames, {} joins, {} sessions, {} takeovers, {} drop-outs",
                start.elapsed().as_secs_f64(),
                *memory.last().unwrap() as f64 / f64::from(1 << 20),
                of(&seen.frames),
                of(&seen.joins),
                of(&seen.sessions),
                of(&seen.takeovers),
                of(&seen.dropouts)
            );
        }
        is_over.store(true, Ordering::Relaxed);
        // Whoever has seen something wrong has panicked; that is passed on by the scope.
        peers.into_iter().for_each(|peer| peer.join().expect("nobody saw anything wrong"));
    });
    server.kill();
    let said = server.log();
    assert!(!said.contains("panicked"), "{said}");
    assert!(seen.frames.into_inner() > 1000 && seen.joins.into_inner() > u64::from(VIEWERS));
    memory
}

#[test]
fn nobody_sees_an_older_frame_while_others_come_go_and_fall_silent() {
    soak(Duration::from_secs(12));
}

#[test]
#[ignore = "half an hour"]
fn memory_stays_flat_for_half_an_hour() {
    let seconds = std::env::var("RHYTID_SOAK_SECONDS").ok().map_or(1800, |text| text.parse().expect("a number of seconds"));
    let memory = soak(Duration::from_secs(seconds));
    // What is held at a moment goes up and down with who is there: the mean of the second tenth against that of the last.
    let tenth = memory.len() / 10;
    let mean = |part: &[u64]| part.iter().sum::<u64>() / part.len() as u64;
    let (early, late) = (mean(&memory[tenth..2 * tenth]), mean(&memory[memory.len() - tenth..]));
    println!("{early} bytes early, {late} bytes late");
    assert!(late as f64 <= early as f64 * (1.0 + MOST_GROWTH), "{early} bytes have become {late}");
}
