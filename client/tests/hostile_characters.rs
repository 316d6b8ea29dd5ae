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

/// As other heads have it: ARKit's `browInnerUp` in two halves that share an accessor here, and a target that is none of ARKit's.
#[test]
fn halves_of_a_shape_add_up_and_foreign_targets_are_left_out() {
    let entries_of = |names: &[&str]| {
        let mut glb = Glb::small_character();
        let target = glb.json["meshes"][0]["primitives"][0]["targets"][0].clone();
        glb.json["meshes"][0]["primitives"][0]["targets"] = vec![target; names.len()].into();
        glb.json["meshes"][0]["extras"]["targetNames"] = names.to_vec().into();
        let asset = CharacterAsset::from_glb(&glb.to_bytes()).unwrap();
        let moved = asset.primitives[0].vertices.iter().flat_map(|vertex| asset.morphs.of_vertex(vertex.morphs)).collect::<Vec<_>>();
        // One vertex moves, those that share a triangle with it turn.
        (moved.iter().map(|entry| entry.displacement.y).fold(0.0, f32::max), moved.len(), asset.character.shapes.len())
    };
    let (whole, num, _) = entries_of(&["browInnerUp"]);
    assert!((whole - 0.004).abs() < 1e-5 && num == 3, "{whole} m at {num} vertices");
    let (halves, num, num_shapes) = entries_of(&["PupilDilate_L", "browInnerUp_L", "cheekRaiser_R", "browInnerUp_R"]);
    assert!((halves - 0.008).abs() < 1e-5 && (num, num_shapes) == (3, 1), "{halves} m at {num} vertices");
    assert_eq!(entries_of(&["PupilDilate_L"]), (0.0, 0, 0));
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
