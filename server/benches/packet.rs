//! What a frame costs on the wire and to encode and decode. Prints the mean sizes beside those of other formats.
//!
//! The feed is the session that comes with the project; `RHYTID_FEED` names another one.

#![allow(missing_docs, reason = "criterion's macros make functions without docs")]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::{load_character, solve::SolveConfig};
use rhytid_shared::packet::{Decoder, Encoder, PacketKind, PacketLayout};
use rhytid_shared::{FaceFrame, TrackingFrame};
use std::hint::black_box;
use std::path::{Path, PathBuf};

/// Bytes a frame in other formats, as their specifications and sources give them: UDP payload with all values sent.
const OTHERS: [(&str, f64); 3] =
    [("Live Link Face (61 floats)", 312.0), ("OpenSeeFace (66 points and more)", 1785.0), ("VMC (52 OSC messages and bones)", 2524.0)];

fn packets(criterion: &mut Criterion) {
    let (character, _) = load_character(None).expect("the built-in character is good");
    let path = std::env::var_os("RHYTID_FEED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl"), PathBuf::from);
    let mut feed = Feed::open(&path, &character).expect("the feed is good");
    let mut pipeline = Pipeline::new(character.clone(), &SolveConfig::default(), &feed.hello, 1).expect("the hello is good");
    let (mut tracking, mut packet) = (TrackingFrame::default(), Vec::new());
    let (mut frames, mut packets): (Vec<FaceFrame>, Vec<(PacketKind, Vec<u8>)>) = Default::default();
    while let Some(item) = feed.next_frame(&mut tracking).expect("the feed is good") {
        if item == FeedItem::Frame {
            let kind = pipeline.frame(&tracking, &mut packet).expect("the frame is good");
            frames.push(pipeline.face().clone());
            packets.push((kind, packet.clone()));
        }
    }
    let mean = |kind: Option<PacketKind>| {
        let sizes: Vec<usize> =
            packets.iter().filter(|(k, _)| kind.is_none_or(|kind| kind == *k)).map(|(_, packet)| packet.len()).collect();
        (sizes.iter().sum::<usize>() as f64 / sizes.len().max(1) as f64, sizes.len())
    };
    let largest = packets.iter().map(|(_, packet)| packet.len()).max().unwrap_or_default();
    println!("{}: {} frames, {} bones, {} poses", path.display(), packets.len(), character.num_bones(), character.num_poses());
    println!("{:<36} {:>8}", "bytes a frame", "mean");
    println!("{:<36} {:>8.1}   largest {largest}", "Rhytid", mean(None).0);
    for (name, kind) in [("  key packets", PacketKind::Key), ("  deltas", PacketKind::Delta)] {
        let (bytes, count) = mean(Some(kind));
        println!("{name:<36} {bytes:>8.1}   {count} of them");
    }
    for (name, bytes) in OTHERS {
        println!("{name:<36} {bytes:>8.1}");
    }

    let mut group = criterion.benchmark_group("packet");
    group.throughput(Throughput::Elements(frames.len() as u64));
    group.bench_function("encode", |bencher| {
        bencher.iter(|| {
            let mut encoder = Encoder::new(&*character);
            for frame in &frames {
                black_box(encoder.encode(frame, &mut packet));
            }
        });
    });
    group.bench_function("decode", |bencher| {
        let mut decoder = Decoder::new(PacketLayout::from(&*character));
        let mut frame = decoder.layout().frame_at_rest();
        bencher.iter(|| {
            for (_, packet) in &packets {
                decoder.decode(black_box(packet), &mut frame).expect("its own packets can be read");
            }
        });
    });
    group.finish();
}

criterion_group!(benches, packets);
criterion_main!(benches);
