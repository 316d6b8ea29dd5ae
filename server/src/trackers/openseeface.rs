//! OpenSeeFace's datagrams: little-endian, 1,785 bytes a face, all faces of one camera frame back to back.
//!
//! ```text
//! 0 f64 time (Unix) · 8 i32 face · 12 f32 width, height · 20 2 f32 openness of the eyes · 28 u8 3D fit succeeded
//! 29 f32 error of the fit · 33 4 f32 quaternion · 49 3 f32 Euler degrees · 61 3 f32 translation
//! 73 68 f32 confidence · 345 68 × 2 f32 landmark (column, row) · 889 70 × 3 f32 3D point · 1729 14 f32 features
//! ```
//! Rhytid takes the 66 landmarks of the face and fits head and face itself, as from any camera; the tracker's own fit, its pupils
//! and its features are left.

use super::wire::Wire;
use super::{Refusal, Seen, Sight};

/// Bytes of one face.
pub const FACE_BYTES: usize = 1785;
/// Most faces in a datagram: more than the tracker follows by choice, and as many as a port has performers.
pub const MAX_FACES: usize = 16;
/// Landmarks on the wire, two of them pupils.
const NUM_SENT: usize = 68;
/// Landmarks of the face.
pub const NUM_POINTS: usize = 66;
/// Largest side of a camera's picture, pixels, and farthest a landmark may be.
const FARTHEST: f32 = 1e5;

/// Reads a datagram: every face in it.
pub fn parse(bytes: &[u8]) -> Result<Vec<Seen>, Refusal> {
    if bytes.len() < FACE_BYTES {
        return Err(Refusal::Truncated);
    }
    if !bytes.len().is_multiple_of(FACE_BYTES) {
        return Err(Refusal::WrongLength);
    }
    if bytes.len() > FACE_BYTES * MAX_FACES {
        return Err(Refusal::TooLong);
    }
    bytes.chunks_exact(FACE_BYTES).map(face).collect()
}

/// The time of a datagram's first face where it is one of a Unix clock.
pub(super) fn plausible_time(bytes: &[u8]) -> bool {
    bytes.first_chunk::<8>().is_some_and(|time| (0.0..=rhytid_shared::limits::MAX_SECONDS).contains(&f64::from_le_bytes(*time)))
}

fn face(bytes: &[u8]) -> Result<Seen, Refusal> {
    let mut wire = Wire(bytes);
    let time = f64::from_le_bytes(wire.array()?);
    if !time.is_finite() {
        return Err(Refusal::NotFinite);
    }
    let id = i32::from_le_bytes(wire.array()?);
    let image = [wire.f32_le()?, wire.f32_le()?];
    if !plausible_time(bytes) || image.iter().any(|side| !(1.0..=FARTHEST).contains(side)) {
        return Err(Refusal::OutOfRange);
    }
    wire.bytes(53)?;
    let mut confidence = Vec::with_capacity(NUM_POINTS);
    for i in 0..NUM_SENT {
        let value = wire.f32_le()?;
        if i < NUM_POINTS {
            confidence.push(value.clamp(0.0, 1.0));
        }
    }
    let mut points = Vec::with_capacity(NUM_POINTS);
    for _ in 0..NUM_POINTS {
        let point = [wire.f32_le()?, wire.f32_le()?];
        if point.iter().any(|value| value.abs() > FARTHEST) {
            return Err(Refusal::OutOfRange);
        }
        points.push(point);
    }
    let performer = id.to_string();
    Ok(Seen { subject: format!("face {performer}"), performer, time: Some(time), sight: Sight::Landmarks { points, confidence, image } })
}

/// Writes the datagram of one face, which is 0: the 66 points and their confidences, and no 3D fit.
pub fn write(time: f64, image: [f32; 2], points: &[[f32; 2]; NUM_POINTS], confidence: f32) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(FACE_BYTES);
    bytes.extend(time.to_le_bytes());
    bytes.extend(0i32.to_le_bytes());
    let mut put = |values: &[f32]| bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    put(&image);
    put(&[1.0, 1.0]);
    bytes.push(0);
    let mut put = |values: &[f32]| bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    put(&[0.0; 11]);
    put(&[confidence; NUM_SENT]);
    for point in points {
        put(point);
    }
    // The pupils, between the corners of their eyes.
    for [outer, inner] in [[36, 39], [42, 45]] {
        put(&std::array::from_fn::<f32, 2, _>(|axis| (points[outer][axis] + points[inner][axis]) / 2.0));
    }
    put(&[0.0; 70 * 3 + 14]);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points() -> [[f32; 2]; NUM_POINTS] {
        std::array::from_fn(|i| [i as f32, 100.0 + i as f32])
    }

    #[test]
    fn what_is_written_is_read_at_the_published_offsets() {
        let bytes = write(1_700_000_000.25, [640.0, 480.0], &points(), 0.75);
        assert_eq!(bytes.len(), FACE_BYTES);
        let f32_at = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!((f32_at(12), f32_at(16), f32_at(73), f32_at(73 + 67 * 4)), (640.0, 480.0, 0.75, 0.75));
        assert_eq!((f32_at(345), f32_at(349), f32_at(345 + 65 * 8)), (0.0, 100.0, 65.0));
        let seen = parse(&bytes).unwrap();
        assert_eq!(seen.len(), 1);
        assert_eq!((seen[0].performer.as_str(), seen[0].time), ("0", Some(1_700_000_000.25)));
        let Sight::Landmarks { points: got, confidence, image } = &seen[0].sight else { panic!("landmarks") };
        assert_eq!((got.as_slice(), confidence.len(), confidence[3], *image), (&points()[..], NUM_POINTS, 0.75, [640.0, 480.0]));
    }

    #[test]
    fn several_faces_come_in_one_datagram() {
        let mut both = write(5.0, [640.0, 480.0], &points(), 1.0);
        let mut second = both.clone();
        second[8..12].copy_from_slice(&3i32.to_le_bytes());
        both.extend(second);
        let seen = parse(&both).unwrap();
        assert_eq!(seen.iter().map(|seen| seen.performer.as_str()).collect::<Vec<_>>(), ["0", "3"]);
        assert_eq!(parse(&vec![0; FACE_BYTES * (MAX_FACES + 1)]), Err(Refusal::TooLong));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let good = write(5.0, [640.0, 480.0], &points(), 1.0);
        assert_eq!(parse(&[]), Err(Refusal::Truncated));
        assert_eq!(parse(&good[..1784]), Err(Refusal::Truncated));
        assert_eq!(parse(&[&good[..], &[0]].concat()), Err(Refusal::WrongLength));
        let broken = |at: usize, bytes: &[u8]| {
            let mut bad = good.clone();
            bad[at..at + bytes.len()].copy_from_slice(bytes);
            parse(&bad).unwrap_err()
        };
        assert_eq!(broken(0, &f64::NAN.to_le_bytes()), Refusal::NotFinite);
        assert_eq!(broken(0, &(-1.0f64).to_le_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(0, &1e300f64.to_le_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(12, &0.0f32.to_le_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(345, &f32::INFINITY.to_le_bytes()), Refusal::NotFinite);
        assert_eq!(broken(345, &1e9f32.to_le_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(73, &f32::NAN.to_le_bytes()), Refusal::NotFinite);
    }
}
