//! The raw data of VTube Studio's phone app (and of MeowFace, which speaks the same): one JSON object a datagram, for as many
//! seconds as a [`request`] asks for.
//!
//! Degrees; the axes are taken to be those of the gaze shapes that come along (down and to the performer's left are positive). The
//! place of the head has no documented unit; it is taken for centimetres.

use super::eyes::{EyeTurn, write_gaze};
use super::{Refusal, Seen, SeenWeights, Sight, WeightSheet, position, rotation, turns};
use glam::{Quat, Vec3};
use rhytid_shared::limits::MAX_SECONDS;
use rhytid_shared::{ARKIT_NAMES, NUM_ARKIT_SHAPES};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// Largest datagram, bytes: 52 shapes take some 3,000.
pub const LARGEST: usize = 16 << 10;
/// Seconds that a request asks for; it is repeated long before they are over.
const ASKED_SECONDS: f64 = 5.0;
/// Metres in a unit of the head's place.
const PLACE_UNIT: f32 = 0.01;

#[derive(Debug, Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Data<'a> {
    timestamp: Option<f64>,
    face_found: bool,
    rotation: Option<Vector>,
    position: Option<Vector>,
    eye_left: Option<Vector>,
    eye_right: Option<Vector>,
    #[serde(borrow, default)]
    blend_shapes: Vec<Value<'a>>,
}

#[derive(Debug, Clone, Copy, Deserialize, Serialize)]
struct Vector {
    x: f32,
    y: f32,
    z: f32,
}

#[derive(Debug, Deserialize, Serialize)]
struct Value<'a> {
    #[serde(borrow)]
    k: Cow<'a, str>,
    v: f32,
}

/// Reads a datagram.
pub fn parse(bytes: &[u8]) -> Result<Seen, Refusal> {
    if bytes.len() > LARGEST {
        return Err(Refusal::TooLong);
    }
    let data: Data<'_> =
        serde_json::from_slice(bytes).map_err(|error| if error.is_eof() { Refusal::Truncated } else { Refusal::Malformed })?;
    let time = data.timestamp.map(|millis| millis / 1000.0);
    if time.is_some_and(|time| !(0.0..=MAX_SECONDS).contains(&time)) {
        return Err(Refusal::OutOfRange);
    }
    let seen = |sight| Seen { performer: String::new(), subject: String::new(), time, sight };
    if !data.face_found {
        return Ok(seen(Sight::NoFace));
    }
    let mut sheet = WeightSheet::new();
    for value in &data.blend_shapes {
        sheet.set(&value.k, value.v)?;
    }
    if sheet.num_known == 0 {
        return Err(Refusal::NoContent);
    }
    let turn = |vector: Vector| rotation(vector.x.to_radians(), vector.y.to_radians(), vector.z.to_radians());
    if let (Some(left), Some(right), false) = (data.eye_left, data.eye_right, sheet.has_gaze) {
        turn(left)?;
        turn(right)?;
        write_gaze([left, right].map(|eye| EyeTurn { pitch: eye.x.to_radians(), yaw: eye.y.to_radians() }), &mut sheet.weights);
    }
    Ok(seen(Sight::Weights(SeenWeights {
        weights: sheet.weights,
        head_rotation: data.rotation.map(turn).transpose()?,
        head_position: data.position.map(|place| position(Vec3::new(place.x, place.y, place.z) * PLACE_UNIT)).transpose()?,
    })))
}

/// What makes a phone send to `port`, for some seconds.
pub fn request(port: u16) -> Vec<u8> {
    serde_json::json!({ "messageType": "iOSTrackingDataRequest", "time": ASKED_SECONDS, "sentBy": "Rhytid", "ports": [port] })
        .to_string()
        .into_bytes()
}

/// The ports that a request asks for, and for how many seconds.
pub fn read_request(bytes: &[u8]) -> Option<(Vec<u16>, f64)> {
    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Request<'a> {
        message_type: &'a str,
        time: f64,
        ports: Vec<u16>,
    }
    let request: Request<'_> = serde_json::from_slice(bytes).ok()?;
    let is_sound = request.message_type == "iOSTrackingDataRequest" && (0.5..=10.0).contains(&request.time);
    (is_sound && (1..=32).contains(&request.ports.len())).then_some((request.ports, request.time))
}

/// Writes a datagram: a face, or nobody.
pub fn write(millis: u64, face: Option<(&[f32; NUM_ARKIT_SHAPES], Quat, Vec3)>) -> Vec<u8> {
    let vector = |[x, y, z]: [f32; 3]| serde_json::json!({ "x": x, "y": y, "z": z });
    let (head, place) = face.map_or((Quat::IDENTITY, Vec3::ZERO), |(_, head, place)| (head, place));
    let eyes = face.map_or_else(Default::default, |(weights, ..)| super::eyes::read_gaze(weights));
    let eye = |eye: EyeTurn| vector([eye.pitch.to_degrees(), eye.yaw.to_degrees(), 0.0]);
    // In PascalCase, as the iPhone's.
    let name = |name: &str| name[..1].to_ascii_uppercase() + &name[1..];
    let values: Vec<Value<'_>> = face
        .iter()
        .flat_map(|(weights, ..)| ARKIT_NAMES.iter().zip(weights.iter()))
        .map(|(known, weight)| Value { k: name(known).into(), v: *weight })
        .collect();
    serde_json::json!({
        "Timestamp": millis,
        "Hotkey": -1,
        "FaceFound": face.is_some(),
        "Rotation": vector(turns(head).map(f32::to_degrees)),
        "Position": vector((place / PLACE_UNIT).to_array()),
        "EyeLeft": eye(eyes[0]),
        "EyeRight": eye(eyes[1]),
        "BlendShapes": values,
    })
    .to_string()
    .into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::ArkitShape;

    const DATA: &str = r#"{"Timestamp":1664817520079,"Hotkey":-1,"FaceFound":true,"Rotation":{"x":-11.0,"y":9.4,"z":3.1},
        "Position":{"x":0.46,"y":1.31,"z":4.73},"EyeLeft":{"x":3.5,"y":9.0,"z":0.5},"EyeRight":{"x":3.4,"y":12.8,"z":0.7},
        "Extra":[1],"BlendShapes":[{"k":"EyeBlinkRight","v":0.25},{"k":"eyeWide_R","v":0.5},{"k":"Unknown","v":99}]}"#;

    #[test]
    fn names_of_iphone_and_android_are_read() {
        let seen = parse(DATA.as_bytes()).unwrap();
        assert_eq!(seen.time, Some(1_664_817_520.079));
        let Sight::Weights(seen) = seen.sight else { panic!("a face") };
        let of = |name| seen.weights[ArkitShape::from_name(name).unwrap().index()];
        assert_eq!((of("eyeBlinkRight"), of("eyeWideRight")), (0.25, 0.5));
        assert!(of("eyeLookOutLeft") > 0.2 && of("eyeLookInRight") > 0.3 && of("eyeLookInLeft") == 0.0, "from the eyes");
        let nose = seen.head_rotation.unwrap() * Vec3::Z;
        assert!(nose.y > 0.1 && nose.x > 0.1, "{nose}");
        assert!((seen.head_position.unwrap() - Vec3::new(0.0046, 0.0131, 0.0473)).length() < 1e-6);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let with = |from: &str, to: &str| parse(DATA.replacen(from, to, 1).as_bytes()).unwrap_err();
        assert_eq!(with("0.25", "1e39"), Refusal::Malformed);
        assert_eq!(with("0.25", "NaN"), Refusal::Malformed);
        assert_eq!(with("0.25", "90"), Refusal::OutOfRange);
        assert_eq!(with("-11.0", "9000"), Refusal::OutOfRange);
        assert_eq!(with("1664817520079", "-5"), Refusal::OutOfRange);
        assert_eq!(with("\"FaceFound\":true,", ""), Refusal::Malformed);
        assert_eq!(with("\"BlendShapes\"", "\"Shapes\""), Refusal::NoContent);
        assert_eq!(parse(&DATA.as_bytes()[..300]), Err(Refusal::Truncated));
        assert_eq!(parse("[".repeat(9000).as_bytes()), Err(Refusal::Malformed), "deep nesting overflows nothing");
        assert_eq!(parse(&vec![b' '; LARGEST + 1]), Err(Refusal::TooLong));
        assert_eq!(parse(b"{\"FaceFound\":false}").unwrap().sight, Sight::NoFace);
    }

    #[test]
    fn what_is_written_is_read() {
        let weights = std::array::from_fn(|i| i as f32 / 64.0);
        let head = rotation(0.2, -0.1, 0.05).unwrap();
        let seen = parse(&write(2500, Some((&weights, head, Vec3::new(0.01, 0.02, -0.03))))).unwrap();
        assert_eq!(seen.time, Some(2.5));
        let Sight::Weights(seen) = seen.sight else { panic!("a face") };
        assert_eq!(*seen.weights, weights);
        assert!(seen.head_rotation.unwrap().abs_diff_eq(head, 1e-5));
        assert!((seen.head_position.unwrap() - Vec3::new(0.01, 0.02, -0.03)).length() < 1e-5);
        assert_eq!(parse(&write(2500, None)).unwrap().sight, Sight::NoFace);
        assert_eq!(read_request(&request(21412)), Some((vec![21412], ASKED_SECONDS)));
    }
}
