//! `load`: how the service does with many viewers, rooms and troubles, and how a plain broadcast server does with the same.
//!
//! The server is a process of its own on a core of its own; everybody else is one thread on another. Each run has a fresh
//! server.

mod child;
mod frames;
mod generator;
mod plain;

use child::{Cores, ServerProcess, Usage, busy_seconds};
use generator::{Crowd, Generator, Seen};
pub use plain::serve_plain;
use serde::Serialize;
use std::time::{Duration, Instant};

/// A frame that comes later than this shows a face as it was, not as it is: about what people notice between sound and picture.
const USEFUL_WITHIN: Duration = Duration::from_millis(100);
/// After a server's start: what it has is what an idle one has.
const SETTLE: Duration = Duration::from_millis(300);
/// What a packet takes in the mean, bytes, where no run has shown it.
const PACKET_BYTES: usize = 85;
/// A real tracker's session: 68 landmarks a frame.
const SESSION: &str = include_str!("../../shared/assets/demo.ibug68.jsonl");

/// Why a load could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The system refused something.
    #[error("cannot {what}: {source}")]
    System {
        /// What it should have done.
        what: &'static str,
        /// What it said.
        source: std::io::Error,
    },
    /// The server under test does not do what it should.
    #[error("the server under test: {0}")]
    Server(String),
    /// The options make no sense.
    #[error("{0}")]
    Options(String),
}

/// What to measure.
#[derive(Debug, Clone)]
pub struct LoadOptions {
    /// Viewers altogether, spread over the rooms.
    pub viewers: usize,
    /// Rooms, each with a publisher.
    pub rooms: usize,
    /// Frames a second from each publisher.
    pub fps: f64,
    /// Seconds that are measured in each run.
    pub seconds: f64,
    /// Seconds of the same before the measuring: connections settle, sessions find their neutral faces.
    pub warm_up: f64,
    /// Share of the viewers, 0 to 1, that read nothing after the hello.
    pub stalled: f64,
    /// Share of the viewers, 0 to 1, that stay for half a second and connect again.
    pub reconnecting: f64,
    /// Measure the plain broadcast server too.
    pub baseline: bool,
    /// How often everything is measured, turn by turn.
    pub rounds: usize,
}

/// One run.
#[derive(Debug, Clone, Serialize)]
pub struct LoadReport {
    /// `rhytid`, or `plain`: the broadcast server.
    pub server: &'static str,
    /// Some of the viewers stall or reconnect.
    pub disturbed: bool,
    /// Viewers that are counted: those that neither stall nor reconnect.
    pub viewers: usize,
    /// Rooms, each with a publisher.
    pub rooms: usize,
    /// Frames a second that each publisher sent.
    pub fps: f64,
    /// Seconds that were measured.
    pub seconds: f64,
    /// From the publisher's write to the viewer's read, milliseconds.
    pub p50_ms: f64,
    /// As `p50_ms`.
    pub p99_ms: f64,
    /// As `p50_ms`.
    pub p999_ms: f64,
    /// As `p50_ms`.
    pub max_ms: f64,
    /// Frames that all viewers should have seen.
    pub frames_due: u64,
    /// Frames that they saw.
    pub frames_seen: u64,
    /// Frames that they saw within 100 ms.
    pub frames_useful: u64,
    /// Percent of the frames that never came.
    pub lost_percent: f64,
    /// Packets that came after a newer one.
    pub frames_backwards: u64,
    /// Frames that the publishers could not send as the server did not read.
    pub frames_held: u64,
    /// Viewers whose connection ended.
    pub viewers_lost: u64,
    /// Connections made anew.
    pub reconnects: u64,
    /// Bytes of a packet, in the mean.
    pub packet_bytes: f64,
    /// Percent of a core that the server took.
    pub cpu_percent: f64,
    /// Microseconds of the server a frame sent.
    pub cpu_micros_a_frame: f64,
    /// Percent of the server's core that other processes took: noise. None where the server has no core of its own.
    pub others_percent: Option<f64>,
    /// Percent of a core that the generator took; near 100 it measures itself.
    pub generator_percent: f64,
    /// Resident memory of the server before anybody came, bytes.
    pub memory_idle_bytes: u64,
    /// Resident memory of the server at the end, bytes.
    pub memory_bytes: u64,
}

impl LoadReport {
    /// What the server's memory has grown by, bytes.
    pub fn memory_growth_bytes(&self) -> u64 {
        self.memory_bytes.saturating_sub(self.memory_idle_bytes)
    }
}

/// What publishers send: lines of a session around their time, or made-up packets for the plain server.
struct Feed<'a> {
    hello: &'a str,
    /// Each line before and behind its time.
    lines: &'a [[&'a str; 2]],
    /// Seconds between two frames.
    interval: f64,
    packet_bytes: usize,
    /// By room, when the next frame is due, seconds.
    due: Vec<f64>,
}

/// Measures as `options` say; `each` is given every run's report when it is there.
///
/// # Errors
/// Where a server does not start, ends a session it should not end, or sends something that is no packet.
pub fn load(options: &LoadOptions, mut each: impl FnMut(&LoadReport)) -> Result<Vec<LoadReport>, LoadError> {
    check(options)?;
    let (hello, lines) = session()?;
    // Before this thread is kept on one of them.
    let cores = Cores::choose().filter(|cores| cores.server != cores.generator);
    let is_disturbed = options.stalled > 0.0 || options.reconnecting > 0.0;
    let mut packet_bytes = PACKET_BYTES;
    let mut reports = Vec::new();
    for _ in 0..options.rounds {
        for server in if options.baseline { &["rhytid", "plain"][..] } else { &["rhytid"] } {
            for disturbed in if is_disturbed { &[false, true][..] } else { &[false] } {
                let is_plain = *server == "plain";
                let feed = Feed {
                    hello: if is_plain { "" } else { hello },
                    lines: if is_plain { &[] } else { &lines },
                    interval: 1.0 / options.fps,
                    packet_bytes,
                    due: vec![0.0; options.rooms],
                };
                let report = run(options, cores, server, *disturbed, feed)?;
                if !is_plain {
                    packet_bytes = (report.packet_bytes.round() as usize).max(16);
                }
                each(&report);
                reports.push(report);
            }
        }
    }
    Ok(reports)
}

fn check(options: &LoadOptions) -> Result<(), LoadError> {
    let refuse = |problem: &str| Err(LoadError::Options(problem.to_owned()));
    // Loopback has 28,000 ports for them.
    if options.viewers == 0 || options.rooms == 0 || options.viewers + options.rooms > 16_000 {
        return refuse("viewers and rooms must be at least 1 each, and 16000 together at most");
    }
    if !(1.0..=1000.0).contains(&options.fps) || !(1.0..=3600.0).contains(&options.seconds) || options.rounds == 0 {
        return refuse("frames a second must be 1 to 1000, seconds 1 to 3600, rounds at least 1");
    }
    if !(0.0..=3600.0).contains(&options.warm_up) {
        return refuse("seconds of warm-up must be 0 to 3600");
    }
    let shares = [options.stalled, options.reconnecting];
    if shares.iter().any(|share| !(0.0..=1.0).contains(share)) || shares.iter().sum::<f64>() > 0.9 {
        return refuse("stalled and reconnecting viewers must be 90 % at most, so that somebody is left to measure");
    }
    Ok(())
}

/// The hello of the built-in session, and its frames cut around their times.
fn session() -> Result<(&'static str, Vec<[&'static str; 2]>), LoadError> {
    let mut lines = SESSION.lines();
    let broken = || LoadError::Options("the built-in session has another form than expected".to_owned());
    let hello = lines.next().ok_or_else(broken)?;
    let cut = |line: &'static str| {
        let (before, rest) = line.split_at(line.find("\"t\":")? + 4);
        Some([before, &rest[rest.find(',')?..]])
    };
    let frames: Option<Vec<_>> = lines.filter(|line| line.contains("\"landmarks\"")).map(cut).collect();
    Ok((hello, frames.filter(|frames| !frames.is_empty()).ok_or_else(broken)?))
}

fn run(
    options: &LoadOptions,
    cores: Option<Cores>,
    server: &'static str,
    disturbed: bool,
    feed: Feed<'_>,
) -> Result<LoadReport, LoadError> {
    let words: Vec<String> = match server {
        "plain" => vec!["plain-server".into()],
        _ => {
            let most = |flag: &str, count: usize| [flag.to_owned(), count.to_string()];
            // A tenth more for those that reconnect while their old connection is still being closed.
            let all = 2 * (options.viewers + options.rooms) + 64;
            ["serve", "--listen", "127.0.0.1:0"]
                .map(str::to_owned)
                .into_iter()
                .chain(most("--max-rooms", options.rooms))
                .chain(most("--max-viewers", all))
                .chain(most("--max-connections-in-all", all))
                .collect()
        }
    };
    let process = ServerProcess::start(&words, cores)?;
    std::thread::sleep(SETTLE);
    let idle = process.usage()?;
    let share = |share: f64| if disturbed { (share * options.viewers as f64).round() as usize } else { 0 };
    let crowd = Crowd {
        rooms: options.rooms,
        viewers: options.viewers,
        stalled: share(options.stalled),
        reconnecting: share(options.reconnecting),
    };
    let mut generator = Generator::connect(process.address, &crowd, feed)?;
    generator.run(options.fps, Duration::from_secs_f64(options.warm_up), false)?;

    let own_usage = || Usage::of("self").map_err(|source| LoadError::System { what: "read this process's use of time", source });
    let (before, own_before) = (process.usage()?, own_usage()?);
    let busy_before = cores.and_then(|cores| busy_seconds(cores.server));
    let start = Instant::now();
    let seen = generator.run(options.fps, Duration::from_secs_f64(options.seconds), true)?.expect("it was asked to count");
    let seconds = start.elapsed().as_secs_f64();
    let (after, own_after) = (process.usage()?, own_usage()?);
    let busy = cores.and_then(|cores| Some(busy_seconds(cores.server)? - busy_before?));

    let Seen { latencies, num_published, .. } = &seen;
    let viewers = crowd.viewers - crowd.stalled - crowd.reconnecting;
    let frames_seen = latencies.len();
    // In the mean of the rooms; with as many viewers in each it is exact.
    let frames_due = (*num_published as f64 / crowd.rooms as f64 * viewers as f64).round() as u64;
    let cpu = after.cpu_seconds - before.cpu_seconds;
    let millis = |quantile: f64| latencies.value_at_quantile(quantile) as f64 / 1e6;
    Ok(LoadReport {
        server,
        disturbed,
        viewers,
        rooms: crowd.rooms,
        fps: options.fps,
        seconds,
        p50_ms: millis(0.5),
        p99_ms: millis(0.99),
        p999_ms: millis(0.999),
        max_ms: latencies.max() as f64 / 1e6,
        frames_due,
        frames_seen,
        frames_useful: seen.num_useful,
        // What is on its way at either end of the measuring may make it a little less than nothing.
        lost_percent: (100.0 * (1.0 - frames_seen as f64 / frames_due.max(1) as f64)).max(0.0),
        frames_backwards: seen.num_backwards,
        frames_held: seen.num_held,
        viewers_lost: seen.num_lost,
        reconnects: seen.num_reconnects,
        packet_bytes: seen.num_bytes as f64 / frames_seen.max(1) as f64,
        cpu_percent: 100.0 * cpu / seconds,
        cpu_micros_a_frame: 1e6 * cpu / frames_seen.max(1) as f64,
        others_percent: busy.map(|busy| (100.0 * (busy - cpu) / seconds).max(0.0)),
        generator_percent: 100.0 * (own_after.cpu_seconds - own_before.cpu_seconds) / seconds,
        memory_idle_bytes: idle.memory_bytes,
        memory_bytes: after.memory_bytes,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_session_is_cut_around_its_times() {
        let (hello, frames) = session().unwrap();
        assert!(hello.contains("\"hello\"") && frames.len() > 400);
        for [before, after] in &frames {
            let line: serde_json::Value = serde_json::from_str(&format!("{before}1.5{after}")).unwrap();
            assert_eq!(line["t"], 1.5);
            assert_eq!(line["landmarks"].as_array().unwrap().len(), 68);
        }
    }

    #[test]
    fn impossible_loads_are_refused() {
        let sound = LoadOptions {
            viewers: 1,
            rooms: 1,
            fps: 60.0,
            seconds: 1.0,
            warm_up: 0.0,
            stalled: 0.0,
            reconnecting: 0.0,
            baseline: false,
            rounds: 1,
        };
        check(&sound).unwrap();
        for wrong in [
            LoadOptions { viewers: 0, ..sound.clone() },
            LoadOptions { viewers: 20_000, ..sound.clone() },
            LoadOptions { fps: f64::NAN, ..sound.clone() },
            LoadOptions { stalled: 0.5, reconnecting: 0.5, ..sound.clone() },
            LoadOptions { warm_up: -1.0, ..sound.clone() },
            LoadOptions { rounds: 0, ..sound.clone() },
        ] {
            assert!(matches!(check(&wrong), Err(LoadError::Options(_))), "{wrong:?}");
        }
    }
}
