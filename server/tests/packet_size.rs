//! What real tracker data costs on the wire, and that the same feed gives the same packets.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::{load_character, solve::SolveConfig};
use rhytid_shared::packet::{Decoder, PacketKind, PacketLayout};
use rhytid_shared::{Character, TrackingFrame};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The session that comes with the project, 20 s of real tracker data; another one where `RHYTID_FEED` names it.
fn feed_path() -> PathBuf {
    std::env::var_os("RHYTID_FEED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl"), PathBuf::from)
}

fn packets(character: &Arc<Character>) -> Vec<(PacketKind, Vec<u8>)> {
    let mut feed = Feed::open(&feed_path(), character).unwrap();
    let mut pipeline = Pipeline::new(character.clone(), &SolveConfig::default(), &feed.hello, 1).unwrap();
    let (mut frame, mut packets) = (TrackingFrame::default(), Vec::new());
    while let Some(item) = feed.next_frame(&mut frame).unwrap() {
        if item == FeedItem::Frame {
            let mut packet = Vec::new();
            packets.push((pipeline.frame(&frame, &mut packet).unwrap(), packet));
        }
    }
    packets
}

#[test]
fn real_tracker_data_takes_less_than_90_bytes_a_frame() {
    let (character, _) = load_character(None).unwrap();
    let packets = packets(&character);
    let mean = |kind: Option<PacketKind>| {
        let sizes: Vec<usize> =
            packets.iter().filter(|(k, _)| kind.is_none_or(|kind| kind == *k)).map(|(_, packet)| packet.len()).collect();
        (sizes.iter().sum::<usize>() as f64 / sizes.len().max(1) as f64, sizes.len())
    };
    let (all, num_packets) = mean(None);
    println!(
        "{num_packets} packets of {} bones and {} poses: {all:.1} bytes on average; key {:.1?}, delta {:.1?}",
        character.num_bones(),
        character.num_poses(),
        mean(Some(PacketKind::Key)),
        mean(Some(PacketKind::Delta)),
    );
    assert!(num_packets > 300);
    assert!(all <= 90.0, "{all} bytes");

    let mut decoder = Decoder::new(PacketLayout::from(&*character));
    let mut frame = decoder.layout().frame_at_rest();
    for (seq, (kind, packet)) in packets.iter().enumerate() {
        assert_eq!(decoder.decode(packet, &mut frame), Ok(*kind));
        assert_eq!(frame.seq as usize, seq);
    }
}

#[test]
fn the_same_feed_gives_the_same_packets() {
    let (character, _) = load_character(None).unwrap();
    let first = packets(&character);
    assert!(first == packets(&character), "the second run gave other bytes");
}
