//! The binary form of a landmark frame: 478 points with depth take 2,896 bytes instead of 35 KB of JSON. Little endian:
//!
//! | byte | type | meaning |
//! |---|---|---|
//! | 0 | u8 | kind, 1 |
//! | 1 | u8 | flags: bit 0 points have z, bit 1 confidences follow; the others 0 |
//! | 2 | u16 | count of points, that of the hello's layout |
//! | 4 | f64 | t, seconds on the sender's clock |
//! | 12 | 3 × f32 | origin x, y, z; z 0 where points have none |
//! | 24 | f32 | step, more than 0 |
//! | 28 | count × 2 or 3 u16 | each value is origin + step × number: pixels as in JSON, z in the unit of x |
//! | … | count × u8 | confidence × 255, with bit 1 |

use super::MessageError;
use super::values::MAX_PIXELS;
use crate::limits::MAX_FEATURE_POINTS;

/// The only kind there is.
const KIND: u8 = 1;
const HAS_Z: u8 = 1;
const HAS_CONFIDENCE: u8 = 2;
/// Bytes before the first point.
const HEAD: usize = 28;
/// Largest number of a coordinate.
const MOST: f64 = 65_535.0;

/// A frame's head, checked against the length of its message.
struct Head {
    has_z: bool,
    has_confidence: bool,
    count: usize,
    t: f64,
    origin: [f32; 3],
    step: f32,
}

/// Writes a landmark frame into `out`, which is emptied first. Coordinates are rounded to a step of their largest extent over
/// 65,535. `confidence` has one value a point or none.
pub fn encode_landmarks(t: f64, points: &[[f32; 3]], confidence: &[f32], out: &mut Vec<u8>) -> Result<(), MessageError> {
    out.clear();
    if points.is_empty() || points.len() > MAX_FEATURE_POINTS {
        let message = format!("frame has {} points, expected 1 to {MAX_FEATURE_POINTS}", points.len());
        return Err(MessageError::new("wrong_count", message));
    }
    if !confidence.is_empty() && confidence.len() != points.len() {
        let message = format!("frame has {} confidences, expected {}, one a landmark", confidence.len(), points.len());
        return Err(MessageError::new("wrong_count", message));
    }
    if let Some(i) = points.iter().position(|point| !point.iter().all(|value| f64::from(value.abs()) <= MAX_PIXELS)) {
        return Err(outside(i, points[i]));
    }
    let has_z = points.iter().any(|point| point[2] != 0.0);
    let num_axes = if has_z { 3 } else { 2 };
    let (mut origin, mut extent) = ([0.0_f32; 3], 0.0_f64);
    for axis in 0..num_axes {
        let (least, most) =
            points.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(least, most), p| (least.min(p[axis]), most.max(p[axis])));
        origin[axis] = least;
        extent = extent.max(f64::from(most) - f64::from(least));
    }
    // A little more than needed, so that the rounding of the step itself never asks for a number past the last.
    let step = ((extent / MOST) * (1.0 + 1e-6)).max(1e-9) as f32;
    out.push(KIND);
    out.push(if has_z { HAS_Z } else { 0 } | if confidence.is_empty() { 0 } else { HAS_CONFIDENCE });
    out.extend((points.len() as u16).to_le_bytes());
    out.extend(t.to_le_bytes());
    origin.iter().for_each(|value| out.extend(value.to_le_bytes()));
    out.extend(step.to_le_bytes());
    for point in points {
        for axis in 0..num_axes {
            let number = ((f64::from(point[axis]) - f64::from(origin[axis])) / f64::from(step) + 0.5).clamp(0.0, MOST);
            out.extend((number as u16).to_le_bytes());
        }
    }
    out.extend(confidence.iter().map(|value| (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8));
    Ok(())
}

/// Reads a frame of `expected` points into `points` and `confidence`, whose buffers are reused, and gives its time, which is not
/// checked. After an error they may hold anything.
pub(super) fn decode(bytes: &[u8], expected: usize, points: &mut Vec<[f32; 3]>, confidence: &mut Vec<f32>) -> Result<f64, MessageError> {
    let Head { has_z, has_confidence, count, t, origin, step } = head(bytes, expected)?;
    let num_axes = if has_z { 3 } else { 2 };
    let (coordinates, confidences) = bytes[HEAD..].split_at(2 * num_axes * count);
    let (origin, step) = (origin.map(f64::from), f64::from(step));
    points.clear();
    points.extend(coordinates.chunks_exact(2 * num_axes).map(|chunk| {
        let mut point = [0.0; 3];
        for (axis, pair) in chunk.chunks_exact(2).enumerate() {
            point[axis] = (origin[axis] + step * f64::from(u16::from_le_bytes([pair[0], pair[1]]))) as f32;
        }
        point
    }));
    // Each axis alone: an origin within the range says nothing of what a large step makes of it.
    if let Some(i) = points.iter().position(|point| !point.iter().all(|value| f64::from(value.abs()) <= MAX_PIXELS)) {
        return Err(outside(i, points[i]));
    }
    confidence.clear();
    if has_confidence {
        confidence.extend(confidences.iter().map(|value| f32::from(*value) / 255.0));
    }
    Ok(t)
}

fn head(bytes: &[u8], expected: usize) -> Result<Head, MessageError> {
    let Some(head) = bytes.first_chunk::<HEAD>() else {
        let message = format!("binary message has {} bytes, expected at least the {HEAD} of a frame's head", bytes.len());
        return Err(MessageError::new("wrong_length", message));
    };
    let refuse = |code, message| Err(MessageError::new(code, message));
    let float = |at: usize| f32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    if head[0] != KIND {
        return refuse("unknown_type", format!("field kind of a binary message is {}, expected {KIND}", head[0]));
    }
    let flags = head[1];
    if flags & !(HAS_Z | HAS_CONFIDENCE) != 0 {
        return refuse("out_of_range", format!("field flags is {flags:#04x}, expected bits 0 and 1 only"));
    }
    let (has_z, has_confidence) = (flags & HAS_Z != 0, flags & HAS_CONFIDENCE != 0);
    let count = usize::from(u16::from_le_bytes([head[2], head[3]]));
    if count != expected {
        return refuse("wrong_count", format!("field count is {count}, expected the {expected} points of the hello's layout"));
    }
    let wanted = HEAD + count * (if has_z { 6 } else { 4 } + usize::from(has_confidence));
    if bytes.len() != wanted {
        return refuse("wrong_length", format!("binary message has {} bytes, expected {wanted} for {count} points", bytes.len()));
    }
    let t = f64::from_le_bytes([head[4], head[5], head[6], head[7], head[8], head[9], head[10], head[11]]);
    let origin = [float(12), float(16), float(20)];
    if !origin.iter().all(|value| f64::from(value.abs()) <= MAX_PIXELS) {
        return refuse("out_of_range", format!("field origin is {origin:?}, expected pixels within ±{MAX_PIXELS}"));
    }
    if !has_z && origin[2] != 0.0 {
        return refuse("out_of_range", format!("field origin has z {}, expected 0 where points have none", origin[2]));
    }
    let step = float(24);
    if !(step > 0.0 && step.is_finite()) {
        return refuse("out_of_range", format!("field step is {step}, expected pixels, more than 0"));
    }
    Ok(Head { has_z, has_confidence, count, t, origin, step })
}

fn outside(i: usize, point: [f32; 3]) -> MessageError {
    MessageError::new("out_of_range", format!("field points[{i}] is {point:?}, expected pixels within ±{MAX_PIXELS}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    type Decoded = (f64, Vec<[f32; 3]>, Vec<f32>);

    fn decoded(bytes: &[u8], expected: usize) -> Result<Decoded, MessageError> {
        let (mut points, mut confidence) = (vec![[9.0; 3]; 3], vec![9.0; 3]);
        decode(bytes, expected, &mut points, &mut confidence).map(|t| (t, points, confidence))
    }

    fn sample() -> Vec<u8> {
        let mut bytes = Vec::new();
        encode_landmarks(1.5, &[[10.0, 20.0, -3.0], [600.0, 400.0, 30.0]], &[1.0, 0.2], &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn a_frame_has_the_bytes_the_table_says() {
        let bytes = sample();
        assert_eq!(bytes.len(), 28 + 2 * 6 + 2);
        assert_eq!(bytes[..12], [1, 3, 2, 0, 0, 0, 0, 0, 0, 0, 0xF8, 0x3F]);
        assert_eq!(bytes[12..24], [10.0_f32, 20.0, -3.0].map(f32::to_le_bytes).concat());
        // The first point is the origin; the farthest number along x is the last or next to it.
        assert_eq!(bytes[28..34], [0; 6]);
        assert!(u16::from_le_bytes([bytes[34], bytes[35]]) >= 65_534);
        assert_eq!(bytes[40..], [255, 51]);
        let mut mesh = Vec::new();
        encode_landmarks(0.0, &[[1.0, 2.0, 3.0]; 478], &[], &mut mesh).unwrap();
        assert_eq!(mesh.len(), 2896);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let change = |at: usize, with: &[u8]| {
            let mut bytes = sample();
            bytes[at..at + with.len()].copy_from_slice(with);
            bytes
        };
        let too_long = [sample(), vec![0]].concat();
        for (bytes, code, says) in [
            (Vec::new(), "wrong_length", "has 0 bytes, expected at least the 28"),
            (sample()[..27].to_vec(), "wrong_length", "has 27 bytes"),
            (sample()[..41].to_vec(), "wrong_length", "has 41 bytes, expected 42 for 2 points"),
            (too_long, "wrong_length", "has 43 bytes, expected 42"),
            (change(0, &[2]), "unknown_type", "field kind of a binary message is 2, expected 1"),
            (change(1, &[7]), "out_of_range", "field flags is 0x07"),
            (change(1, &[2]), "wrong_length", "expected 38"),
            (change(2, &[3]), "wrong_count", "field count is 3, expected the 2 points"),
            (change(2, &[255, 255]), "wrong_count", "field count is 65535"),
            (change(12, &f32::NAN.to_le_bytes()), "out_of_range", "field origin is [NaN"),
            (change(16, &2e5_f32.to_le_bytes()), "out_of_range", "field origin"),
            (change(24, &0.0_f32.to_le_bytes()), "out_of_range", "field step is 0, expected pixels, more than 0"),
            (change(24, &f32::NAN.to_le_bytes()), "out_of_range", "field step is NaN"),
            (change(24, &(-1.0_f32).to_le_bytes()), "out_of_range", "field step is -1"),
            (change(24, &1e30_f32.to_le_bytes()), "out_of_range", "field points[1] is"),
        ] {
            let error = decoded(&bytes, 2).expect_err(says);
            assert_eq!(error.code, code, "{error}");
            assert!(error.message.contains(says), "{error}");
        }
        let mut flat = Vec::new();
        encode_landmarks(1.0, &[[1.0, 2.0, 0.0]], &[], &mut flat).unwrap();
        flat[20..24].copy_from_slice(&1.0_f32.to_le_bytes());
        assert!(decoded(&flat, 1).unwrap_err().message.contains("origin has z 1"));
    }

    #[test]
    fn what_cannot_be_written_is_refused() {
        let mut out = Vec::new();
        for (points, confidence) in
            [(vec![], vec![]), (vec![[0.0; 3]; 513], vec![]), (vec![[0.0; 3]; 2], vec![1.0]), (vec![[f32::NAN; 3]], vec![])]
        {
            encode_landmarks(0.0, &points, &confidence, &mut out).unwrap_err();
        }
    }

    proptest! {
        #[test]
        fn a_frame_comes_back_within_half_a_step(
            t in 0.0..9e9,
            points in prop::collection::vec(prop::array::uniform3(-1e5_f32..1e5), 1..80),
            scale in prop::sample::select(vec![1.0_f32, 1e-2, 1e-5]),
            is_flat: bool,
            has_confidence: bool,
        ) {
            let points: Vec<[f32; 3]> = points.iter().map(|p| [p[0] * scale, p[1] * scale, if is_flat { 0.0 } else { p[2] * scale }]).collect();
            let confidence: Vec<f32> = if has_confidence { points.iter().map(|p| (p[0] / 1e5).abs()).collect() } else { Vec::new() };
            let mut bytes = Vec::new();
            encode_landmarks(t, &points, &confidence, &mut bytes).unwrap();
            let (got_t, got, got_confidence) = decoded(&bytes, points.len()).unwrap();
            prop_assert_eq!(got_t, t);
            let step = f32::from_le_bytes([bytes[24], bytes[25], bytes[26], bytes[27]]);
            for (got, want) in got.iter().zip(&points) {
                for axis in 0..3 {
                    // Half a step, and the rounding of f32 at the values' size.
                    let most = 0.5 * step + want[axis].abs() * 2e-7;
                    prop_assert!((got[axis] - want[axis]).abs() <= most * 1.001, "{} {} step {}", got[axis], want[axis], step);
                }
            }
            prop_assert_eq!(got_confidence.len(), confidence.len());
            prop_assert!(got_confidence.iter().zip(&confidence).all(|(got, want)| (got - want).abs() <= 0.5 / 255.0 + 1e-6));
        }

        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), expected in 0usize..40) {
            let _ = decoded(&bytes, expected);
            let mut hostile = bytes;
            if hostile.len() > 4 {
                hostile[0] = 1;
                hostile[1] &= 3;
                hostile[2] = expected as u8;
                hostile[3] = 0;
            }
            if let Ok((_, points, confidence)) = decoded(&hostile, expected) {
                prop_assert!(points.len() == expected && (confidence.is_empty() || confidence.len() == expected));
            }
        }
    }
}
