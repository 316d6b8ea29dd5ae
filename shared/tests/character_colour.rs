//! Colour that follows the face in a character file: read as it is written, and each mistake refused with its field.

#![allow(clippy::unwrap_used, reason = "a test file: what it unwraps is the small character's own structure")]

mod small;

use rhytid_shared::Character;
use rhytid_shared::character::{Colour, ColourChange, ColourDriver};
use serde_json::{Value, json};
use small::{Glb, png};

fn colour(glb: &mut Glb) -> &mut Value {
    &mut glb.json["extensions"]["RHYTID_face"]["colour"]
}

#[track_caller]
fn assert_refused(breaking: impl FnOnce(&mut Glb), parts: &[&str]) {
    let mut glb = Glb::small_character().with_colour();
    breaking(&mut glb);
    let message = Character::from_glb(&glb.to_bytes()).expect_err("a broken file is refused").to_string();
    assert_eq!(message.lines().count(), 1, "{message}");
    for part in parts {
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    }
}

#[test]
fn colour_is_read_as_it_is_written() {
    let character = Character::from_glb(&Glb::small_character().with_colour().to_bytes()).unwrap();
    let change = ColourChange { driver: ColourDriver::Pose(0), texture: 2, spread: 0.5, shift: 0.3 };
    assert_eq!(character.colour, Some(Colour { base: 1, most: 2.0, changes: vec![change], strength: 1.0 }));
    assert!(Character::from_glb(&Glb::small_character().to_bytes()).unwrap().colour.is_none());
}

#[test]
fn numbers_that_cannot_be_amounts_of_blood() {
    for (most, said) in [(0.0, "is 0, expected more than 0 and at most 5"), (-1.0, "is -1"), (5.5, "is 5.5")] {
        assert_refused(|glb| colour(glb)["most"] = json!(most), &["colour.most", said]);
    }
    assert_refused(|glb| colour(glb)["strength"] = json!(-0.5), &["colour.strength", "is -0.5, expected 0 to 4"]);
    assert_refused(|glb| colour(glb)["changes"][0]["spread"] = json!(0.0), &["colour.changes[0].spread", "is 0, expected more than 0"]);
    assert_refused(|glb| colour(glb)["changes"][0]["shift"] = json!(2.5), &["colour.changes[0].shift", "is 2.5", "at most 2"]);
}

#[test]
fn poses_that_are_not_there_or_named_twice() {
    assert_refused(|glb| colour(glb)["changes"][0]["pose"] = json!("down"), &["colour.changes[0].pose", "\"down\", which is no pose"]);
    let twice = |glb: &mut Glb| {
        let change = colour(glb)["changes"][0].clone();
        colour(glb)["changes"] = json!([change.clone(), change]);
    };
    assert_refused(twice, &["colour.changes[1].pose", "\"up\", which has its change already"]);
}

#[test]
fn zones_drive_it_in_place_of_poses() {
    let mut glb = Glb::small_character().with_zones().with_colour();
    let zone = glb.json["extensions"]["RHYTID_face"]["zones"]["list"][0]["name"].clone();
    let change = &mut colour(&mut glb)["changes"][0];
    change.as_object_mut().unwrap().remove("pose");
    change["zone"] = zone;
    let read = Character::from_glb(&glb.to_bytes()).unwrap().colour.unwrap();
    assert_eq!(read.changes[0].driver, ColourDriver::Zone(0));
    assert_refused(|glb| colour(glb)["changes"][0]["zone"] = json!("red"), &["colour.changes[0]", "expected one of both"]);
    assert_refused(|glb| drop(colour(glb)["changes"][0].as_object_mut().unwrap().remove("pose")), &["colour.changes[0]", "neither"]);
    let nowhere = |glb: &mut Glb| {
        colour(glb)["changes"][0].as_object_mut().unwrap().remove("pose");
        colour(glb)["changes"][0]["zone"] = json!("nowhere");
    };
    assert_refused(nowhere, &["colour.changes[0].zone", "\"nowhere\", which is no zone"]);
}

#[test]
fn maps_of_the_wrong_size_or_kind() {
    let with_base = |picture: Vec<u8>| {
        move |glb: &mut Glb| {
            let texture = glb.texture(&picture);
            colour(glb)["base"] = json!(texture);
        }
    };
    assert_refused(with_base(png(48, 48)), &["colour.base", "48 x 48", "power of two a side, 4 to 128"]);
    assert_refused(with_base(png(256, 256)), &["colour.base", "256 x 256"]);
    assert_refused(with_base(png(8, 4)), &["colour.base", "8 x 4"]);
    assert_refused(with_base(png(16, 16)), &["colour.changes[0].texture", "is 8 x 8, expected 16 x 16 as the base"]);
    assert_refused(|glb| colour(glb)["base"] = json!(9), &["colour.base", "is 9, but there are 3 textures"]);
    let mut jpeg = std::io::Cursor::new(Vec::new());
    image::DynamicImage::new_rgb8(8, 8).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
    assert_refused(with_base(jpeg.into_inner()), &["colour.base", "is no PNG"]);
}
