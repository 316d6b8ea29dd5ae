//! What a tracker publishes: the checked messages, and the reader that turns their JSON into them.

mod binary;
mod fields;
mod profile;
mod reader;
mod settings;
mod slot;
mod values;

use crate::face::HeadPose;
use crate::layout::Layout;
use crate::limits::MAX_EXPRESSIONS;
use crate::names::NUM_ARKIT_SHAPES;
use glam::Vec3;

pub use binary::encode_landmarks;
pub use profile::{
    Calibration, FIT_SECONDS, FaceKind, FitRequest, FitStep, PROFILE_VERSION, Profile, ProfileChoice, RANGE_FACTORS, Ranges,
};
pub use reader::PublishReader;
pub use settings::{GroupValues, Settings};
pub use slot::{ChannelGroup, ChannelGroups, Slot};

/// A publisher's first message, checked. By default one of an unnamed sender of weights or bones.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PublishHello {
    /// What the sender calls itself; at most 128 characters.
    pub source: String,
    /// Frames a second the sender means to send, where it says so.
    pub fps: Option<f32>,
    /// Layout of landmark frames; `None` for a sender of weights or bones only.
    pub layout: Option<Layout>,
    /// Width and height of the tracker's picture, pixels; required with a layout.
    pub image: Option<[f32; 2]>,
    /// Focal length of the tracker's camera, pixels; the image width serves where it is unknown. With an image within
    /// [`FOCAL_RANGE`](crate::limits::FOCAL_RANGE) of its width.
    pub focal: Option<f32>,
    /// Take the slot over from another publisher.
    pub takeover: bool,
    /// Take the slot over from this session, which was the publisher's own until its connection broke, with everything as it was.
    pub resume: Option<Resume>,
    /// The source slot that it claims.
    pub slot: Slot,
    /// Settings to start with.
    pub settings: Settings,
    /// Start from the neutral face that the room keeps of the same tracker, see [`Self::tracker`].
    pub keep_neutral: bool,
    /// What is known of the performer.
    pub profile: Option<ProfileChoice>,
}

/// A session that a publisher wants to have back, as the server's `ready` told it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Resume {
    /// Its number in the room. A server that is started anew may give it to somebody else.
    pub session: u32,
    /// What nobody else was told; at most [`MAX_RESUME_KEY`](crate::limits::MAX_RESUME_KEY) bytes. `None` from a client that does not
    /// know of it.
    pub key: Option<String>,
}

impl PublishHello {
    /// What tells one tracker before one camera from another, as far as the hello says: the neutral face of one session is that of
    /// another with the same.
    pub fn tracker(&self) -> String {
        let Self { source, layout, image, focal, .. } = self;
        format!("{source:?} {layout:?} {image:?} {focal:?}")
    }
}

/// One checked frame from a tracker. The buffers are reused from frame to frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackingFrame {
    /// Seconds on the sender's clock, strictly increasing within a session.
    pub t: f64,
    /// What the tracker saw.
    pub data: TrackingData,
    /// Amounts of the character's expressions in `[0, 1.2]` where the sender gives them, in the order of its table; those not
    /// named and those past the table's end are 0. They drive wrinkle zones and move no bone.
    pub expressions: Option<[f32; MAX_EXPRESSIONS]>,
}

/// What a tracker saw in one frame.
#[derive(Debug, Clone, PartialEq)]
pub enum TrackingData {
    /// Feature points in the order of the session's layout.
    Landmarks {
        /// Pixels, origin top left, y down; z in the unit of x, smaller is nearer, 0 where the tracker gives none.
        points: Vec<[f32; 3]>,
        /// One confidence in `[0, 1]` a point, or empty.
        confidence: Vec<f32>,
    },
    /// Expression weights, clamped to `[0, 1.2]`, in the order of [`crate::ARKIT_NAMES`]; shapes not named are 0.
    Weights {
        /// The weights.
        weights: Box<[f32; NUM_ARKIT_SHAPES]>,
        /// Head pose where the tracker gives one.
        head: Option<HeadPose>,
    },
    /// Bones placed directly, by an animator's rig or a clip.
    Bones {
        /// `(bone index, evaluated point)`, metres, head space; bones not named stay at rest.
        points: Vec<(usize, Vec3)>,
        /// Head pose where the sender gives one.
        head: Option<HeadPose>,
    },
    /// The tracker sees no face.
    NoFace,
}

impl TrackingFrame {
    /// A frame whose sender gives no expressions.
    pub fn new(t: f64, data: TrackingData) -> Self {
        Self { t, data, expressions: None }
    }
}

impl Default for TrackingFrame {
    fn default() -> Self {
        Self::new(0.0, TrackingData::NoFace)
    }
}

/// What a publish message was, once it has been read.
#[derive(Debug, Clone, PartialEq)]
pub enum PublishMessage {
    /// The session's first message.
    Hello(PublishHello),
    /// A frame; it stands in the [`TrackingFrame`] given to [`PublishReader::read`].
    Frame,
    /// Anything that a publisher, or somebody for it, asks for.
    Command(Command),
}

/// What a source is asked for besides taking frames: by its publisher, or over a control socket.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// Take the neutral face now.
    Calibrate,
    /// Change some settings.
    Settings(Settings),
    /// The head's present pose is straight ahead.
    Recentre,
    /// A step of the guided fit.
    Fit(FitRequest),
    /// Use this profile.
    Profile(ProfileChoice),
}

/// Most characters of an error, with room for the names of all expressions.
const MOST_SAID: usize = 2000;

/// Why a publish message was refused. `message` names the field and what was expected.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct MessageError {
    /// Short and stable, for programs.
    pub code: &'static str,
    /// For people.
    pub message: String,
}

impl MessageError {
    /// A refusal with its code and its reason, made one line that is not too long: it may repeat what the sender wrote, and goes
    /// into logs and back over the wire.
    pub fn new(code: &'static str, message: impl Into<String>) -> Self {
        let mut message = message.into();
        if let Some((end, _)) = message.char_indices().nth(MOST_SAID) {
            message.truncate(end);
            message.push('…');
        }
        if message.contains(char::is_control) {
            message = message.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect();
        }
        Self { code, message }
    }
}
