//! What recordings take on disk.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::{load_character, solve::SolveConfig};
use rhytid_shared::packet::{BatchReader, BatchWriter, PacketKind};
use rhytid_shared::{TrackingData, TrackingFrame};
use std::path::{Path, PathBuf};

fn feed_path() -> PathBuf {
    std::env::var_os("RHYTID_FEED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl"), PathBuf::from)
}

#[test]
fn batches() {
    let (character, _) = load_character(None).unwrap();
    for estimate_weights in [true, false] {
        for resampled in [true, false] {
            let mut feed = Feed::open(&feed_path(), &character).unwrap();
            let config = SolveConfig { estimate_weights, ..SolveConfig::default() };
            let mut pipeline = Pipeline::new(character.clone(), &config, &feed.hello, 1).unwrap();
            let (mut frame, mut frames) = (TrackingFrame::default(), Vec::new());
            while let Some(item) = feed.next_frame(&mut frame).unwrap() {
                if item == FeedItem::Frame {
                    frames.push(frame.clone());
                }
            }
            let frames: Vec<TrackingFrame> = if resampled {
                let (start, end) = (frames[0].t, frames.last().unwrap().t);
                (0..((end - start) * 60.0) as usize)
                    .map(|i| {
                        let t = start + i as f64 / 60.0;
                        let after = frames.partition_point(|frame| frame.t <= t).min(frames.len() - 1).max(1);
                        let (a, b) = (&frames[after - 1], &frames[after]);
                        let mix = ((t - a.t) / (b.t - a.t)) as f32;
                        let data = match (&a.data, &b.data) {
                            (TrackingData::Landmarks { points: p, .. }, TrackingData::Landmarks { points: q, .. }) => {
                                TrackingData::Landmarks {
                                    points: p.iter().zip(q).map(|(p, q)| std::array::from_fn(|i| p[i] + (q[i] - p[i]) * mix)).collect(),
                                    confidence: Vec::new(),
                                }
                            }
                            (TrackingData::Weights { weights: p, head }, TrackingData::Weights { weights: q, .. }) => {
                                TrackingData::Weights {
                                    weights: Box::new(std::array::from_fn(|i| p[i] + (q[i] - p[i]) * mix)),
                                    head: *head,
                                }
                            }
                            (other, _) => other.clone(),
                        };
                        TrackingFrame::new(t, data)
                    })
                    .collect()
            } else {
                let start = frames[0].t;
                frames.iter().enumerate().map(|(i, frame)| TrackingFrame { t: start + i as f64 / 60.0, ..frame.clone() }).collect()
            };
            let mut packets = Vec::new();
            for (i, frame) in frames.iter().enumerate() {
                let mut packet = Vec::new();
                let kind = pipeline.frame(frame, &mut packet).unwrap();
                packets.push((1_700_000_000_000_000 + i as u64 * 16_667 + (i as u64 * 7919 % 301), kind, packet));
            }
            let raw: usize = packets.iter().map(|(_, _, packet)| packet.len()).sum();
            let keys = packets.iter().filter(|(_, kind, _)| *kind == PacketKind::Key).count();
            let (mut writer, mut reader) = (BatchWriter::new(&*character), BatchReader::new(&*character));
            let (mut bytes, mut batches, mut batch, mut read) = (0, 0, Vec::new(), 0);
            let mut rest = &packets[..];
            while !rest.is_empty() {
                let n =
                    1 + rest[1..].iter().take(29).enumerate().take_while(|(i, (_, kind, _))| *i < 20 || *kind != PacketKind::Key).count();
                writer.pack(rest[..n].iter().map(|(at, _, packet)| (*at, packet.as_slice())), &mut batch).unwrap();
                reader
                    .unpack(&batch, |at, packet| {
                        assert_eq!((at, packet), (packets[read].0, packets[read].2.as_slice()));
                        read += 1;
                    })
                    .unwrap();
                bytes += batch.len();
                batches += 1;
                rest = &rest[n..];
            }
            assert_eq!(read, packets.len());
            let n = packets.len() as f64;
            println!(
                "weights {estimate_weights}, resampled {resampled}: {n} packets, {keys} keys, {:.1} B each; in {batches} batches {:.1} B each: {:.0} KiB a minute",
                raw as f64 / n,
                bytes as f64 / n,
                bytes as f64 / n * 3600.0 / 1024.0
            );
        }
    }
}
