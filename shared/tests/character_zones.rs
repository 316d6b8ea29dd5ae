//! Wrinkle zones of a character file: read as they are written, and each mistake refused with its field.

#![allow(clippy::unwrap_used, reason = "a test file: what it unwraps is the small character's own structure")]

mod small;

use rhytid_shared::Character;
use rhytid_shared::character::{BridgeRow, Expression, Side, Zone, ZoneMap};
use rhytid_shared::packet::{Decoder, Encoder, PacketLayout};
use rhytid_shared::view::{JsonFrame, ViewHello};
use serde_json::{Value, json};
use small::{Glb, png, png_of};

fn zones(glb: &mut Glb) -> &mut Value {
    &mut glb.json["extensions"]["RHYTID_face"]["zones"]
}

/// As many zones in place of the two, and no table for them.
fn set_number(glb: &mut Glb, num: usize) {
    zones(glb)["list"] = (0..num).map(|i| json!({"name": format!("zone {i}")})).collect();
    zones(glb)["expressions"] = json!([]);
    zones(glb)["bridge"] = json!([]);
}

/// A PNG mask of four channels, the same everywhere.
fn mask(side: u32, texel: [u8; 4]) -> Vec<u8> {
    png_of(image::RgbaImage::from_pixel(side, side, image::Rgba(texel)))
}

#[track_caller]
fn assert_refused(breaking: impl FnOnce(&mut Glb), parts: &[&str]) {
    let mut glb = Glb::small_character().with_zones();
    breaking(&mut glb);
    let message = Character::from_glb(&glb.to_bytes()).expect_err("a broken file is refused").to_string();
    assert_eq!(message.lines().count(), 1, "{message}");
    for part in parts {
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    }
}

#[test]
fn zones_are_read_as_they_are_written() {
    let character = Character::from_glb(&Glb::small_character().with_zones().to_bytes()).unwrap();
    let zones = character.zones.as_ref().unwrap();
    let zone = |name: &str, side| Zone { name: name.to_owned(), side: Some(side) };
    assert_eq!(zones.list, [zone("red", Side::Left), zone("green", Side::Right)]);
    assert_eq!((zones.masks.as_slice(), zones.map), (&[1][..], ZoneMap { texture: 2, scale: 0.5 }));
    assert_eq!((zones.stretch, zones.difference, zones.wavelength), (None, None, 0.006));
    assert_eq!(zones.expressions[1], Expression { name: "anger".to_owned(), weights: vec![-0.6, -0.6] });
    assert_eq!(zones.bridge, [BridgeRow { pose: 0, bone: 0, zone: 0, gain: 0.5 }]);
    assert_eq!((zones.expression_index("surprise"), zones.expression_index("joy")), (Some(0), None));
    assert!(Character::from_glb(&Glb::small_character().to_bytes()).unwrap().zones.is_none());
}

#[test]
fn eight_zones_with_every_map() {
    let mut glb = Glb::small_character().with_zones();
    let masks = [glb.texture(&mask(64, [32, 32, 32, 32])), glb.texture(&mask(64, [32, 32, 32, 31]))];
    let maps = [0; 3].map(|_| glb.texture(&png(256, 256)));
    *zones(&mut glb) = json!({
        "list": (0..8).map(|i| json!({"name": format!("zone {i}")})).collect::<Vec<_>>(),
        "masks": masks, "map": {"texture": maps[0], "scale": 0.6}, "stretch": {"texture": maps[1], "scale": 0.2},
        "difference": maps[2], "wavelength": 0.004, "extra": 1,
    });
    let character = Character::from_glb(&glb.to_bytes()).unwrap();
    let zones = character.zones.as_ref().unwrap();
    assert_eq!((character.num_zones(), zones.list[7].side, zones.expressions.len()), (8, None, 0));
    assert_eq!((zones.stretch.map(|map| map.texture), zones.difference), (Some(maps[1]), Some(maps[2])));
}

#[test]
fn lists_of_the_wrong_length_or_with_bad_names() {
    assert_refused(|glb| zones(glb)["list"] = json!([]), &["zones.list", "has 0 zones, expected 1 to 8"]);
    let nine: Vec<Value> = (0..9).map(|i| json!({"name": format!("zone {i}")})).collect();
    assert_refused(|glb| zones(glb)["list"] = json!(nine), &["zones.list", "has 9 zones"]);
    assert_refused(|glb| zones(glb)["list"][1]["name"] = json!("red"), &["zones.list[1].name", "\"red\"", "unique"]);
    assert_refused(|glb| zones(glb)["list"][0]["name"] = json!(""), &["zones.list[0].name", "1 to 64 bytes"]);
    assert_refused(|glb| zones(glb)["list"][0]["side"] = json!("top"), &["RHYTID_face", "top", "left", "right"]);
    assert_refused(|glb| zones(glb)["masks"] = json!([]), &["zones.masks", "has 0 textures, expected 1"]);
    assert_refused(|glb| zones(glb)["masks"] = json!([1, 1]), &["zones.masks", "has 2 textures, expected 1"]);
    let rows: Vec<Value> = (0..17).map(|i| json!({"name": format!("row {i}"), "weights": [0, 0]})).collect();
    assert_refused(|glb| zones(glb)["expressions"] = json!(rows), &["zones.expressions", "has 17 rows, at most 16"]);
    assert_refused(|glb| zones(glb)["expressions"][1]["name"] = json!("surprise"), &["zones.expressions[1].name", "unique"]);
    let row = json!({"pose": "up", "bone": "brow_l", "zone": "red", "gain": 0.0});
    assert_refused(|glb| zones(glb)["bridge"] = json!(vec![row; 513]), &["zones.bridge", "has 513 rows, at most 512"]);
}

#[test]
fn weights_and_scales_out_of_range() {
    assert_refused(
        |glb| zones(glb)["expressions"][0]["weights"] = json!([0.5]),
        &["zones.expressions[0].weights", "has 1 values, expected 2, one a zone"],
    );
    for weight in [2.5, -2.01, 1e30] {
        assert_refused(
            |glb| zones(glb)["expressions"][1]["weights"][1] = json!(weight),
            &["zones.expressions[1].weights[1]", "finite and within ±2"],
        );
        assert_refused(|glb| zones(glb)["bridge"][0]["gain"] = json!(weight), &["zones.bridge[0].gain", "within ±2"]);
    }
    for scale in [0.0, -1.0, 4.5] {
        assert_refused(|glb| zones(glb)["map"]["scale"] = json!(scale), &["zones.map.scale", "more than 0 and at most 4"]);
        assert_refused(|glb| zones(glb)["stretch"] = json!({"texture": 2, "scale": scale}), &["zones.stretch.scale"]);
    }
    for wavelength in [0.0, 6.0, -0.006] {
        assert_refused(|glb| zones(glb)["wavelength"] = json!(wavelength), &["zones.wavelength", "expected metres from 0.0005 to 0.05"]);
    }
}

#[test]
fn names_the_character_does_not_have() {
    for part in ["pose", "bone", "zone"] {
        assert_refused(
            |glb| zones(glb)["bridge"][0][part] = json!("toe"),
            &[&format!("zones.bridge[0].{part}"), "\"toe\"", &format!("no {part} of this character")],
        );
    }
}

#[test]
fn images_that_are_not_there_or_of_the_wrong_size() {
    for (path, value) in [
        ("masks", json!([9])),
        ("map", json!({"texture": 9, "scale": 1})),
        ("stretch", json!({"texture": 9, "scale": 1})),
        ("difference", json!(9)),
    ] {
        assert_refused(|glb| zones(glb)[path] = value, &[&format!("zones.{path}"), "is 9, but there are 3 textures"]);
    }
    let with_texture = |png: Vec<u8>, path: &'static str| {
        move |glb: &mut Glb| {
            let texture = glb.texture(&png);
            *zones(glb).pointer_mut(path).unwrap() = json!(texture);
        }
    };
    assert_refused(with_texture(mask(48, [0; 4]), "/masks/0"), &["zones.masks[0]", "48 x 48", "power of two a side, 4 to 256"]);
    assert_refused(with_texture(mask(512, [0; 4]), "/masks/0"), &["zones.masks[0]", "512 x 512"]);
    assert_refused(with_texture(png(64, 32), "/masks/0"), &["zones.masks[0]", "64 x 32"]);
    assert_refused(with_texture(png(2048, 2048), "/map/texture"), &["zones.map.texture", "2048 x 2048", "4 to 1024"]);
    assert_refused(with_texture(png(16, 8), "/map/texture"), &["zones.map.texture", "16 x 8"]);
    for field in ["stretch", "difference"] {
        assert_refused(
            |glb| {
                let texture = glb.texture(&png(8, 8));
                zones(glb)[field] = if field == "stretch" { json!({"texture": texture, "scale": 1}) } else { json!(texture) };
            },
            &[&format!("zones.{field}"), "is 8 x 8, expected 4 x 4 as the zones' wrinkle map"],
        );
    }
    assert_refused(
        |glb| {
            let second = glb.texture(&mask(8, [0; 4]));
            set_number(glb, 5);
            let first = glb.texture(&mask(4, [0; 4]));
            zones(glb)["masks"] = json!([first, second]);
        },
        &["zones.masks[1]", "is 8 x 8, expected 4 x 4 as the first mask"],
    );
}

#[test]
fn masks_that_cannot_hold_their_zones() {
    // Half a code a zone is rounding, more is not; channels of no zone do not count.
    let with_mask = |texel: [u8; 4]| {
        move |glb: &mut Glb| {
            let texture = glb.texture(&mask(4, texel));
            zones(glb)["masks"] = json!([texture]);
        }
    };
    let mut glb = Glb::small_character().with_zones();
    with_mask([128, 128, 255, 255])(&mut glb);
    Character::from_glb(&glb.to_bytes()).unwrap();
    assert_refused(with_mask([128, 129, 0, 0]), &["zones.masks", "sum to 1.008 over all zones at texel (0, 0), expected at most 1"]);
    assert_refused(
        |glb| {
            set_number(glb, 4);
            zones(glb)["masks"] = json!([2]);
        },
        &["zones.masks[0]", "no alpha channel, expected RGBA"],
    );
    assert_refused(
        |glb| {
            let mut jpeg = std::io::Cursor::new(Vec::new());
            image::RgbImage::new(4, 4).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
            let texture = glb.texture(&jpeg.into_inner());
            zones(glb)["masks"] = json!([texture]);
        },
        &["zones.masks[0]", "is no PNG"],
    );
}

#[test]
fn zones_travel_in_packets_and_stand_in_the_hello() {
    let character = Character::from_glb(&Glb::small_character().with_zones().to_bytes()).unwrap();
    let hello = ViewHello::new("demo", &character, String::new()).character;
    assert_eq!(hello.zones, ["red", "green"]);
    let mut encoder = Encoder::new(&character);
    let mut decoder = Decoder::new(PacketLayout::try_from(&hello).unwrap());
    let (mut packet, mut got) = (Vec::new(), rhytid_shared::FaceFrame::at_rest(&character));
    for seq in 0..30 {
        let mut frame = rhytid_shared::FaceFrame { seq, ..rhytid_shared::FaceFrame::at_rest(&character) };
        frame.captured_at_micros = u64::from(seq) * 40_000;
        if seq > 0 {
            frame.zones = vec![seq as f32 / 30.0, 0.0];
            frame.stretched = vec![0.0, 1.0 - seq as f32 / 30.0];
        }
        encoder.encode(&frame, &mut packet);
        decoder.decode(&packet, &mut got).unwrap();
        for (got, want) in got.zones.iter().chain(&got.stretched).zip(frame.zones.iter().chain(&frame.stretched)) {
            assert!((got - want).abs() <= 0.5 / 255.0 + 1e-6, "{got} was {want}");
        }
    }
    let json = serde_json::to_value(JsonFrame::new(&got, &hello)).unwrap();
    assert_eq!((json["zones"].as_array().unwrap().len(), json["stretched"].as_array().unwrap().len()), (2, 2));
}
