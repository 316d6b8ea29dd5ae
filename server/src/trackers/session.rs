//! From what a tracker saw to the frames of publish sessions: the clock, left and right, and the place of the head. Pure.

use super::{Protocol, Seen, Sight};
use glam::Vec3;
use rhytid_shared::layout::Layout;
use rhytid_shared::limits::{MAX_HEAD_TRAVEL, MAX_SECONDS};
use rhytid_shared::{ArkitShape, HeadPose, PublishHello, TrackingData, TrackingFrame};

/// Frames in a row that stand before the newest one, from which on the sender's clock is taken to have begun anew. Fewer are
/// datagrams that came late.
const BACK_IN_A_ROW: u32 = 4;
/// A sender's clock that stands this far behind the newest frame, seconds, may have begun anew; datagrams are not as late.
const LATEST: f64 = 0.5;
/// Shortest step of a clock, seconds: what stands nearer is the same frame.
const SHORTEST_STEP: f64 = 1e-5;

/// What a frame's time means.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Tick {
    /// It comes after all others of its session.
    Next,
    /// It stands at the time of the newest.
    Duplicate,
    /// It came after one that is newer.
    Late,
    /// The sender's clock has begun anew: a session begins with this frame.
    Restart,
    /// No time that a session can have.
    OutOfRange,
}

/// One performer's clock.
#[derive(Debug, Default)]
pub(crate) struct Clock {
    newest: Option<f64>,
    num_back: u32,
}

impl Clock {
    /// Places a frame of time `t`, seconds.
    pub fn place(&mut self, t: f64) -> Tick {
        if !(0.0..=MAX_SECONDS).contains(&t) {
            return Tick::OutOfRange;
        }
        let Some(newest) = self.newest else {
            self.newest = Some(t);
            return Tick::Next;
        };
        if t >= newest + SHORTEST_STEP {
            (self.newest, self.num_back) = (Some(t), 0);
            return Tick::Next;
        }
        if (t - newest).abs() < SHORTEST_STEP {
            return Tick::Duplicate;
        }
        if newest - t < LATEST {
            return Tick::Late;
        }
        self.num_back += 1;
        if self.num_back < BACK_IN_A_ROW {
            return Tick::Late;
        }
        (self.newest, self.num_back) = (Some(t), 0);
        Tick::Restart
    }
}

/// Shapes whose sides are swapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Swaps {
    pub jaw: bool,
    pub mouth: bool,
}

impl Swaps {
    /// What is usual with a protocol. Live Link Face's datagrams name the sides of the mouth the other way round than the same
    /// app's recordings do, where mouth and jaw go to one side together.
    pub fn usual(protocol: Protocol) -> Self {
        Self { jaw: false, mouth: protocol == Protocol::LiveLink }
    }
}

/// Turns one session's sights into frames.
#[derive(Debug)]
pub(crate) struct Framer {
    swaps: Swaps,
    /// Where the head was in the first frame: places are told from there.
    origin: Option<Vec3>,
    frame: TrackingFrame,
}

impl Framer {
    pub fn new(swaps: Swaps) -> Self {
        Self { swaps, origin: None, frame: TrackingFrame::default() }
    }

    /// The frame of time `t`.
    pub fn frame(&mut self, t: f64, sight: &Sight) -> &TrackingFrame {
        self.frame.t = t;
        match sight {
            Sight::NoFace => self.frame.data = TrackingData::NoFace,
            Sight::Landmarks { points, confidence, .. } => {
                self.frame.data =
                    TrackingData::Landmarks { points: points.iter().map(|[x, y]| [*x, *y, 0.0]).collect(), confidence: confidence.clone() };
            }
            Sight::Weights(seen) => {
                let mut weights = seen.weights.clone();
                for (is_swapped, left, right) in [(self.swaps.jaw, "jawLeft", "jawRight"), (self.swaps.mouth, "mouthLeft", "mouthRight")] {
                    if let (true, Some(left), Some(right)) = (is_swapped, ArkitShape::from_name(left), ArkitShape::from_name(right)) {
                        weights.swap(left.index(), right.index());
                    }
                }
                let travel = seen.head_position.map(|place| place - *self.origin.get_or_insert(place));
                let head = (seen.head_rotation.is_some() || travel.is_some()).then(|| HeadPose {
                    rotation: seen.head_rotation.unwrap_or_default(),
                    position: travel.unwrap_or_default().clamp(Vec3::splat(-MAX_HEAD_TRAVEL), Vec3::splat(MAX_HEAD_TRAVEL)),
                });
                self.frame.data = TrackingData::Weights { weights, head };
            }
        }
        &self.frame
    }
}

/// What a session with this sight calls itself, coming from `ip`.
pub(crate) fn hello(protocol: Protocol, seen: &Seen, ip: std::net::IpAddr) -> PublishHello {
    const LONGEST: usize = 64;
    let subject: String = seen.subject.chars().filter(|letter| !letter.is_control()).take(LONGEST).collect();
    let source = if subject.is_empty() { format!("{} ({ip})", protocol.name()) } else { format!("{}: {subject} ({ip})", protocol.name()) };
    let image = match seen.sight {
        Sight::Landmarks { image, .. } => Some(image),
        _ => None,
    };
    PublishHello {
        source,
        layout: image.map(|_| Layout::OpenSeeFace66),
        image,
        // What the tracker's own camera has.
        focal: image.map(|[width, _]| width),
        ..PublishHello::default()
    }
}

/// A room's name from what a sender calls the performer, or from the protocol where it calls them nothing.
pub(crate) fn room_of(protocol: Protocol, subject: &str) -> rhytid_shared::RoomName {
    let name: String =
        subject.chars().take(64).map(|letter| if letter.is_ascii_alphanumeric() || letter == '_' { letter } else { '-' }).collect();
    let name = name.trim_matches('-');
    rhytid_shared::RoomName::new(if name.is_empty() { protocol.name() } else { name })
        .expect("only letters that a room's name has are left")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trackers::SeenWeights;
    use rhytid_shared::NUM_ARKIT_SHAPES;

    #[test]
    fn late_frames_are_dropped_and_a_clock_that_begins_anew_begins_a_session() {
        let mut clock = Clock::default();
        let mut place = |times: &[f64]| times.iter().map(|t| clock.place(*t)).collect::<Vec<_>>();
        use Tick::*;
        assert_eq!(place(&[100.0, 100.02, 100.02, 100.01, 100.04]), [Next, Next, Duplicate, Late, Next]);
        assert_eq!(place(&[1.0, 100.06, 1.02, 1.04]), [Late, Next, Late, Late], "one that is very late is no new clock");
        assert_eq!(place(&[1.06, 1.08, 1.1]), [Late, Restart, Next]);
        assert_eq!(place(&[-1.0, 1e10, f64::NAN]), [OutOfRange; 3]);
        assert_eq!(place(&[9e9, 1.2, 1.3, 1.4, 1.5]), [Next, Late, Late, Late, Restart], "a time far ahead shuts nobody out");
    }

    #[test]
    fn sides_are_swapped_and_places_are_told_from_the_first() {
        let of = |name| ArkitShape::from_name(name).unwrap().index();
        let mut weights = Box::new([0.0; NUM_ARKIT_SHAPES]);
        (weights[of("mouthLeft")], weights[of("jawLeft")]) = (0.5, 0.25);
        let at = |place| Sight::Weights(SeenWeights { weights: weights.clone(), head_rotation: None, head_position: Some(place) });
        let mut framer = Framer::new(Swaps::usual(Protocol::LiveLink));
        let mut frame = |t, place| match framer.frame(t, &at(place)).data.clone() {
            TrackingData::Weights { weights, head } => (weights, head.unwrap().position),
            other => panic!("{other:?}"),
        };
        let (swapped, first) = frame(1.0, Vec3::new(0.0, 0.0, -0.6));
        assert_eq!((swapped[of("mouthRight")], swapped[of("mouthLeft")], swapped[of("jawLeft")]), (0.5, 0.0, 0.25));
        let (_, second) = frame(1.1, Vec3::new(5.0, 0.1, -0.5));
        assert!(first == Vec3::ZERO && (second - Vec3::new(0.3, 0.1, 0.1)).length() < 1e-6, "{second}");
    }

    #[test]
    fn names_are_made_of_subjects() {
        let room_of = |subject: &str| room_of(Protocol::LiveLink, subject).to_string();
        assert_eq!(room_of("Anna's iPhone"), "Anna-s-iPhone");
        assert_eq!((room_of("日本"), room_of("")), ("livelink".to_owned(), "livelink".to_owned()));
        assert_eq!(room_of(&"x".repeat(500)).len(), 64);
        let seen = Seen { performer: String::new(), subject: "iPhone\n".into(), time: None, sight: Sight::NoFace };
        assert_eq!(hello(Protocol::LiveLink, &seen, [127, 0, 0, 1].into()).source, "livelink: iPhone (127.0.0.1)");
    }
}
