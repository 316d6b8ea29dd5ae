//! The text of iFacialMocap and Facemotion3d, versions 1 and 2.
//!
//! ```text
//! name-17|name-3|…|=head#rx,ry,rz,px,py,pz|rightEye#rx,ry,rz|leftEye#rx,ry,rz|        version 1; 2 and Facemotion3d: name&17
//! ```
//! Percent, degrees and metres, in any order, with whatever unknown tokens among them. The phone starts when it is told to, by
//! [`hello`] sent to its port. The axes are ARKit's, which are Rhytid's (the eyes of real datagrams turn as their gaze shapes say).

use super::eyes::{EyeTurn, read_gaze, write_gaze};
use super::{Refusal, Seen, SeenWeights, Sight, WeightSheet, position, rotation, turns};
use glam::{Quat, Vec3};
use rhytid_shared::{ARKIT_NAMES, NUM_ARKIT_SHAPES};
use std::fmt::Write;

/// Largest datagram, bytes: one of 52 shapes takes 1,100, Facemotion3d has some more.
pub const LARGEST: usize = 8192;
/// Shapes that a text without a head must have: the tail may be missing, but what was cut among the shapes would put the rest
/// of the face to rest.
const FEWEST_ALONE: usize = 40;
/// The text that starts iFacialMocap.
const HELLO: &str = "iFacialMocap_sahuasouryya9218sauhuiayeta91555dy3719";
/// The text that starts and the one that stops Facemotion3d.
const FACEMOTION_HELLO: &str = "FACEMOTION3D_OtherStreaming";
const FACEMOTION_STOP: &str = "StopStreaming_FACEMOTION3D";

/// What a phone is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dialect {
    /// iFacialMocap, version 1.
    V1,
    /// iFacialMocap, version 2, whose values may be negative.
    V2,
    /// Facemotion3d.
    Facemotion3d,
}

/// What starts a phone, sent to its port.
pub fn hello(dialect: Dialect) -> Vec<u8> {
    match dialect {
        Dialect::V1 => HELLO.into(),
        Dialect::V2 => format!("{HELLO}|sendDataVersion=v2").into(),
        Dialect::Facemotion3d => FACEMOTION_HELLO.into(),
    }
}

/// What stops a phone, where anything does.
pub fn stop(dialect: Dialect) -> Option<&'static [u8]> {
    (dialect == Dialect::Facemotion3d).then_some(FACEMOTION_STOP.as_bytes())
}

/// The dialect that a phone is asked for by `bytes`.
pub fn read_hello(bytes: &[u8]) -> Option<Dialect> {
    [Dialect::V1, Dialect::V2, Dialect::Facemotion3d].into_iter().find(|dialect| hello(*dialect) == bytes)
}

/// Reads a datagram.
pub fn parse(bytes: &[u8]) -> Result<Seen, Refusal> {
    if bytes.len() > LARGEST {
        return Err(Refusal::TooLong);
    }
    let text = std::str::from_utf8(bytes).map_err(|_| Refusal::Malformed)?;
    let mut sheet = WeightSheet::new();
    let (mut is_tracking, mut has_head, mut head, mut eyes) = (true, false, None, [None; 2]);
    // Streams exist with "…|=head#…", "…=head#…" and "…|=|head#…".
    let mut tokens = text.split(['|', '=']).map(str::trim).filter(|token| !token.is_empty()).peekable();
    while let Some(token) = tokens.next() {
        let is_last = tokens.peek().is_none();
        let read = match token.split_once('#') {
            Some(("head", values)) => {
                has_head = true;
                numbers::<6>(values).map(|values| head = values.or(head))
            }
            Some(("leftEye", values)) => numbers::<3>(values).map(|values| eyes[0] = values.or(eyes[0])),
            Some(("rightEye", values)) => numbers::<3>(values).map(|values| eyes[1] = values.or(eyes[1])),
            // Bones and names of other programs.
            Some(_) => Ok(()),
            None => shape(token, &mut sheet, &mut is_tracking),
        };
        match read {
            // The end of a text may be missing.
            Err(Refusal::Malformed) if is_last => {}
            read => read?,
        }
    }
    if !is_tracking {
        return Ok(Seen { performer: String::new(), subject: String::new(), time: None, sight: Sight::NoFace });
    }
    if sheet.num_known == 0 {
        return Err(Refusal::NoContent);
    }
    if !has_head && sheet.num_known < FEWEST_ALONE {
        return Err(Refusal::Malformed);
    }
    let pose = head.map(|[x, y, z, right, up, front]: [f32; 6]| {
        Ok((rotation(x.to_radians(), y.to_radians(), z.to_radians())?, position(Vec3::new(right, up, front))?))
    });
    let (head_rotation, head_position) = pose.transpose()?.unzip();
    if let ([Some(left), Some(right)], false) = (eyes, sheet.has_gaze) {
        write_gaze([left, right].map(|[x, y, _]: [f32; 3]| EyeTurn { pitch: x.to_radians(), yaw: y.to_radians() }), &mut sheet.weights);
    }
    let sight = Sight::Weights(SeenWeights { weights: sheet.weights, head_rotation, head_position });
    Ok(Seen { performer: String::new(), subject: String::new(), time: None, sight })
}

/// Reads `name-17` or `name&17`.
fn shape(token: &str, sheet: &mut WeightSheet, is_tracking: &mut bool) -> Result<(), Refusal> {
    let at = token.find('&').or_else(|| token.find('-'));
    let Some((name, value)) = at.map(|at| (&token[..at], &token[at + 1..])) else { return Ok(()) };
    if name == "trackingStatus" {
        *is_tracking = value != "0";
        return Ok(());
    }
    match value.parse::<f32>() {
        Ok(percent) => sheet.set(name, percent / 100.0).map(|_| ()),
        Err(_) if rhytid_shared::ArkitShape::from_name(name).is_some() => Err(Refusal::Malformed),
        Err(_) => Ok(()),
    }
}

/// Numbers with commas between them: all `N`, or (for a head without a place) the first three.
fn numbers<const N: usize>(text: &str) -> Result<Option<[f32; N]>, Refusal> {
    let mut values = [0.0; N];
    let mut count = 0;
    for part in text.split(',').map(str::trim).filter(|part| !part.is_empty()) {
        let value: f32 = part.parse().map_err(|_| Refusal::Malformed)?;
        if !value.is_finite() {
            return Err(Refusal::NotFinite);
        }
        *values.get_mut(count).ok_or(Refusal::Malformed)? = value;
        count += 1;
    }
    if count == N || count == 3 { Ok(Some(values)) } else { Err(Refusal::Malformed) }
}

/// Writes a datagram of a face.
pub fn write(dialect: Dialect, weights: &[f32; NUM_ARKIT_SHAPES], head: Quat, place: Vec3) -> Vec<u8> {
    let mut text = String::with_capacity(1600);
    let separator = if dialect == Dialect::V1 { '-' } else { '&' };
    let mut put = |arguments: std::fmt::Arguments<'_>| text.write_fmt(arguments).expect("writing to a String cannot fail");
    for (name, weight) in ARKIT_NAMES.iter().zip(weights) {
        let percent = (weight * 100.0).round() as i32;
        let has_sides = !matches!(*name, "jawLeft" | "jawRight" | "mouthLeft" | "mouthRight");
        match (name.strip_suffix("Left"), name.strip_suffix("Right")) {
            _ if dialect == Dialect::Facemotion3d || !has_sides => put(format_args!("{name}{separator}{percent}|")),
            (Some(stem), _) => put(format_args!("{stem}_L{separator}{percent}|")),
            (_, Some(stem)) => put(format_args!("{stem}_R{separator}{percent}|")),
            _ => put(format_args!("{name}{separator}{percent}|")),
        }
    }
    let [pitch, yaw, roll] = turns(head).map(f32::to_degrees);
    put(format_args!("hapihapi{separator}0|=head#{pitch},{yaw},{roll},{},{},{}|", place.x, place.y, place.z));
    let [left, right] = read_gaze(weights);
    put(format_args!("rightEye#{},{},0|", right.pitch.to_degrees(), right.yaw.to_degrees()));
    put(format_args!("leftEye#{},{},0|", left.pitch.to_degrees(), left.yaw.to_degrees()));
    text.into_bytes()
}

/// Writes a datagram of nobody.
pub fn write_no_face(dialect: Dialect) -> Vec<u8> {
    if dialect == Dialect::V1 { b"trackingStatus-0|".to_vec() } else { b"trackingStatus&0|".to_vec() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::ArkitShape;

    fn weights_of(text: &str) -> SeenWeights {
        match parse(text.as_bytes()).unwrap().sight {
            Sight::Weights(seen) => seen,
            other => panic!("{other:?}"),
        }
    }

    fn of(seen: &SeenWeights, name: &str) -> f32 {
        seen.weights[ArkitShape::from_name(name).unwrap().index()]
    }

    #[test]
    fn both_versions_and_their_ways_to_set_off_the_head_are_read() {
        for text in [
            "mouthSmile_R-32|eyeBlink_L-5|trackingStatus-1|=|head#28,-2.5,-6,-0.03,-0.1,-0.65|rightEye#6,2,0|leftEye#6,-1.6,-0.1|",
            "trackingStatus-1|mouthSmile_R-32|eyeBlink_L-5|hapihapi-0|=head#28,-2.5,-6,-0.03,-0.1,-0.65|rightEye#6,2,0|leftEye#6,-1.6,-0.1",
            "mouthSmileRight&32|FM_thing&7|eyeBlinkLeft&5=head#28,-2.5,-6,-0.03,-0.1,-0.65|rightEye#6,2,0|leftEye#6,-1.6,-0.1|garbage",
        ] {
            let seen = weights_of(text);
            assert_eq!((of(&seen, "mouthSmileRight"), of(&seen, "eyeBlinkLeft")), (0.32, 0.05), "{text}");
            assert_eq!(seen.head_position, Some(Vec3::new(-0.03, -0.1, -0.65)), "{text}");
            let nose = seen.head_rotation.unwrap() * Vec3::Z;
            assert!(nose.y < -0.4 && nose.x < 0.0, "down and to the performer's right: {nose}");
            // No gaze shapes: the eyes say where they look, to the performer's left the right one, to the right the left one.
            assert!(of(&seen, "eyeLookInRight") > 0.05 && of(&seen, "eyeLookInLeft") > 0.04 && of(&seen, "eyeLookDownLeft") > 0.1);
        }
    }

    #[test]
    fn gaze_shapes_count_before_eye_bones() {
        let seen = weights_of("eyeLookOut_L-44|=head#0,0,0|rightEye#5,19,1|leftEye#5,15,1|");
        assert_eq!((of(&seen, "eyeLookOutLeft"), of(&seen, "eyeLookDownLeft")), (0.44, 0.0));
        assert_eq!(seen.head_position, Some(Vec3::ZERO), "a head without a place has one that never moves");
    }

    #[test]
    fn nobody_and_a_missing_tail_are_no_errors() {
        assert_eq!(parse(b"jawOpen-10|trackingStatus-0|").unwrap().sight, Sight::NoFace);
        let seen = weights_of("jawOpen-10|jawLeft-3|=head#1,2");
        assert_eq!((of(&seen, "jawOpen"), seen.head_rotation), (0.1, None));
        assert_eq!(of(&weights_of("jawOpen&-3|mouthClose&7|=head#0,0,0"), "jawOpen"), 0.0);
        // Without its head a text still has its shapes; one that ends among them would put the others to rest.
        let whole = String::from_utf8(write(Dialect::V1, &[0.1; NUM_ARKIT_SHAPES], Quat::IDENTITY, Vec3::ZERO)).unwrap();
        assert_eq!(of(&weights_of(whole.split('=').next().unwrap()), "jawOpen"), 0.1);
        assert_eq!(parse(&whole.as_bytes()[..whole.len() / 2]), Err(Refusal::Malformed));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, refusal) in [
            (&b""[..], Refusal::NoContent),
            (b"fooBar-20|", Refusal::NoContent),
            (b"jawOpen-x|mouthClose-3", Refusal::Malformed),
            (b"jawOpen-NaN|", Refusal::NotFinite),
            (b"jawOpen-5000|", Refusal::OutOfRange),
            (b"jawOpen-1|=head#1,2,3,4,inf,6|", Refusal::NotFinite),
            (b"jawOpen-1|=head#1,2,3,4|leftEye#1,2,3", Refusal::Malformed),
            (b"jawOpen-1|=head#1000,0,0|", Refusal::OutOfRange),
            (b"jawOpen-1|\xff", Refusal::Malformed),
        ] {
            assert_eq!(parse(text), Err(refusal), "{}", String::from_utf8_lossy(text));
        }
        assert_eq!(parse(&vec![b'|'; LARGEST + 1]), Err(Refusal::TooLong));
    }

    #[test]
    fn what_is_written_is_read() {
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        for (i, weight) in weights.iter_mut().enumerate() {
            *weight = i as f32 / 100.0;
        }
        let head = rotation(0.2, -0.1, 0.05).unwrap();
        for dialect in [Dialect::V1, Dialect::V2, Dialect::Facemotion3d] {
            let bytes = write(dialect, &weights, head, Vec3::new(0.1, 0.0, -0.5));
            let Sight::Weights(seen) = parse(&bytes).unwrap().sight else { panic!("a face") };
            assert!(seen.weights.iter().zip(&weights).all(|(a, b)| (a - b).abs() < 1e-6));
            assert!(seen.head_rotation.unwrap().abs_diff_eq(head, 1e-5));
            assert_eq!(parse(&write_no_face(dialect)).unwrap().sight, Sight::NoFace);
            assert_eq!(read_hello(&hello(dialect)), Some(dialect));
        }
        let text = String::from_utf8(write(Dialect::V1, &weights, head, Vec3::ZERO)).unwrap();
        assert!(text.contains("eyeBlink_L-0|") && text.contains("jawLeft-15|") && text.contains("|=head#"), "{text}");
    }
}
