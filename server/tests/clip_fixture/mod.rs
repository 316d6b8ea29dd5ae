//! A character file with an animation clip.

use glam::{Quat, Vec3};
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB};

/// The built-in character with a clip "nod" of one second: the left brow's joint rises by 8 mm while the head turns by
/// 0.4 rad about +Y and moves by 2 cm.
pub fn with_clip() -> (Vec<u8>, Character) {
    let character = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
    let json_len = u32::from_le_bytes(DEFAULT_CHARACTER_GLB[12..16].try_into().unwrap()) as usize;
    let mut json: serde_json::Value = serde_json::from_slice(&DEFAULT_CHARACTER_GLB[20..20 + json_len]).unwrap();
    let mut blob = DEFAULT_CHARACTER_GLB[20 + json_len + 8..].to_vec();
    blob.resize(blob.len().next_multiple_of(4), 0);
    let node_of =
        |json: &serde_json::Value, name: &str| json["nodes"].as_array().unwrap().iter().position(|node| node["name"] == name).unwrap();
    let rest_of = |json: &serde_json::Value, node: usize| -> Vec3 {
        json["nodes"][node]["translation"]
            .as_array()
            .map_or(Vec3::ZERO, |t| Vec3::from_slice(&t.iter().map(|x| x.as_f64().unwrap() as f32).collect::<Vec<_>>()))
    };
    let mut add = |json: &mut serde_json::Value, values: &[f32], count: usize, kind: &str| {
        let view = json["bufferViews"].as_array().unwrap().len();
        json["bufferViews"]
            .as_array_mut()
            .unwrap()
            .push(serde_json::json!({"buffer": 0, "byteOffset": blob.len(), "byteLength": values.len() * 4}));
        blob.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let (min, max) = (values[0], values[values.len() - 1]);
        let mut accessor = serde_json::json!({"bufferView": view, "componentType": 5126, "count": count, "type": kind});
        if kind == "SCALAR" {
            (accessor["min"], accessor["max"]) = (vec![min].into(), vec![max].into());
        }
        json["accessors"].as_array_mut().unwrap().push(accessor);
        json["accessors"].as_array().unwrap().len() - 1
    };
    let (brow, head) = (node_of(&json, &character.bones[0].joint), node_of(&json, &character.head_joint));
    let (brow_rest, head_rest) = (rest_of(&json, brow), rest_of(&json, head));
    let turn = Quat::from_rotation_y(0.4);
    let (brow_top, head_end) = (brow_rest + Vec3::new(0.0, 0.008, 0.0), head_rest + Vec3::new(0.02, 0.0, 0.0));
    let times = add(&mut json, &[0.0, 1.0], 2, "SCALAR");
    let lift = add(&mut json, &[brow_rest.to_array(), brow_top.to_array()].concat(), 2, "VEC3");
    let shift = add(&mut json, &[head_rest.to_array(), head_end.to_array()].concat(), 2, "VEC3");
    let spin = add(&mut json, &[Quat::IDENTITY.to_array(), turn.to_array()].concat(), 2, "VEC4");
    let channel = |sampler: usize, node: usize, path: &str| serde_json::json!({"sampler": sampler, "target": {"node": node, "path": path}});
    let sampler = |output: usize| serde_json::json!({"input": times, "output": output});
    json["animations"] = serde_json::json!([{
        "name": "nod",
        "samplers": [sampler(lift), sampler(shift), sampler(spin)],
        "channels": [channel(0, brow, "translation"), channel(1, head, "translation"), channel(2, head, "rotation")],
    }]);
    json["buffers"][0]["byteLength"] = blob.len().into();
    let mut text = serde_json::to_vec(&json).unwrap();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut glb = b"glTF\x02\0\0\0".to_vec();
    glb.extend((12 + 8 + text.len() as u32 + 8 + blob.len() as u32).to_le_bytes());
    glb.extend([&(text.len() as u32).to_le_bytes()[..], b"JSON", &text, &(blob.len() as u32).to_le_bytes(), b"BIN\0", &blob].concat());
    let character = Character::from_glb(&glb).unwrap();
    (glb, character)
}
