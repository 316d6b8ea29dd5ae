//! Virtual Motion Capture's protocol (VMC), over OSC: named weights and bones, one value a message, and a message that says when
//! they are all there.
//!
//! Bones are in Unity's frame, which is left-handed: mirrored in x it is Rhytid's. The head is the neck's rotation and the head's
//! own. Faces without ARKit's names (VRM's joy, sorrow, vowels) move what is nearest of ARKit's shapes.

use super::eyes::{EyeTurn, read_gaze, write_gaze};
use super::{LARGEST_WEIGHT, Refusal, Seen, SeenWeights, Sight, osc, turns, weight};
use glam::Quat;
use rhytid_shared::{ARKIT_NAMES, ArkitShape, NUM_ARKIT_SHAPES};
use rosc::{OscBundle, OscMessage, OscPacket, OscTime, OscType, encoder};

/// Largest datagram, bytes: the protocol says 1,500, programs that send whole bodies send more.
pub const LARGEST: usize = 16 << 10;
/// Largest bundle that is written, bytes.
pub const LARGEST_WRITTEN: usize = 1500;
/// Datagrams of a face without a word that it is complete, after which a sender is taken to be one that never says it.
const UNTOLD: u32 = 8;
/// Time of a sender's own clock from which an `f32` no longer tells 120 frames a second apart.
const LATEST_TIME: f32 = 16_384.0;

/// Shapes of ARKit's with their strengths.
type Shapes = &'static [(&'static str, f32)];

/// VRM's expressions (their names in 0.x and 1.0) as ARKit's shapes; strengths tuned by eye.
const VRM: [(&str, &str, Shapes); 13] = [
    ("A", "aa", &[("jawOpen", 0.6)]),
    ("I", "ih", &[("jawOpen", 0.15), ("mouthStretchLeft", 0.5), ("mouthStretchRight", 0.5)]),
    ("U", "ou", &[("jawOpen", 0.15), ("mouthPucker", 0.8)]),
    ("E", "ee", &[("jawOpen", 0.3), ("mouthStretchLeft", 0.3), ("mouthStretchRight", 0.3)]),
    ("O", "oh", &[("jawOpen", 0.4), ("mouthFunnel", 0.6)]),
    ("Blink", "blink", &[("eyeBlinkLeft", 1.0), ("eyeBlinkRight", 1.0)]),
    ("Blink_L", "blinkLeft", &[("eyeBlinkLeft", 1.0)]),
    ("Blink_R", "blinkRight", &[("eyeBlinkRight", 1.0)]),
    ("Joy", "happy", &[("mouthSmileLeft", 0.8), ("mouthSmileRight", 0.8), ("cheekSquintLeft", 0.5), ("cheekSquintRight", 0.5)]),
    ("Angry", "angry", &[("browDownLeft", 0.9), ("browDownRight", 0.9), ("noseSneerLeft", 0.3), ("noseSneerRight", 0.3)]),
    ("Sorrow", "sad", &[("browInnerUp", 0.8), ("mouthFrownLeft", 0.6), ("mouthFrownRight", 0.6)]),
    ("Fun", "relaxed", &[("mouthSmileLeft", 0.4), ("mouthSmileRight", 0.4)]),
    (
        "Surprised",
        "surprised",
        &[("browInnerUp", 0.8), ("browOuterUpLeft", 0.8), ("browOuterUpRight", 0.8), ("eyeWideLeft", 0.6), ("eyeWideRight", 0.6)],
    ),
];

/// What one sender has said so far: values stand until they are sent again.
#[derive(Debug, Clone)]
pub struct Reader {
    weights: Box<[f32; NUM_ARKIT_SHAPES]>,
    vrm: [f32; VRM.len()],
    gives_arkit: bool,
    gives_gaze: bool,
    neck: Option<Quat>,
    head: Option<Quat>,
    /// Left and right.
    eyes: [Option<EyeTurn>; 2],
    /// The sender's clock, where it has told since the last frame.
    time: Option<f32>,
    /// A frame has come without the clock: it cannot be relied on.
    lacks_time: bool,
    /// Faces are complete when the sender says so; of one that never does when their datagram ends.
    sends_apply: bool,
    /// Datagrams of a face in which it has not said so, up to [`UNTOLD`].
    num_untold: u32,
    /// Something about the face has come since the last frame.
    has_news: bool,
    /// The sender has said that the face is complete.
    is_complete: bool,
}

impl Default for Reader {
    fn default() -> Self {
        Self {
            weights: Box::new([0.0; NUM_ARKIT_SHAPES]),
            vrm: [0.0; VRM.len()],
            gives_arkit: false,
            gives_gaze: false,
            neck: None,
            head: None,
            eyes: [None; 2],
            time: None,
            lacks_time: false,
            sends_apply: false,
            num_untold: 0,
            has_news: false,
            is_complete: false,
        }
    }
}

impl Reader {
    /// Takes a datagram; gives a face where one is complete, at most one. On an error nothing has been taken.
    pub fn take(&mut self, bytes: &[u8]) -> Result<Option<Seen>, Refusal> {
        if bytes.len() > LARGEST {
            return Err(Refusal::TooLong);
        }
        let mut next = self.clone();
        osc::messages(bytes, |message| next.read(&message))?;
        if next.has_news && !next.sends_apply {
            next.num_untold = (next.num_untold + 1).min(UNTOLD);
        }
        let is_complete = next.is_complete || (next.has_news && next.num_untold == UNTOLD);
        *self = next;
        Ok(is_complete.then(|| self.complete()))
    }

    fn read(&mut self, message: &OscMessage) -> Result<(), Refusal> {
        // Surplus arguments are ignored; messages with too few or of other types, and unknown ones, are, too.
        match (message.addr.as_str(), message.args.as_slice()) {
            ("/VMC/Ext/Blend/Val", [OscType::String(name), OscType::Float(value), ..]) => self.set(name, *value),
            ("/VMC/Ext/Blend/Apply", _) => {
                (self.sends_apply, self.num_untold) = (true, 0);
                self.is_complete = self.has_news;
                Ok(())
            }
            ("/VMC/Ext/T", [OscType::Float(time), ..]) => {
                self.time = Some(*time).filter(|time| (0.0..LATEST_TIME).contains(time));
                Ok(())
            }
            ("/VMC/Ext/Bone/Pos", [OscType::String(name), numbers @ ..]) => self.turn(name, numbers),
            (address, [OscType::Float(value), ..]) => match address.strip_prefix("/VMC/Ext/Blend/Val/") {
                Some(name) => self.set(name, *value),
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn set(&mut self, name: &str, value: f32) -> Result<(), Refusal> {
        // "A" and "a" are two names, as everything is here; the shapes of ARKit come in two spellings.
        if let Some(index) = VRM.iter().position(|(old, new, _)| *old == name || *new == name) {
            self.vrm[index] = weight(value)?;
        } else if let Some(shape) = ArkitShape::from_name(name) {
            self.weights[shape.index()] = weight(value)?;
            self.gives_arkit = true;
            self.gives_gaze |= super::eyes::is_gaze(shape.index());
        } else {
            return Ok(());
        }
        self.has_news = true;
        Ok(())
    }

    /// Takes the rotation of a bone, of whose place nothing is needed.
    fn turn(&mut self, name: &str, numbers: &[OscType]) -> Result<(), Refusal> {
        if !matches!(name, "Neck" | "Head" | "LeftEye" | "RightEye") {
            return Ok(());
        }
        let mut q = [0.0; 4];
        let Some(sent) = numbers.get(3..7) else { return Ok(()) };
        for (to, from) in q.iter_mut().zip(sent) {
            let OscType::Float(value) = from else { return Ok(()) };
            *to = *value;
        }
        let rotation = mirrored(Quat::from_array(q));
        let length = rotation.length();
        if !length.is_finite() {
            return Err(Refusal::NotFinite);
        }
        if (length - 1.0).abs() > 0.1 {
            return Err(Refusal::OutOfRange);
        }
        let rotation = rotation.normalize();
        let [pitch, yaw, _] = turns(rotation);
        match name {
            "Neck" => self.neck = Some(rotation),
            "Head" => self.head = Some(rotation),
            "LeftEye" => self.eyes[0] = Some(EyeTurn { pitch, yaw }),
            _ => self.eyes[1] = Some(EyeTurn { pitch, yaw }),
        }
        Ok(())
    }

    fn complete(&mut self) -> Seen {
        (self.has_news, self.is_complete) = (false, false);
        let time = self.time.take();
        self.lacks_time |= time.is_none();
        let mut weights = self.weights.clone();
        if !self.gives_arkit {
            for ((.., shapes), amount) in VRM.iter().zip(self.vrm) {
                for (name, strength) in *shapes {
                    let index = ArkitShape::from_name(name).expect("the table holds ARKit's names").index();
                    weights[index] = (weights[index] + amount * strength).min(LARGEST_WEIGHT);
                }
            }
        }
        if let ([Some(left), Some(right)], false) = (self.eyes, self.gives_gaze) {
            write_gaze([left, right], &mut weights);
        }
        let head_rotation = (self.neck.is_some() || self.head.is_some())
            .then(|| (self.neck.unwrap_or_default() * self.head.unwrap_or_default()).normalize());
        Seen {
            performer: String::new(),
            subject: String::new(),
            time: time.filter(|_| !self.lacks_time).map(f64::from),
            sight: Sight::Weights(SeenWeights { weights, head_rotation, head_position: None }),
        }
    }
}

/// From Unity's frame to Rhytid's, and back.
fn mirrored(rotation: Quat) -> Quat {
    Quat::from_xyzw(rotation.x, -rotation.y, -rotation.z, rotation.w)
}

/// Writes one face as bundles of at most [`LARGEST_WRITTEN`] bytes: the state, the clock (seconds), the bones, the weights by
/// ARKit's names in PascalCase (those of "perfect sync"), and in the last bundle that they are complete. Without weights the head
/// alone moves.
pub fn write(time: f32, weights: Option<&[f32; NUM_ARKIT_SHAPES]>, head: Quat) -> Vec<Vec<u8>> {
    let message = |address: &str, args: Vec<OscType>| OscPacket::Message(OscMessage { addr: address.into(), args });
    let bone = |name: &str, rotation: Quat| {
        let numbers = [0.0; 3].into_iter().chain(mirrored(rotation).to_array()).map(OscType::Float);
        message("/VMC/Ext/Bone/Pos", [OscType::String(name.into())].into_iter().chain(numbers).collect())
    };
    let [left, right] =
        weights.map_or_else(Default::default, read_gaze).map(|eye| Quat::from_euler(glam::EulerRot::YXZ, eye.yaw, eye.pitch, 0.0));
    let mut messages = vec![
        message("/VMC/Ext/OK", vec![OscType::Int(1)]),
        message("/VMC/Ext/T", vec![OscType::Float(time)]),
        bone("Head", head),
        bone("LeftEye", left),
        bone("RightEye", right),
    ];
    for (name, weight) in ARKIT_NAMES.iter().zip(weights.into_iter().flatten()) {
        let name = name[..1].to_ascii_uppercase() + &name[1..];
        messages.push(message("/VMC/Ext/Blend/Val", vec![OscType::String(name), OscType::Float(*weight)]));
    }
    messages.push(message("/VMC/Ext/Blend/Apply", Vec::new()));

    const HEAD: usize = 16;
    let (mut bundles, mut content, mut length) = (Vec::new(), Vec::new(), HEAD);
    for message in messages {
        let size = 4 + encoder::encode(&message).expect("a Vec takes everything").len();
        if length + size > LARGEST_WRITTEN {
            bundles.push(bundle(std::mem::take(&mut content)));
            length = HEAD;
        }
        length += size;
        content.push(message);
    }
    bundles.push(bundle(content));
    bundles
}

fn bundle(content: Vec<OscPacket>) -> Vec<u8> {
    let now = OscTime { seconds: 0, fractional: 1 };
    encoder::encode(&OscPacket::Bundle(OscBundle { timetag: now, content })).expect("a Vec takes everything")
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// "Joy" at 0.5, and that it is complete, as published.
    const JOY: [u8; 84] =
        *b"#bundle\0\0\0\0\0\0\0\0\x01\0\0\0\x20/VMC/Ext/Blend/Val\0\0,sf\0Joy\0\x3f\0\0\0\0\0\0\x1c/VMC/Ext/Blend/Apply\0\0\0\0,\0\0\0";

    fn of(seen: &Seen, name: &str) -> f32 {
        let Sight::Weights(seen) = &seen.sight else { panic!("weights") };
        seen.weights[ArkitShape::from_name(name).unwrap().index()]
    }

    fn value(name: &str, value: f32) -> OscPacket {
        OscPacket::Message(OscMessage {
            addr: "/VMC/Ext/Blend/Val".into(),
            args: vec![OscType::String(name.into()), OscType::Float(value)],
        })
    }

    fn apply() -> OscPacket {
        OscPacket::Message(OscMessage { addr: "/VMC/Ext/Blend/Apply".into(), args: vec![] })
    }

    fn bone(name: &str, q: [f32; 4]) -> OscPacket {
        let args = [OscType::String(name.into())].into_iter().chain([0.0; 3].into_iter().chain(q).map(OscType::Float)).collect();
        OscPacket::Message(OscMessage { addr: "/VMC/Ext/Bone/Pos".into(), args })
    }

    #[test]
    fn the_published_bytes_are_read() {
        let mut reader = Reader::default();
        let seen = reader.take(&JOY).unwrap().expect("the face is complete");
        assert_eq!((of(&seen, "mouthSmileLeft"), of(&seen, "jawOpen")), (0.4, 0.0));
        let apply = OscPacket::Message(OscMessage { addr: "/VMC/Ext/Blend/Apply".into(), args: vec![] });
        let written = bundle(vec![value("Joy", 0.5), apply]);
        assert_eq!(written, JOY);
    }

    #[test]
    fn values_stand_until_they_are_sent_again_and_faces_come_when_complete() {
        let mut reader = Reader::default();
        assert!(reader.take(&JOY).unwrap().is_some());
        assert_eq!(reader.take(&bundle(vec![value("JawOpen", 0.5)])).unwrap(), None, "this sender says when it is complete");
        let seen = reader.take(&bundle(vec![OscPacket::Message(OscMessage { addr: "/VMC/Ext/Blend/Apply".into(), args: vec![] })]));
        let seen = seen.unwrap().unwrap();
        assert_eq!((of(&seen, "jawOpen"), of(&seen, "mouthSmileLeft")), (0.5, 0.0), "with ARKit's names the VRM ones count no more");
        // One that never does gives a face a datagram, once that is clear.
        let mut reader = Reader::default();
        for _ in 1..UNTOLD {
            assert_eq!(reader.take(&bundle(vec![value("browInnerUp", 0.5)])), Ok(None));
        }
        let seen = reader.take(&bundle(vec![value("browInnerUp", 0.25), value("tongueOut", 3.0)])).unwrap().unwrap();
        assert_eq!((of(&seen, "browInnerUp"), of(&seen, "tongueOut")), (0.25, 1.2));
        assert_eq!(reader.take(&bundle(vec![bone("Hips", [0.0, 0.0, 0.0, 1.0])])).unwrap(), None, "nothing of a face");
        let by_address = OscMessage { addr: "/VMC/Ext/Blend/Val/mouthClose".into(), args: vec![OscType::Float(0.75)] };
        let seen = reader.take(&encoder::encode(&OscPacket::Message(by_address)).unwrap()).unwrap().unwrap();
        assert_eq!((of(&seen, "mouthClose"), of(&seen, "browInnerUp")), (0.75, 0.25));
    }

    #[test]
    fn bones_come_out_of_unitys_mirror() {
        let mut reader = Reader::default();
        // Unity: +X is the character's right, so a positive turn about Y looks to the right there.
        let (s, c) = (0.3f32 / 2.0).sin_cos();
        let packet = bundle(vec![
            bone("Neck", [0.0, s, 0.0, c]),
            bone("Head", [s, 0.0, 0.0, c]),
            bone("LeftEye", [0.0, s, 0.0, c]),
            bone("RightEye", [0.0, s, 0.0, c]),
            value("jawOpen", 0.1),
            apply(),
        ]);
        let seen = reader.take(&packet).unwrap().unwrap();
        assert!((of(&seen, "eyeLookInLeft") - 0.5).abs() < 1e-5 && (of(&seen, "eyeLookOutRight") - 0.5).abs() < 1e-5);
        let Sight::Weights(seen) = seen.sight else { panic!("weights") };
        let nose = seen.head_rotation.unwrap() * Vec3::Z;
        assert!(nose.x < -0.2 && nose.y < -0.2, "to the right and down: {nose}");
    }

    #[test]
    fn a_face_that_is_written_is_read() {
        let weights = std::array::from_fn(|i| i as f32 / 64.0);
        let head = crate::trackers::rotation(0.2, -0.3, 0.1).unwrap();
        let bundles = write(12.5, Some(&weights), head);
        assert!(bundles.iter().all(|bundle| bundle.len() <= LARGEST_WRITTEN) && bundles.len() == 2, "{}", bundles.len());
        let mut reader = Reader::default();
        let seen: Vec<_> = bundles.iter().flat_map(|bundle| reader.take(bundle).unwrap()).collect();
        assert_eq!((seen.len(), seen[0].time), (1, Some(12.5)), "two datagrams are one face");
        let last = seen[0].clone();
        assert_eq!(of(&last, "tongueOut"), 51.0 / 64.0);
        let Sight::Weights(last) = last.sight else { panic!("weights") };
        assert_eq!(*last.weights, weights);
        assert!(last.head_rotation.unwrap().abs_diff_eq(head, 1e-5));
    }

    #[test]
    fn a_bad_datagram_changes_nothing() {
        let mut reader = Reader::default();
        reader.take(&JOY).unwrap();
        let before = format!("{reader:?}");
        for (packet, refusal) in [
            (bundle(vec![value("Joy", 0.1), value("Fun", f32::NAN)]), Refusal::NotFinite),
            (bundle(vec![value("Joy", 0.1), value("JawOpen", 55.0)]), Refusal::OutOfRange),
            (bundle(vec![value("Joy", 0.1), bone("Head", [0.0; 4])]), Refusal::OutOfRange),
            (bundle(vec![value("Joy", 0.1), bone("Head", [f32::INFINITY, 0.0, 0.0, 0.0])]), Refusal::NotFinite),
            (JOY[..80].to_vec(), Refusal::Truncated),
            (b"/a\0\0,Z\0\0".to_vec(), Refusal::Malformed),
            (vec![0; LARGEST + 4], Refusal::TooLong),
        ] {
            assert_eq!(reader.take(&packet), Err(refusal));
            assert_eq!(format!("{reader:?}"), before);
        }
        // Wrong types and too few arguments are no errors; they are nothing.
        let odd = OscPacket::Message(OscMessage { addr: "/VMC/Ext/Blend/Val".into(), args: vec![OscType::Int(3)] });
        assert_eq!(reader.take(&encoder::encode(&odd).unwrap()), Ok(None));
    }

    #[test]
    fn a_clock_is_believed_only_where_every_face_has_it() {
        let at = |time| OscPacket::Message(OscMessage { addr: "/VMC/Ext/T".into(), args: vec![OscType::Float(time)] });
        let mut reader = Reader::default();
        let mut time = |packets| reader.take(&bundle(packets)).unwrap().unwrap().time;
        assert_eq!(time(vec![at(1.5), value("jawOpen", 0.1), apply()]), Some(1.5));
        assert_eq!(time(vec![value("jawOpen", 0.2), apply()]), None);
        assert_eq!(time(vec![at(2.0), value("jawOpen", 0.1), apply()]), None);
    }
}
