//! Character files made to do harm, read as the viewer reads what a server sent: decoded or refused, never a panic.

#![allow(clippy::unwrap_used, reason = "a test file: what it unwraps is the small character's own structure")]

#[path = "../../shared/tests/small/mod.rs"]
mod small;

use proptest::prelude::*;
use rhytid_client::CharacterAsset;
use small::Glb;

#[test]
fn the_small_character_is_drawable() {
    let asset = CharacterAsset::from_glb(&Glb::small_character().to_bytes()).unwrap();
    assert_eq!((asset.num_vertices(), asset.primitives[0].indices.len()), (4, 6));
    assert!(asset.wrinkles.is_some() && asset.primitives[0].material.albedo.is_some());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn flipped_bytes_never_panic(
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6), in_json in any::<bool>(),
    ) {
        let glb = Glb::small_character();
        let mut bytes = glb.to_bytes();
        // Flips in the whole file mostly hit the JSON and are refused there: half of the cases spare it.
        let from = if in_json { 0 } else { bytes.len() - glb.bin.len() };
        let length = bytes.len() - from;
        for (at, byte) in flips {
            bytes[from + at.index(length)] = byte;
        }
        let _ = CharacterAsset::from_glb(&bytes);
    }
}
