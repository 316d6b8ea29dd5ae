//! Broken character files: each is refused with a message that names what is wrong.

#![allow(clippy::unwrap_used, reason = "a test file: what it unwraps is the default character's own structure")]

use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB};
use serde_json::{Value, json};

/// The two chunks of a `.glb`, taken apart so that a test can break one thing.
struct Glb {
    json: Value,
    bin: Vec<u8>,
}

impl Glb {
    fn default_character() -> Self {
        let word = |at: usize| u32::from_le_bytes(DEFAULT_CHARACTER_GLB[at..at + 4].try_into().unwrap()) as usize;
        let json_length = word(12);
        let bin_at = 20 + json_length;
        Self {
            json: serde_json::from_slice(&DEFAULT_CHARACTER_GLB[20..bin_at]).unwrap(),
            bin: DEFAULT_CHARACTER_GLB[bin_at + 8..bin_at + 8 + word(bin_at)].to_vec(),
        }
    }

    fn face(&mut self) -> &mut Value {
        &mut self.json["extensions"]["RHYTID_face"]
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut json = serde_json::to_vec(&self.json).unwrap();
        json.resize(json.len().next_multiple_of(4), b' ');
        let mut bytes = b"glTF".to_vec();
        let total = 12 + 8 + json.len() + 8 + self.bin.len();
        for word in [2, total, json.len(), 0x4E4F_534A] {
            bytes.extend((word as u32).to_le_bytes());
        }
        bytes.extend(&json);
        for word in [self.bin.len(), 0x004E_4942] {
            bytes.extend((word as u32).to_le_bytes());
        }
        bytes.extend(&self.bin);
        bytes
    }

    /// Byte offset of element 0 of the accessor that `attribute` of the first primitive (or its indices) names.
    fn offset_of(&self, attribute: &str) -> usize {
        let primitive = &self.json["meshes"][0]["primitives"][0];
        let index = if attribute == "indices" { &primitive["indices"] } else { &primitive["attributes"][attribute] };
        let accessor = &self.json["accessors"][index.as_u64().unwrap() as usize];
        let view = &self.json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let offset = |value: &Value| value["byteOffset"].as_u64().unwrap_or(0) as usize;
        offset(accessor) + offset(view)
    }
}

/// Breaks the default character with `breaking` and gives the message it is refused with.
#[track_caller]
fn refusal(breaking: impl FnOnce(&mut Glb)) -> String {
    let mut glb = Glb::default_character();
    breaking(&mut glb);
    Character::from_glb(&glb.to_bytes()).expect_err("a broken file is refused").to_string()
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    }
}

#[test]
fn the_default_character_survives_being_taken_apart() {
    let whole = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
    let again = Character::from_glb(&Glb::default_character().to_bytes()).unwrap();
    assert_eq!((whole.bones, whole.poses, whole.shapes), (again.bones, again.poses, again.shapes));
}

#[test]
fn truncated_at_any_length() {
    let step = DEFAULT_CHARACTER_GLB.len() / 37;
    for length in (0..DEFAULT_CHARACTER_GLB.len()).step_by(step) {
        assert!(Character::from_glb(&DEFAULT_CHARACTER_GLB[..length]).is_err(), "{length} bytes");
    }
    assert_says(&Character::from_glb(b"PNG").unwrap_err().to_string(), &["not a readable .glb", "glTF"]);
}

#[test]
fn no_extension() {
    let message = refusal(|glb| glb.json["extensions"] = json!({}));
    assert_says(&message, &["RHYTID_face", "is missing", "README"]);
}

#[test]
fn extension_of_another_version() {
    assert_says(&refusal(|glb| glb.face()["version"] = json!(7)), &["RHYTID_face.version", "7", "reads 1"]);
}

#[test]
fn weights_that_do_not_sum_to_one() {
    let message = refusal(|glb| {
        let at = glb.offset_of("WEIGHTS_0");
        glb.bin[at..at + 16].fill(0);
    });
    assert_says(&message, &["WEIGHTS_0", "expected 1"]);
}

#[test]
fn index_out_of_range() {
    let message = refusal(|glb| {
        let at = glb.offset_of("indices");
        glb.bin[at..at + 4].fill(0xFE);
    });
    assert_says(&message, &["indices[0]", "vertices"]);
}

#[test]
fn joint_out_of_range() {
    let message = refusal(|glb| {
        let at = glb.offset_of("JOINTS_0");
        glb.bin[at] = 0xFE;
    });
    assert_says(&message, &["JOINTS_0[0]", "joints"]);
}

#[test]
fn accessor_past_the_end() {
    let message = refusal(|glb| {
        let length = glb.bin.len();
        glb.json["bufferViews"][0]["byteLength"] = json!(length);
        glb.json["accessors"][0]["count"] = json!(40_000_000);
    });
    assert_says(&message, &["past the end"]);
}

#[test]
fn wrinkle_map_of_the_wrong_size() {
    let message = refusal(|glb| {
        // The base colour is not the size of the first pose's map.
        let colour = glb.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"].clone();
        glb.face()["poses"][1]["map"]["texture"] = colour;
    });
    assert_says(&message, &["poses[1].map.texture", "expected 1024 x 1024"]);
    assert_says(&refusal(|glb| glb.face()["poses"][0]["map"]["texture"] = json!(999)), &["poses[0].map.texture", "999"]);
}

#[test]
fn image_that_is_none() {
    let message = refusal(|glb| {
        let view = glb.json["images"][0]["bufferView"].as_u64().unwrap() as usize;
        let at = glb.json["bufferViews"][view]["byteOffset"].as_u64().unwrap_or(0) as usize;
        glb.bin[at..at + 64].fill(0);
    });
    assert_says(&message, &["images[0]", "neither PNG nor JPEG"]);
}

#[test]
fn no_joints_and_too_many() {
    assert_says(&refusal(|glb| glb.json["skins"] = json!([])), &["skin"]);
    assert_says(&refusal(|glb| glb.json["skins"][0]["joints"] = json!([])), &["joints"]);
    let message = refusal(|glb| {
        let joint = glb.json["skins"][0]["joints"][0].clone();
        glb.json["skins"][0]["joints"] = Value::Array(vec![joint; 129]);
        glb.json["skins"][0].as_object_mut().unwrap().remove("inverseBindMatrices");
    });
    assert_says(&message, &["129", "128"]);
}

#[test]
fn bone_without_a_joint() {
    assert_says(&refusal(|glb| glb.face()["bones"][2]["joint"] = json!("elbow")), &["bones[2].joint", "elbow"]);
    assert_says(&refusal(|glb| glb.face()["head"] = json!("elbow")), &["RHYTID_face.head", "elbow"]);
}

#[test]
fn bones_that_are_too_many_or_named_twice() {
    let message = refusal(|glb| {
        let bone = glb.face()["bones"][0].clone();
        glb.face()["bones"] = Value::Array(vec![bone; 65]);
    });
    assert_says(&message, &["65", "64"]);
    let message = refusal(|glb| glb.face()["bones"][1]["name"] = glb.json["extensions"]["RHYTID_face"]["bones"][0]["name"].clone());
    assert_says(&message, &["bones[1].name", "twice"]);
    assert_says(&refusal(|glb| glb.face()["bones"] = json!([])), &["RHYTID_face.bones", "0 bones"]);
}

#[test]
fn poses_that_are_noise_or_fly_away() {
    let mut rest = Vec::new();
    let moved_by = |rest: &mut Vec<f64>, by: f64| {
        refusal(|glb| {
            let bone = glb.face()["bones"][0].clone();
            *rest = bone["point"].as_array().unwrap().iter().map(|c| c.as_f64().unwrap()).collect();
            let name = bone["name"].as_str().unwrap().to_owned();
            glb.face()["poses"][0]["bones"][name] = json!([rest[0], rest[1] + by, rest[2]]);
        })
    };
    assert_says(&moved_by(&mut rest, 0.0001), &["poses[0].bones", "0.100 mm", "at least 0.2 mm"]);
    assert_says(&moved_by(&mut rest, 0.2), &["poses[0].bones", "expected within"]);
}

#[test]
fn landmarks_in_the_wrong_number_unit_or_hand() {
    assert_says(&refusal(|glb| glb.face()["landmarks"]["ibug68"] = json!([[0.0, 0.0, 0.0]])), &["ibug68", "has 1 points", "68"]);
    let scaled = |factor: [f64; 3]| {
        refusal(|glb| {
            for point in glb.face()["landmarks"]["ibug68"].as_array_mut().unwrap() {
                for axis in 0..3 {
                    point[axis] = json!(point[axis].as_f64().unwrap() * factor[axis]);
                }
            }
        })
    };
    assert_says(&scaled([0.01; 3]), &["ibug68", "metres"]);
    assert_says(&scaled([1000.0; 3]), &["ibug68", "metres"]);
    assert_says(&scaled([-1.0, 1.0, 1.0]), &["ibug68", "left"]);
}

#[test]
fn names_that_lead_nowhere() {
    assert_says(&refusal(|glb| glb.face()["groups"] = json!([["tail"]])), &["groups[0]", "tail"]);
    assert_says(&refusal(|glb| glb.face()["poses"][0]["bones"]["tail"] = json!([0, 0, 0])), &["poses[0].bones.tail", "no bone"]);
    let message = refusal(|glb| glb.face()["correctives"] = json!([{"weights": {"wink": 1.0}, "bones": {}}]));
    assert_says(&message, &["correctives[0].weights.wink", "no ARKit shape"]);
}
