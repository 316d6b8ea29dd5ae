//! Other programs' tracking protocols. Each parser is a pure function of bytes, with an encoder beside it for the fake senders;
//! [`listen`] owns the sockets and puts what the parsers read into rooms.
//!
//! All of them give [`Seen`]: what one performer's tracker saw at one moment, already in Rhytid's own frame (right-handed, metres,
//! +X to the performer's left, +Y up, +Z out of the face; left and right are the performer's own).

mod eyes;
pub(crate) mod fake;
pub mod fmv3;
pub mod fuzz;
pub mod ifacialmocap;
pub(crate) mod listen;
pub mod livelink;
pub mod livelink_csv;
pub mod openseeface;
pub mod openseeface_csv;
pub mod osc;
pub(crate) mod session;
pub mod sniff;
pub(crate) mod spec;
pub mod table;
pub mod vmc;
pub(crate) mod vmc_out;
pub mod vts;
mod wire;

use glam::{EulerRot, Quat, Vec3};
use rhytid_shared::{ArkitShape, NUM_ARKIT_SHAPES};

pub use eyes::{EyeTurn, FULL_LOOK};

/// Largest weight that still reads as a slip of a tracker and not as another unit.
const LARGEST_SLIP: f32 = 10.0;
/// Largest weight passed on; trackers overshoot 1 a little.
const LARGEST_WEIGHT: f32 = 1.2;
/// Largest turn of a head about one axis, radians: more is another unit.
const LARGEST_TURN: f32 = std::f32::consts::TAU;
/// Farthest a head may be from its tracker, metres: more is another unit.
const FARTHEST_HEAD: f32 = 100.0;

/// A protocol that is spoken over UDP.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Protocol {
    /// OpenSeeFace's own packets of landmarks.
    OpenSeeFace,
    /// Live Link Face, version 6.
    LiveLink,
    /// The text of iFacialMocap and Facemotion3d, versions 1 and 2.
    IFacialMocap,
    /// The binary version 3 of the same two.
    Fmv3,
    /// Virtual Motion Capture, over OSC.
    Vmc,
    /// The raw data that VTube Studio's phone app sends.
    Vts,
}

impl Protocol {
    /// All of them.
    pub const ALL: [Self; 6] = [Self::OpenSeeFace, Self::LiveLink, Self::IFacialMocap, Self::Fmv3, Self::Vmc, Self::Vts];

    /// As options, metrics and listings call it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OpenSeeFace => "openseeface",
            Self::LiveLink => "livelink",
            Self::IFacialMocap => "ifacialmocap",
            Self::Fmv3 => "fmv3",
            Self::Vmc => "vmc",
            Self::Vts => "vts",
        }
    }

    /// The protocol of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|protocol| protocol.name() == name)
    }

    /// Largest datagram that it has a use for, bytes. More is dropped unread.
    pub const fn largest_datagram(self) -> usize {
        match self {
            Self::OpenSeeFace => openseeface::FACE_BYTES * openseeface::MAX_FACES,
            Self::LiveLink => livelink::LARGEST,
            Self::IFacialMocap => ifacialmocap::LARGEST,
            Self::Fmv3 => fmv3::LARGEST_DATAGRAM,
            Self::Vmc => vmc::LARGEST,
            Self::Vts => vts::LARGEST,
        }
    }
}

/// What one performer's tracker saw at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Seen {
    /// Tells performers behind one address apart: a device's id, the number of a face; often empty.
    pub performer: String,
    /// What the sender calls the performer; often empty.
    pub subject: String,
    /// Seconds on the sender's clock, where it sends one.
    pub time: Option<f64>,
    /// What it saw.
    pub sight: Sight,
}

/// The content of a [`Seen`].
#[derive(Debug, Clone, PartialEq)]
pub enum Sight {
    /// Nobody is in view.
    NoFace,
    /// Expression weights.
    Weights(SeenWeights),
    /// OpenSeeFace's 66 landmarks.
    Landmarks {
        /// 66 points, pixels, origin top left, y down.
        points: Vec<[f32; 2]>,
        /// 66 confidences in `[0, 1]`.
        confidence: Vec<f32>,
        /// Width and height of the camera's picture, pixels; the width is the focal length, too.
        image: [f32; 2],
    },
}

/// Expression weights and what came with them.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenWeights {
    /// In `[0, 1.2]`, in the order of [`rhytid_shared::ARKIT_NAMES`].
    pub weights: Box<[f32; NUM_ARKIT_SHAPES]>,
    /// Rotation of the head against its tracker, where it is sent.
    pub head_rotation: Option<Quat>,
    /// Place of the head against its tracker, metres, where it is sent.
    pub head_position: Option<Vec3>,
}

/// Why a datagram was dropped. The label is a metric's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
pub enum Refusal {
    /// It ends before what it announces.
    #[error("it is cut short")]
    Truncated,
    /// It goes on behind what it announces, or its length fits nothing.
    #[error("its length is wrong")]
    WrongLength,
    /// Longer than the protocol has a use for.
    #[error("it is too long")]
    TooLong,
    /// Another version of the protocol.
    #[error("it is of another version")]
    UnknownVersion,
    /// Text that is not UTF-8, not JSON or not what the protocol writes.
    #[error("its text is malformed")]
    Malformed,
    /// A count of something is outside its range.
    #[error("a count in it is wrong")]
    WrongCount,
    /// NaN or infinity.
    #[error("a number in it is not finite")]
    NotFinite,
    /// A value that no tracker gives in this unit.
    #[error("a number in it is out of range")]
    OutOfRange,
    /// Well formed, but nothing of it is about a face.
    #[error("nothing in it is about a face")]
    NoContent,
    /// Of no protocol that is spoken here.
    #[error("it is of no known protocol")]
    UnknownProtocol,
    /// There are as many senders as a port has places for.
    #[error("there are too many senders")]
    TooManySenders,
    /// Not newer than what has come before.
    #[error("it comes too late")]
    Late,
    /// Belongs to no session.
    #[error("it belongs to no session")]
    NoSession,
}

impl Refusal {
    /// Short and stable, for metrics.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Truncated => "truncated",
            Self::WrongLength => "wrong_length",
            Self::TooLong => "too_long",
            Self::UnknownVersion => "unknown_version",
            Self::Malformed => "malformed",
            Self::WrongCount => "wrong_count",
            Self::NotFinite => "not_finite",
            Self::OutOfRange => "out_of_range",
            Self::NoContent => "no_content",
            Self::UnknownProtocol => "unknown_protocol",
            Self::TooManySenders => "too_many_performers",
            Self::Late => "late",
            Self::NoSession => "no_session",
        }
    }
}

/// Expression weights as they are read, by name.
#[derive(Debug, Clone)]
struct WeightSheet {
    weights: Box<[f32; NUM_ARKIT_SHAPES]>,
    num_known: usize,
    has_gaze: bool,
}

impl WeightSheet {
    fn new() -> Self {
        Self { weights: Box::new([0.0; NUM_ARKIT_SHAPES]), num_known: 0, has_gaze: false }
    }

    /// Takes a weight; false where `name` is no shape of ARKit's.
    fn set(&mut self, name: &str, value: f32) -> Result<bool, Refusal> {
        let Some(shape) = ArkitShape::from_name(name) else { return Ok(false) };
        self.weights[shape.index()] = weight(value)?;
        self.num_known += 1;
        self.has_gaze |= eyes::is_gaze(shape.index());
        Ok(true)
    }
}

/// A weight in its range.
fn weight(value: f32) -> Result<f32, Refusal> {
    if !value.is_finite() {
        return Err(Refusal::NotFinite);
    }
    if value.abs() > LARGEST_SLIP {
        return Err(Refusal::OutOfRange);
    }
    Ok(value.clamp(0.0, LARGEST_WEIGHT))
}

/// A rotation from turns about the axes of Rhytid's frame, radians: down, to the performer's left, and of the performer's left side
/// upwards are positive. The roll is nearest to the head, the yaw farthest from it.
fn rotation(pitch: f32, yaw: f32, roll: f32) -> Result<Quat, Refusal> {
    for angle in [pitch, yaw, roll] {
        if !angle.is_finite() {
            return Err(Refusal::NotFinite);
        }
        if angle.abs() > LARGEST_TURN {
            return Err(Refusal::OutOfRange);
        }
    }
    Ok(Quat::from_euler(EulerRot::YXZ, yaw, pitch, roll))
}

/// Turns about the axes as [`rotation`] takes them: pitch, yaw, roll.
fn turns(rotation: Quat) -> [f32; 3] {
    let (yaw, pitch, roll) = rotation.to_euler(EulerRot::YXZ);
    [pitch, yaw, roll]
}

/// A place within reason.
fn position(place: Vec3) -> Result<Vec3, Refusal> {
    if !place.is_finite() {
        return Err(Refusal::NotFinite);
    }
    if place.abs().max_element() > FARTHEST_HEAD {
        return Err(Refusal::OutOfRange);
    }
    Ok(place)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn protocols_are_found_by_their_names() {
        for protocol in Protocol::ALL {
            assert_eq!(Protocol::from_name(protocol.name()), Some(protocol));
        }
        assert_eq!(Protocol::from_name("any"), None);
    }

    #[test]
    fn rotations_turn_as_they_say() {
        let nose = |pitch, yaw, roll| rotation(pitch, yaw, roll).unwrap() * Vec3::Z;
        assert!(nose(0.3, 0.0, 0.0).y < -0.2, "positive pitch looks down");
        assert!(nose(0.0, 0.3, 0.0).x > 0.2, "positive yaw looks to the performer's left, +X");
        assert!((rotation(0.0, 0.0, 0.3).unwrap() * Vec3::X).y > 0.2, "positive roll lifts the left side");
        let [pitch, yaw, roll] = turns(rotation(0.1, -0.4, 0.2).unwrap());
        assert!((pitch - 0.1).abs() < 1e-5 && (yaw + 0.4).abs() < 1e-5 && (roll - 0.2).abs() < 1e-5);
        assert_eq!(rotation(f32::NAN, 0.0, 0.0), Err(Refusal::NotFinite));
        assert_eq!(rotation(28.0, 0.0, 0.0), Err(Refusal::OutOfRange), "degrees are no radians");
    }

    #[test]
    fn weights_are_bounded() {
        assert_eq!((weight(-0.1), weight(1.1), weight(3.0)), (Ok(0.0), Ok(1.1), Ok(1.2)));
        assert_eq!((weight(55.0), weight(f32::NAN)), (Err(Refusal::OutOfRange), Err(Refusal::NotFinite)));
    }
}
