//! `load`: its options, and its results as people read them.

use crate::raise_file_limit;
use clap::Args;
use rhytid_server::load::{LoadOptions, LoadReport, load as measure, serve_plain};
use std::io::Write;

/// How many times as many viewers `--overload` has: more than one core serves one by one.
const OVERLOAD: usize = 6;

#[derive(Args)]
pub(crate) struct LoadArgs {
    /// Viewers altogether, spread over the rooms.
    #[arg(long, default_value_t = 1000, value_name = "N")]
    viewers: usize,
    /// Rooms, each with a publisher.
    #[arg(long, default_value_t = 1, value_name = "N")]
    rooms: usize,
    /// Frames a second from each publisher.
    #[arg(long, default_value_t = 60.0, value_name = "N")]
    fps: f64,
    /// Seconds that are measured, of each run.
    #[arg(long, default_value_t = 10.0, value_name = "N")]
    seconds: f64,
    /// Seconds of the same before the measuring: connections settle, sessions find their neutral faces.
    #[arg(long, default_value_t = 2.0, value_name = "N")]
    warm_up: f64,
    /// So many of the viewers read nothing any more, e.g. 5%; also measured without.
    #[arg(long, default_value = "0%", value_parser = parse_share, value_name = "PERCENT")]
    stalled: f64,
    /// So many of the viewers stay for half a second and connect again, e.g. 5%; also measured without.
    #[arg(long, default_value = "0%", value_parser = parse_share, value_name = "PERCENT")]
    reconnecting: f64,
    /// Six times as many viewers, more than a core can serve: useful are frames that come within 100 ms.
    #[arg(long)]
    overload: bool,
    /// Also measure a plain broadcast server (axum and a tokio broadcast channel, which solves nothing), turn by turn.
    #[arg(long)]
    baseline: bool,
    /// How often everything is measured; what is printed last are the medians.
    #[arg(long, default_value_t = 1, value_name = "N")]
    rounds: usize,
    /// Print JSON, one object a run.
    #[arg(long)]
    json: bool,
}

fn parse_share(text: &str) -> Result<f64, String> {
    let percent = text.strip_suffix('%').unwrap_or(text).trim().parse().ok().filter(|percent| (0.0..=90.0).contains(percent));
    percent.map(|percent: f64| percent / 100.0).ok_or_else(|| "expected a percentage from 0% to 90%".into())
}

/// Measures and prints.
pub(crate) async fn load(args: LoadArgs) -> anyhow::Result<()> {
    raise_file_limit();
    let options = LoadOptions {
        viewers: args.viewers * if args.overload { OVERLOAD } else { 1 },
        rooms: args.rooms,
        fps: args.fps,
        seconds: args.seconds,
        warm_up: args.warm_up,
        stalled: args.stalled,
        reconnecting: args.reconnecting,
        baseline: args.baseline,
        rounds: args.rounds,
    };
    let json = args.json;
    // A thread of its own: it is kept on one core, and never waits for the runtime.
    let reports = tokio::task::spawn_blocking(move || {
        measure(&options, |report| {
            let line = if json { serde_json::to_string(report).expect("plain data can be written") } else { shown(report) };
            // Who closed it does not want to know.
            let _ = writeln!(std::io::stdout(), "{line}");
        })
    })
    .await??;
    if !json {
        print!("{}", ratios(&reports));
    }
    Ok(())
}

/// Serves the plain broadcast server on a free port of loopback.
pub(crate) async fn plain_server() -> anyhow::Result<()> {
    raise_file_limit();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await?;
    println!("listening on http://{}", listener.local_addr()?);
    Ok(serve_plain(listener).await?)
}

fn shown(report: &LoadReport) -> String {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let mut text = format!(
        "{}{}: {} viewers, {} room{}, {} frames/s for {:.0} s\n",
        report.server,
        if report.disturbed { ", disturbed" } else { "" },
        report.viewers,
        report.rooms,
        if report.rooms == 1 { "" } else { "s" },
        report.fps,
        report.seconds
    );
    text += &format!(
        "  latency   p50 {:.2} ms, p99 {:.2} ms, p99.9 {:.2} ms, worst {:.2} ms\n",
        report.p50_ms, report.p99_ms, report.p999_ms, report.max_ms
    );
    text += &format!(
        "  frames    {} due, {} seen, {:.3} % lost, {} within 100 ms, {} after a newer one, {:.0} bytes each\n",
        report.frames_due, report.frames_seen, report.lost_percent, report.frames_useful, report.frames_backwards, report.packet_bytes
    );
    text += &format!(
        "  server    {:.1} % of a core ({:.2} µs a frame), {:.1} MiB idle + {:.1} MiB ({:.1} KiB a viewer)\n",
        report.cpu_percent,
        report.cpu_micros_a_frame,
        mib(report.memory_idle_bytes),
        mib(report.memory_growth_bytes()),
        report.memory_growth_bytes() as f64 / 1024.0 / report.viewers as f64
    );
    let others = match report.others_percent {
        Some(percent) => format!("others took {percent:.1} % of the server's core"),
        None => "there is one core for all".into(),
    };
    text += &format!("  noise     {others}, the generator {:.1} % of a core", report.generator_percent);
    if report.frames_held > 0 || report.viewers_lost > 0 || report.reconnects > 0 {
        text += &format!(
            "\n  peers     {} frames held by publishers, {} viewers lost, {} connections made anew",
            report.frames_held, report.viewers_lost, report.reconnects
        );
    }
    text
}

/// What two kinds of runs are to each other, in the median of the rounds.
fn ratios(reports: &[LoadReport]) -> String {
    type Value = fn(&LoadReport) -> f64;
    let median = |server: &str, disturbed: bool, value: Value| {
        let mut values: Vec<f64> =
            reports.iter().filter(|report| report.server == server && report.disturbed == disturbed).map(value).collect();
        values.sort_by(f64::total_cmp);
        (!values.is_empty()).then(|| values[values.len() / 2])
    };
    let mut text = String::new();
    let mut compare = |what: &str, (a, b): ((&str, bool), (&str, bool))| {
        let mut parts = Vec::new();
        let values: [(&str, Value); 6] = [
            ("p50", |report| report.p50_ms),
            ("p99", |report| report.p99_ms),
            ("p99.9", |report| report.p999_ms),
            ("useful frames", |report| report.frames_useful as f64 / report.frames_due.max(1) as f64),
            ("cpu", |report| report.cpu_percent),
            ("memory", |report| report.memory_growth_bytes() as f64),
        ];
        for (name, value) in values {
            if let (Some(a), Some(b)) = (median(a.0, a.1, value), median(b.0, b.1, value)) {
                parts.push(format!("{name} {:.2}", a / b));
            }
        }
        if !parts.is_empty() {
            text += &format!("{what}: {}\n", parts.join(", "));
        }
    };
    compare("rhytid / plain", (("rhytid", false), ("plain", false)));
    compare("rhytid / plain, both disturbed", (("rhytid", true), ("plain", true)));
    compare("rhytid, disturbed / calm", (("rhytid", true), ("rhytid", false)));
    compare("plain, disturbed / calm", (("plain", true), ("plain", false)));
    text
}
