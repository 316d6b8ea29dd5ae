//! The built-in session, replayed: the packets it gives are the same bytes on every run and every machine.

use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::SolveConfig;
use rhytid_shared::packet::PacketKind;
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, TrackingData, TrackingFrame};
use sha2::{Digest, Sha256};
use std::path::Path;
use std::sync::Arc;

/// What a replay is compared by.
#[derive(Debug, PartialEq)]
struct Replay {
    sha256: String,
    num_packets: usize,
    num_key_packets: usize,
    num_bytes: usize,
}

fn replay(config: &SolveConfig) -> Replay {
    let character = Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the default character is sound"));
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl");
    let mut feed = Feed::open(&path, &character).expect("the demo session is in the project");
    let hello = feed.hello.clone();
    let mut pipeline = Pipeline::new(character, config, &hello, 1).expect("the session fits the character");
    let mut frame = TrackingFrame::new(0.0, TrackingData::NoFace);
    let (mut hash, mut packet) = (Sha256::new(), Vec::new());
    let mut replay = Replay { sha256: String::new(), num_packets: 0, num_key_packets: 0, num_bytes: 0 };
    while let Some(item) = feed.next_frame(&mut frame).expect("the demo session has no bad line") {
        match item {
            FeedItem::Command(command) => pipeline.command(&command).expect("the feed's commands are sound"),
            FeedItem::Frame => {
                let kind = pipeline.frame(&frame, &mut packet).expect("every frame is solved");
                hash.update((packet.len() as u64).to_le_bytes());
                hash.update(&packet);
                replay.num_packets += 1;
                replay.num_key_packets += usize::from(kind == PacketKind::Key);
                replay.num_bytes += packet.len();
            }
        }
    }
    replay.sha256 = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    replay
}

#[test]
fn built_in_session_gives_the_recorded_packets() {
    let first = replay(&SolveConfig::default());
    assert_eq!(first, replay(&SolveConfig::default()), "two runs differ");
    insta::assert_debug_snapshot!(first);
}

#[test]
fn a_changed_solve_gives_other_packets() {
    let mut config = SolveConfig::default();
    config.filter.mouth.min_cutoff *= 1.01;
    assert_ne!(replay(&config).sha256, replay(&SolveConfig::default()).sha256, "a snapshot that nothing changes proves nothing");
}
