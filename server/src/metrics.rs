//! What the service counts, as Prometheus reads it.

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Registry, Unit};
use std::collections::BTreeSet;

/// Label of a count by reason.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct Reason {
    reason: &'static str,
}

/// Label of a tracker protocol.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct Spoken {
    protocol: &'static str,
}

/// Labels of a tracker protocol's dropped datagrams and faces.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct SpokenReason {
    protocol: &'static str,
    reason: &'static str,
}

/// Every counter of the service.
pub(crate) struct Metrics {
    registry: Registry,
    pub connections: Gauge,
    pub rooms: Gauge,
    pub publishers: Gauge,
    pub viewers: Gauge,
    pub frames_in: Counter,
    pub frames_out: Counter,
    pub bytes_in: Counter,
    pub bytes_out: Counter,
    pub solve_seconds: Histogram,
    pub vmc_frames_out: Counter,
    tracker_datagrams: Family<Spoken, Counter>,
    tracker_frames: Family<Spoken, Counter>,
    tracker_dropped: Family<SpokenReason, Counter>,
    dropped: Family<Reason, Counter>,
    refused: Family<Reason, Counter>,
}

impl Metrics {
    pub fn new() -> Self {
        let mut registry = Registry::with_prefix("rhytid");
        let metrics = Self {
            connections: Gauge::default(),
            rooms: Gauge::default(),
            publishers: Gauge::default(),
            viewers: Gauge::default(),
            frames_in: Counter::default(),
            frames_out: Counter::default(),
            bytes_in: Counter::default(),
            bytes_out: Counter::default(),
            // 2 µs to 4 ms.
            solve_seconds: Histogram::new(exponential_buckets(2e-6, 2.0, 12)),
            vmc_frames_out: Counter::default(),
            tracker_datagrams: Family::default(),
            tracker_frames: Family::default(),
            tracker_dropped: Family::default(),
            dropped: Family::default(),
            refused: Family::default(),
            registry: Registry::default(),
        };
        registry.register("connections", "Connections that are open", metrics.connections.clone());
        registry.register("rooms", "Rooms that exist", metrics.rooms.clone());
        registry.register("publishers", "Publishers connected", metrics.publishers.clone());
        registry.register("viewers", "Viewers connected", metrics.viewers.clone());
        registry.register("frames_in", "Frames accepted from publishers", metrics.frames_in.clone());
        registry.register("frames_out", "Frames sent to viewers", metrics.frames_out.clone());
        registry.register_with_unit("in", "Payload received from publishers", Unit::Bytes, metrics.bytes_in.clone());
        registry.register_with_unit("out", "Payload sent to viewers", Unit::Bytes, metrics.bytes_out.clone());
        registry.register_with_unit("solve", "Time to solve one frame", Unit::Seconds, metrics.solve_seconds.clone());
        registry.register("frames_dropped", "Frames that were refused, or that a slow viewer skipped, by reason", metrics.dropped.clone());
        registry.register("sessions_ended", "Sockets refused or ended by either side, by reason", metrics.refused.clone());
        registry.register("tracker_datagrams", "Datagrams from trackers, by protocol", metrics.tracker_datagrams.clone());
        registry.register(
            "tracker_frames",
            "Faces that trackers' datagrams have put into rooms, by protocol",
            metrics.tracker_frames.clone(),
        );
        registry.register(
            "tracker_dropped",
            "Trackers' datagrams that were dropped, and faces in them, by protocol and reason",
            metrics.tracker_dropped.clone(),
        );
        registry.register("vmc_frames_out", "Faces sent as VMC", metrics.vmc_frames_out.clone());
        let metrics = Self { registry, ..metrics };
        // Listed from the start, with its zero.
        metrics.drop_frames("slow_viewer", 0);
        metrics
    }

    /// Counts frames that did not go on.
    pub fn drop_frames(&self, reason: &'static str, count: u64) {
        self.dropped.get_or_create(&Reason { reason }).inc_by(count);
    }

    /// Counts a datagram of a tracker.
    pub fn tracker_datagram(&self, protocol: &'static str) {
        self.tracker_datagrams.get_or_create(&Spoken { protocol }).inc();
    }

    /// Counts a face that a tracker has put into a room.
    pub fn tracker_frame(&self, protocol: &'static str) {
        self.tracker_frames.get_or_create(&Spoken { protocol }).inc();
    }

    /// Counts a datagram of a tracker, or a face in one, that did not go on.
    pub fn tracker_drop(&self, protocol: &'static str, reason: &'static str) {
        self.tracker_dropped.get_or_create(&SpokenReason { protocol, reason }).inc();
    }

    /// Counts a socket that was refused, or ended by either side.
    pub fn end(&self, reason: &'static str) {
        self.refused.get_or_create(&Reason { reason }).inc();
    }

    /// In the OpenMetrics text format, version 1.0.0.
    pub fn open_metrics(&self) -> String {
        let mut text = String::new();
        encode(&mut text, &self.registry).expect("writing to a String cannot fail");
        text
    }

    /// In Prometheus's own text format, version 0.0.4. It differs in that a counter's family is called as its samples are, and
    /// that it knows neither units nor an end.
    pub fn prometheus(&self) -> String {
        let open_metrics = self.open_metrics();
        let counters: BTreeSet<&str> =
            open_metrics.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.strip_suffix(" counter")).collect();
        let mut text = String::with_capacity(open_metrics.len() + 256);
        for line in open_metrics.lines() {
            let mut words = line.splitn(4, ' ');
            match (words.next(), words.next(), words.next(), words.next()) {
                (Some("#"), Some("UNIT" | "EOF"), ..) => continue,
                (Some("#"), Some(kind), Some(family), Some(rest)) if counters.contains(family) => {
                    text.push_str(&format!("# {kind} {family}_total {rest}"));
                }
                _ => text.push_str(line),
            }
            text.push('\n');
        }
        text
    }
}
