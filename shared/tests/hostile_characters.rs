//! Character files made to do harm: refused in a sentence, never a panic, a hang or a gigabyte.

#![allow(clippy::unwrap_used, reason = "a test file: what it unwraps is the small character's own structure")]

mod small;

use proptest::prelude::*;
use rhytid_shared::Character;
use serde_json::{Value, json};
use small::{Glb, png};

/// Breaks the small character with `breaking` and gives the message it is refused with.
#[track_caller]
fn refusal(breaking: impl FnOnce(&mut Glb)) -> String {
    let mut glb = Glb::small_character();
    breaking(&mut glb);
    let message = Character::from_glb(&glb.to_bytes()).expect_err("a broken file is refused").to_string();
    assert_eq!(message.lines().count(), 1, "{message}");
    message
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    }
}

/// The accessor of an attribute of the first primitive, or of its `indices`.
fn accessor<'a>(glb: &'a mut Glb, of: &str) -> &'a mut Value {
    let primitive = &glb.json["meshes"][0]["primitives"][0];
    let index = if of == "indices" { &primitive["indices"] } else { &primitive["attributes"][of] };
    let index = index.as_u64().unwrap() as usize;
    &mut glb.json["accessors"][index]
}

#[test]
fn the_small_character_is_whole() {
    let character = Character::from_glb(&Glb::small_character().to_bytes()).unwrap();
    assert_eq!((character.num_bones(), character.num_poses(), character.shapes.len()), (2, 1, 1));
}

#[test]
fn types_no_reader_expects() {
    const FLOAT: u32 = 5126;
    for (of, component_type, expected) in [
        ("JOINTS_0", FLOAT, "Vec4 of U8 or U16"),
        ("indices", FLOAT, "Scalar of U8 or U16 or U32"),
        ("WEIGHTS_0", 5120, "Vec4 of F32 or U8 or U16"),
        ("TEXCOORD_0", 5125, "Vec2 of F32 or U8 or U16"),
        ("POSITION", 5121, "Vec3 of F32"),
        ("NORMAL", 5122, "Vec3 of F32"),
        ("TANGENT", 5123, "Vec4 of F32"),
    ] {
        assert_says(&refusal(|glb| accessor(glb, of)["componentType"] = json!(component_type)), &[of, "expected", expected]);
    }
    // Fewer bytes an element than its reader takes, four bytes apart: each element ends in the next one, the last one nowhere.
    let message = refusal(|glb| {
        accessor(glb, "POSITION")["type"] = json!("SCALAR");
        let view = accessor(glb, "POSITION")["bufferView"].as_u64().unwrap() as usize;
        glb.json["bufferViews"][view]["byteStride"] = json!(4);
    });
    assert_says(&message, &["POSITION", "Scalar of F32", "expected Vec3"]);
}

#[test]
fn stride_below_the_size_of_an_element() {
    let message = refusal(|glb| {
        let view = accessor(glb, "POSITION")["bufferView"].as_u64().unwrap() as usize;
        glb.json["bufferViews"][view]["byteStride"] = json!(4);
    });
    assert_says(&message, &["POSITION", "past the end"]);
}

#[test]
fn accessors_that_are_not_there() {
    for of in ["POSITION", "JOINTS_0"] {
        let message = refusal(|glb| glb.json["meshes"][0]["primitives"][0]["attributes"][of] = json!(99));
        assert_says(&message, &["meshes[0].primitives[0]", of]);
    }
}

#[test]
fn empty_accessors() {
    for of in ["POSITION", "JOINTS_0", "indices"] {
        assert_says(&refusal(|glb| accessor(glb, of)["count"] = json!(0)), &[of, "has 0 elements, expected 1 to"]);
    }
    let message = refusal(|glb| {
        let target = glb.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"].as_u64().unwrap() as usize;
        glb.json["accessors"][target]["sparse"]["count"] = json!(0);
    });
    assert_says(&message, &["targets[0]", "replaces 0 elements"]);
}

#[test]
fn sparse_accessor_of_a_billion_zeros() {
    let message = refusal(|glb| {
        let target = glb.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"].clone();
        let zeros = json!({"count": 1_000_000_000, "min": [0, 0, 0], "max": [0, 0, 0]}).as_object().unwrap().clone();
        glb.json["accessors"][target.as_u64().unwrap() as usize].as_object_mut().unwrap().extend(zeros);
        glb.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = target;
    });
    assert_says(&message, &["has 1000000000 elements, expected 1 to 400000"]);
}

#[test]
fn indices_that_many_parts_share() {
    let message = refusal(|glb| {
        // Zeros after everything else: every part may draw vertex 0 a million times.
        let at = glb.bin.len();
        glb.bin.resize(at + 1_000_000, 0);
        let view = glb.json["bufferViews"].as_array().unwrap().len();
        glb.json["bufferViews"].as_array_mut().unwrap().push(json!({"buffer": 0, "byteOffset": at, "byteLength": 1_000_000}));
        accessor(glb, "indices")
            .as_object_mut()
            .unwrap()
            .extend(json!({"bufferView": view, "componentType": 5121, "count": 1_000_000}).as_object().unwrap().clone());
        let part = glb.json["meshes"][0]["primitives"][0].clone();
        glb.json["meshes"][0]["primitives"] = Value::Array(vec![part; 1000]);
    });
    assert_says(&message, &["meshes", "2400000 vertex indices"]);
}

#[test]
fn node_with_two_parents() {
    let message = refusal(|glb| glb.json["nodes"][1]["children"] = json!([2]));
    assert_says(&message, &["nodes[2] (\"brow_r\")", "placed twice", "nodes[0] and of nodes[1]"]);
    assert_says(&refusal(|glb| glb.json["scenes"][0]["nodes"] = json!([0, 2, 3])), &["nodes[2]", "placed twice", "root"]);
    // Sixty levels of it are 2^60 walks.
    let message = refusal(|glb| {
        let first = glb.json["nodes"].as_array().unwrap().len();
        for level in first..first + 60 {
            glb.json["nodes"].as_array_mut().unwrap().push(json!({"children": [level + 1, level + 1]}));
        }
        glb.json["nodes"].as_array_mut().unwrap().push(json!({}));
        glb.json["scenes"][0]["nodes"] = json!([0, 3, first]);
    });
    assert_says(&message, &["placed twice"]);
}

#[test]
fn nodes_in_a_circle_and_too_deep() {
    let message = refusal(|glb| glb.json["nodes"][2]["children"] = json!([0]));
    assert_says(&message, &["nodes[0]", "placed twice"]);
    // In no scene, but above a joint: who looks up from the joint must not walk for ever.
    let message = refusal(|glb| glb.json["nodes"].as_array_mut().unwrap().push(json!({"children": [4, 1]})));
    assert_says(&message, &["nodes[1]", "placed twice"]);
    let message = refusal(|glb| {
        for level in 4..1004 {
            glb.json["nodes"].as_array_mut().unwrap().push(json!({"children": [level + 1]}));
        }
        glb.json["nodes"].as_array_mut().unwrap().push(json!({}));
        glb.json["scenes"][0]["nodes"] = json!([0, 3, 4]);
    });
    assert_says(&message, &["nodes", "deeper than 256"]);
}

#[test]
fn more_images_or_texels_than_anybody_needs() {
    let message = refusal(|glb| {
        let image = glb.json["images"][0].clone();
        glb.json["images"] = Value::Array(vec![image; 65]);
    });
    assert_says(&message, &["images", "there are 65, at most 64"]);
    // One picture that packs well, used by many parts.
    let message = refusal(|glb| {
        let (at, png) = (glb.bin.len(), png(4096, 4096));
        glb.bin.extend(&png);
        let view = glb.json["bufferViews"].as_array().unwrap().len();
        glb.json["bufferViews"].as_array_mut().unwrap().push(json!({"buffer": 0, "byteOffset": at, "byteLength": png.len()}));
        glb.json["images"].as_array_mut().unwrap().push(json!({"bufferView": view, "mimeType": "image/png"}));
        glb.json["textures"].as_array_mut().unwrap().push(json!({"source": 1}));
        glb.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = json!(1);
        let part = glb.json["meshes"][0]["primitives"][0].clone();
        glb.json["meshes"][0]["primitives"] = Value::Array(vec![part; 5]);
    });
    assert_says(&message, &["images", "67108864 texels"]);
}

#[test]
fn image_without_a_kind_or_of_another() {
    assert_says(&refusal(|glb| glb.json["images"][0] = json!({"bufferView": 0})), &["images[0]", "mimeType"]);
    assert_says(&refusal(|glb| glb.json["images"][0] = json!({})), &["images[0]", "inside the .glb"]);
    let message = refusal(|glb| {
        let view = glb.json["images"][0]["bufferView"].as_u64().unwrap() as usize;
        let at = glb.json["bufferViews"][view]["byteOffset"].as_u64().unwrap() as usize;
        glb.bin[at..at + 13].copy_from_slice(b"GIF89a\x04\0\x04\0\0\0\0");
    });
    assert_says(&message, &["images[0]", "neither PNG nor JPEG"]);
}

#[test]
fn headers_that_lie() {
    let whole = Glb::small_character().to_bytes();
    let with_word = |at: usize, word: u32| {
        let mut bytes = whole.clone();
        bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
        Character::from_glb(&bytes).unwrap_err().to_string()
    };
    assert_says(&with_word(8, 3), &["3 bytes long, expected at least 20"]);
    assert_says(&with_word(8, u32::MAX), &["cut off"]);
    assert_says(&with_word(12, u32::MAX), &["bytes of JSON, at most 1048576"]);
    let much = Glb::small_character().with_json(&vec![b' '; (1 << 20) + 4]);
    assert_says(&Character::from_glb(&much).unwrap_err().to_string(), &["bytes of JSON", "at most"]);
}

#[test]
fn joints_that_are_one_or_move_two_bones() {
    assert_says(&refusal(|glb| glb.json["nodes"][2]["name"] = json!("brow_l")), &["nodes[2]", "name of another joint"]);
    let message = refusal(|glb| glb.json["extensions"]["RHYTID_face"]["bones"][1]["joint"] = json!("brow_l"));
    assert_says(&message, &["bones[1].joint", "another bone already"]);
}

#[test]
fn vertices_that_are_no_numbers_or_in_centimetres() {
    for value in [f32::NAN, f32::INFINITY, 170.0] {
        let message = refusal(|glb| glb.bin[4..8].copy_from_slice(&value.to_le_bytes()));
        assert_says(&message, &["POSITION[0]", "expected finite metres"]);
    }
}

/// A few bytes of the file, each replaced; half of them in the JSON, which is much the smaller part in real files.
fn flips() -> impl Strategy<Value = Vec<(prop::sample::Index, u8)>> {
    prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)
}

/// What JSON is made of: flips among these stay JSON more often than not.
const JSON_BYTES: &[u8] = b"0123456789-.e,:[]{}\"";

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn flipped_bytes_never_panic(flips in flips(), in_json in any::<bool>()) {
        let glb = Glb::small_character().with_zones();
        let bytes = if in_json {
            let mut json = serde_json::to_vec(&glb.json).unwrap();
            for (at, byte) in &flips {
                let at = at.index(json.len());
                json[at] = JSON_BYTES[usize::from(*byte) % JSON_BYTES.len()];
            }
            glb.with_json(&json)
        } else {
            let mut bytes = glb.to_bytes();
            for (at, byte) in &flips {
                let at = at.index(bytes.len());
                bytes[at] = *byte;
            }
            bytes
        };
        let _ = Character::from_glb(&bytes);
    }

    #[test]
    fn numbers_replaced_never_panic(which in any::<prop::sample::Index>(), number in prop_oneof![
        0_u64..12, Just(5120), Just(5121), Just(5123), Just(5125), Just(5126), Just(u64::from(u32::MAX)), Just(u64::MAX), Just(u64::MAX - 7),
    ]) {
        let mut glb = Glb::small_character();
        let mut numbers = Vec::new();
        for part in ["accessors", "bufferViews", "meshes", "skins", "nodes", "scenes", "images", "textures", "materials", "buffers"] {
            find_numbers(&format!("/{part}"), &glb.json[part], &mut numbers);
        }
        let path = &numbers[which.index(numbers.len())];
        *glb.json.pointer_mut(path).unwrap() = json!(number);
        let _ = Character::from_glb(&glb.to_bytes());
    }
}

fn find_numbers(path: &str, value: &Value, numbers: &mut Vec<String>) {
    match value {
        Value::Number(_) => numbers.push(path.to_owned()),
        Value::Array(all) => all.iter().enumerate().for_each(|(i, value)| find_numbers(&format!("{path}/{i}"), value, numbers)),
        Value::Object(all) => all.iter().for_each(|(key, value)| find_numbers(&format!("{path}/{key}"), value, numbers)),
        _ => {}
    }
}
