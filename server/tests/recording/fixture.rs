//! Recordings, and what they are made of.

use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::recording::{Entry, Recording, RecordingWriter, SessionEvent, Topic};
use rhytid_server::solve::SolveConfig;
use rhytid_shared::packet::{BatchReader, PacketKind, PacketLayout};
use rhytid_shared::view::ViewHello;
use rhytid_shared::{Character, FaceFrame, PublishHello, TrackingData, TrackingFrame};
use serde_json::Value;
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl")
}

/// A number from 0 to 1 that looks random.
pub fn noise(seed: u64) -> f64 {
    let mut x = seed.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (x ^ (x >> 31)) as f64 / u64::MAX as f64
}

pub const SECOND: u64 = 1_000_000_000;
pub const BEGIN: u64 = 1_700_000_000 * SECOND;

pub fn begin(character: &Character) -> SessionEvent {
    let hello = ViewHello::new("demo", character, "/characters/default.glb".into());
    SessionEvent::Recording { version: 1, room: "demo".into(), server: "test".into(), character: Box::new(hello.character), clock: 0 }
}

/// Frames of the demo, `fps` a second by interpolation.
pub fn resampled(character: &Character, fps: f64) -> (PublishHello, Vec<TrackingFrame>) {
    let mut feed = Feed::open(&demo(), character).unwrap();
    let (mut frame, mut frames) = (TrackingFrame::default(), Vec::new());
    while let Some(item) = feed.next_frame(&mut frame).unwrap() {
        if item == FeedItem::Frame {
            frames.push(frame.clone());
        }
    }
    let (start, end) = (frames[0].t, frames.last().unwrap().t);
    let at = |i: usize| {
        let t = start + i as f64 / fps;
        let after = frames.partition_point(|frame| frame.t <= t).clamp(1, frames.len() - 1);
        let (a, b) = (&frames[after - 1], &frames[after]);
        let mix = ((t - a.t) / (b.t - a.t)) as f32;
        let data = match (&a.data, &b.data) {
            (TrackingData::Landmarks { points: p, .. }, TrackingData::Landmarks { points: q, .. }) => TrackingData::Landmarks {
                points: p.iter().zip(q).map(|(p, q)| std::array::from_fn(|i| p[i] + (q[i] - p[i]) * mix)).collect(),
                confidence: Vec::new(),
            },
            (other, _) => other.clone(),
        };
        TrackingFrame::new(t, data)
    };
    let frames = (0..((end - start) * fps) as usize).map(at).collect();
    (feed.hello, frames)
}

/// Writes the packets of `frames`, each at its own time, chunks as a server closes them. Gives the faces.
pub fn write_packets(path: &Path, character: &Arc<Character>, hello: &PublishHello, frames: &[TrackingFrame]) -> Vec<FaceFrame> {
    let mut pipeline = Pipeline::new(character.clone(), &SolveConfig::default(), hello, 1).unwrap();
    let mut writer = RecordingWriter::to(File::create(path).unwrap(), PacketLayout::from(&**character)).unwrap();
    writer.event(BEGIN, &begin(character)).unwrap();
    let (mut faces, mut flushed) = (Vec::new(), 0.0);
    for frame in frames {
        let mut packet = Vec::new();
        let kind = pipeline.frame(frame, &mut packet).unwrap();
        faces.push(pipeline.face().clone());
        // 0.7 s, or 0.5 s and a key packet.
        let age = frame.t - flushed;
        if age >= 0.7 || (age >= 0.5 && kind == PacketKind::Key) {
            writer.flush().unwrap();
            flushed = frame.t;
        }
        let jitter = (noise(faces.len() as u64) * 300_000.0) as u64;
        writer.packet(BEGIN + (frame.t * 1e9) as u64 + jitter, packet.into());
    }
    writer.finish().unwrap();
    faces
}

/// Writes `entries` as a recording.
pub fn rewrite(path: &Path, entries: &[Entry], character: &Character) {
    let mut writer = RecordingWriter::to(File::create(path).unwrap(), PacketLayout::from(character)).unwrap();
    for entry in entries {
        match entry.topic {
            Topic::Packets => {
                let mut reader = BatchReader::new(character);
                reader.unpack(&entry.data, |at, packet| writer.packet(at * 1000, packet.to_vec().into())).unwrap();
                writer.flush().unwrap();
            }
            _ => writer.message(&entry.topic, entry.log_time, None, &entry.data).unwrap(),
        }
    }
    writer.finish().unwrap();
}

pub fn entries(path: &Path) -> Vec<Entry> {
    let mut recording = Recording::open(path).unwrap();
    (0..recording.chunks().len()).flat_map(|index| recording.read_chunk(index).unwrap()).collect()
}

/// The demo with `fields` in its hello and `others` before frames of these numbers, as a file.
pub fn changed_demo(path: &Path, fields: &Value, others: &[(usize, &str)], frames: Range<usize>) {
    let text = std::fs::read_to_string(demo()).unwrap();
    let mut lines = text.lines();
    let mut hello: Value = serde_json::from_str(lines.next().unwrap()).unwrap();
    hello.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
    let mut out = hello.to_string() + "\n";
    for (index, line) in lines.enumerate().filter(|(index, _)| frames.contains(index)) {
        for (_, other) in others.iter().filter(|(before, _)| *before == index) {
            out += &format!("{other}\n");
        }
        out += &format!("{line}\n");
    }
    std::fs::write(path, out).unwrap();
}

pub fn without(entries: &[Entry], is_left_out: impl Fn(&Entry) -> bool) -> Vec<Entry> {
    entries.iter().filter(|entry| !is_left_out(entry)).cloned().collect()
}
