//! Live Link Face's datagrams, version 6: big-endian, one a captured frame.
//!
//! ```text
//! u8 version (6) · i32 length, device id (UTF-8) · i32 length, subject (UTF-8) · i32 frame · f32 sub-frame
//! i32 rate numerator · i32 rate denominator · u8 count · count × f32          without a face it ends before the count
//! ```
//! The first 52 values are ARKit's shapes, then come head yaw, pitch, roll and the same of each eye, radians: down and to the
//! performer's right are positive. The signs of the eyes are measured (against the gaze shapes of real recordings); the head is taken
//! to have the same.

use super::wire::Wire;
use super::{Refusal, Seen, SeenWeights, Sight, eyes, rotation, turns, weight};
use glam::Quat;
use rhytid_shared::NUM_ARKIT_SHAPES;

const VERSION: u8 = 6;
/// Longest id or name, bytes: 36 and a person's name in practice.
const LONGEST_NAME: usize = 256;
/// Values of a datagram with a face.
pub const NUM_VALUES: usize = NUM_ARKIT_SHAPES + 9;
/// Largest datagram, bytes.
pub const LARGEST: usize = 26 + 2 * LONGEST_NAME + 4 * NUM_VALUES;
/// Fastest rate, frames a second.
const FASTEST: f64 = 1000.0;

/// One datagram's content as it stands on the wire.
#[derive(Debug, Clone, PartialEq)]
pub struct Packet<'a> {
    /// The phone's own id.
    pub device: &'a str,
    /// What the user calls the performer.
    pub subject: &'a str,
    /// Counted at the rate, from midnight on the phone.
    pub frame: i32,
    /// Share of a frame in `[0, 1)`.
    pub sub_frame: f32,
    /// Numerator and denominator of the frames a second.
    pub rate: [i32; 2],
    /// The values; nothing where nobody is in view.
    pub values: Option<[f32; NUM_VALUES]>,
}

impl<'a> Packet<'a> {
    /// Reads a datagram.
    pub fn read(bytes: &'a [u8]) -> Result<Self, Refusal> {
        if bytes.len() > LARGEST {
            return Err(Refusal::TooLong);
        }
        let mut wire = Wire(bytes);
        if wire.u8()? != VERSION {
            return Err(Refusal::UnknownVersion);
        }
        let device = name(&mut wire)?;
        let subject = name(&mut wire)?;
        let frame = wire.i32_be()?;
        let sub_frame = wire.f32_be()?;
        let rate = [wire.i32_be()?, wire.i32_be()?];
        if frame < 0 || !(0.0..1.0).contains(&sub_frame) || rate[0] <= 0 || rate[1] <= 0 {
            return Err(Refusal::OutOfRange);
        }
        if f64::from(rate[0]) / f64::from(rate[1]) > FASTEST {
            return Err(Refusal::OutOfRange);
        }
        let values = if wire.0.is_empty() {
            None
        } else {
            if usize::from(wire.u8()?) != NUM_VALUES {
                return Err(Refusal::WrongCount);
            }
            let mut values = [0.0; NUM_VALUES];
            for value in &mut values {
                *value = wire.f32_be()?;
            }
            Some(values)
        };
        wire.end()?;
        Ok(Self { device, subject, frame, sub_frame, rate, values })
    }

    /// Writes the datagram.
    pub fn write(&self) -> Vec<u8> {
        let mut bytes = vec![VERSION];
        for text in [self.device, self.subject] {
            bytes.extend((text.len() as i32).to_be_bytes());
            bytes.extend(text.as_bytes());
        }
        bytes.extend(self.frame.to_be_bytes());
        bytes.extend(self.sub_frame.to_be_bytes());
        bytes.extend(self.rate.iter().flat_map(|part| part.to_be_bytes()));
        if let Some(values) = &self.values {
            bytes.push(NUM_VALUES as u8);
            bytes.extend(values.iter().flat_map(|value| value.to_be_bytes()));
        }
        bytes
    }
}

fn name<'a>(wire: &mut Wire<'a>) -> Result<&'a str, Refusal> {
    let length = usize::try_from(wire.i32_be()?).ok().filter(|length| *length <= LONGEST_NAME).ok_or(Refusal::WrongLength)?;
    std::str::from_utf8(wire.bytes(length)?).map_err(|_| Refusal::Malformed)
}

/// Reads a datagram.
pub fn parse(bytes: &[u8]) -> Result<Seen, Refusal> {
    let packet = Packet::read(bytes)?;
    let seconds = (f64::from(packet.frame) + f64::from(packet.sub_frame)) * f64::from(packet.rate[1]) / f64::from(packet.rate[0]);
    let sight = match &packet.values {
        None => Sight::NoFace,
        Some(values) => Sight::Weights(weights(values)?),
    };
    Ok(Seen { performer: packet.device.to_owned(), subject: packet.subject.to_owned(), time: Some(seconds), sight })
}

fn weights(values: &[f32; NUM_VALUES]) -> Result<SeenWeights, Refusal> {
    let mut weights = Box::new([0.0; NUM_ARKIT_SHAPES]);
    for (to, from) in weights.iter_mut().zip(values) {
        *to = weight(*from)?;
    }
    let [yaw, pitch, roll] = [values[52], values[53], values[54]];
    Ok(SeenWeights { weights, head_rotation: head_rotation(yaw, pitch, roll)?, head_position: None })
}

/// The head's rotation; the app sends exact zeros where it is told not to send it.
pub(super) fn head_rotation(yaw: f32, pitch: f32, roll: f32) -> Result<Option<Quat>, Refusal> {
    let rotation = rotation(pitch, -yaw, -roll)?;
    Ok(([yaw, pitch, roll] != [0.0; 3]).then_some(rotation))
}

/// The values of a face with these weights.
pub fn values(weights: &[f32; NUM_ARKIT_SHAPES], head: Quat) -> [f32; NUM_VALUES] {
    let mut values = [0.0; NUM_VALUES];
    values[..NUM_ARKIT_SHAPES].copy_from_slice(weights);
    let [pitch, yaw, roll] = turns(head);
    values[52..55].copy_from_slice(&[-yaw, pitch, -roll]);
    for (eye, turn) in eyes::read_gaze(weights).into_iter().enumerate() {
        values[55 + 3 * eye..58 + 3 * eye].copy_from_slice(&[-turn.yaw, turn.pitch, 0.0]);
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use sha2::{Digest, Sha256};

    const NO_FACE: [u8; 27] = [6, 0, 0, 0, 1, 0x41, 0, 0, 0, 1, 0x42, 0, 0, 0, 1, 0x3f, 0, 0, 0, 0, 0, 0, 0x3c, 0, 0, 0, 1];

    fn packet() -> Packet<'static> {
        Packet { device: "A", subject: "B", frame: 1, sub_frame: 0.5, rate: [60, 1], values: None }
    }

    #[test]
    fn the_published_bytes_are_read_and_written() {
        assert_eq!(packet().write(), NO_FACE);
        assert_eq!(Packet::read(&NO_FACE), Ok(packet()));
        let seen = parse(&NO_FACE).unwrap();
        assert_eq!(seen, Seen { performer: "A".into(), subject: "B".into(), time: Some(0.025), sight: Sight::NoFace });
        let with_face = Packet { values: Some(std::array::from_fn(|i| i as f32 / 100.0)), ..packet() };
        let bytes = with_face.write();
        let hash: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!((bytes.len(), hash.as_str()), (272, "2e332f60afa77d3aac3b9f9860753e53de26a9ec3a73694b774fbc863229f655"));
        let Sight::Weights(seen) = parse(&bytes).unwrap().sight else { panic!("there is a face") };
        assert_eq!((seen.weights[0], seen.weights[51]), (0.0, 0.51));
        assert!(seen.head_rotation.is_some());
    }

    #[test]
    fn the_head_turns_as_the_eyes_do() {
        let of = |yaw: f32, pitch: f32| {
            let mut values = [0.0; NUM_VALUES];
            (values[52], values[53]) = (yaw, pitch);
            weights(&values).unwrap().head_rotation.map(|rotation| rotation * Vec3::Z)
        };
        assert_eq!(of(0.0, 0.0), None, "zeros are no rotation");
        assert!(of(0.3, 0.0).unwrap().x < -0.2, "positive yaw is to the performer's right");
        assert!(of(0.0, 0.3).unwrap().y < -0.2, "positive pitch is down");
        let head = rotation(0.1, 0.2, -0.05).unwrap();
        let back = weights(&values(&[0.0; NUM_ARKIT_SHAPES], head)).unwrap().head_rotation.unwrap();
        assert!(head.abs_diff_eq(back, 1e-5));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let full = Packet { values: Some([0.5; NUM_VALUES]), ..packet() }.write();
        for cut in 0..full.len() {
            let got = parse(&full[..cut]);
            assert_eq!(got.is_ok(), cut == NO_FACE.len(), "cut at {cut}: {got:?}");
        }
        assert_eq!(parse(&[&full[..], &[0]].concat()), Err(Refusal::WrongLength));
        let broken = |at: usize, bytes: &[u8]| {
            let mut full = full.clone();
            full[at..at + bytes.len()].copy_from_slice(bytes);
            parse(&full).unwrap_err()
        };
        assert_eq!(broken(0, &[5]), Refusal::UnknownVersion);
        assert_eq!(broken(1, &(-1i32).to_be_bytes()), Refusal::WrongLength);
        assert_eq!(broken(1, &i32::MAX.to_be_bytes()), Refusal::WrongLength);
        assert_eq!(broken(5, &[0xff]), Refusal::Malformed);
        assert_eq!(broken(11, &(-5i32).to_be_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(15, &1.0f32.to_be_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(19, &0i32.to_be_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(27, &[52]), Refusal::WrongCount);
        assert_eq!(broken(28, &f32::NAN.to_be_bytes()), Refusal::NotFinite);
        assert_eq!(broken(28, &50.0f32.to_be_bytes()), Refusal::OutOfRange);
        assert_eq!(parse(&vec![6; LARGEST + 1]), Err(Refusal::TooLong));
    }
}
