//! What is known of a performer: the neutral face, how far each expression goes, and settings. A JSON file, and a message.

use super::{MessageError, Settings};
use crate::names::RoomName;
use serde::{Deserialize, Serialize};

/// Version of the profile's format.
pub const PROFILE_VERSION: u32 = 1;
/// Smallest and largest factor of a range.
pub const RANGE_FACTORS: [f32; 2] = [0.4, 3.0];
/// Shortest and longest time that a step of the fit measures, seconds.
pub const FIT_SECONDS: [f64; 2] = [0.2, 10.0];
/// Longest name of a source that a profile keeps, characters.
const MAX_SOURCE: usize = 128;
/// Most points of a neutral face: every landmark of the largest layout and both irises.
const MAX_POINTS: usize = 512;

/// A neutral face as it was calibrated: kept with a session so that a replay is exact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Sender's time at which it was reached, seconds.
    pub t: f64,
    /// Frames it is the median of.
    pub num_frames: usize,
    /// Root-mean-square landmark speed over those frames, interocular distances a second.
    pub speed: f64,
    /// True where the publisher asked for it.
    pub requested: bool,
    /// The performer's neutral points (68 for iBUG and what maps onto it, with two irises after them where the layout
    /// has them; the sender's own otherwise), head space, metres at the character's scale. Empty for senders of weights.
    pub points: Vec<[f64; 3]>,
    /// Head rotation at neutral, `camera_from_head` as a quaternion (x, y, z, w).
    pub head_rotation: [f64; 4],
    /// Where the character's head pivot was at neutral, metres in the camera's frame.
    pub head_position: [f64; 3],
    /// Expression weights at neutral, for senders of weights that asked to be calibrated.
    pub weights: Option<Vec<f32>>,
}

/// A face that the guided fit asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FitStep {
    /// At rest.
    Neutral,
    /// Brows as high as they go.
    BrowsUp,
    /// Brows down and together.
    Frown,
    /// A broad smile.
    Smile,
    /// Lips as for a kiss.
    Pucker,
    /// The jaw dropped.
    JawOpen,
    /// Both eyes shut.
    Blink,
    /// Mouth and jaw to the performer's own left.
    MouthLeft,
}

impl FitStep {
    /// All of them, in the order they are asked for.
    pub const ALL: [Self; 8] =
        [Self::Neutral, Self::BrowsUp, Self::Frown, Self::Smile, Self::Pucker, Self::JawOpen, Self::Blink, Self::MouthLeft];

    /// As messages and profiles call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Neutral => "neutral",
            Self::BrowsUp => "brows_up",
            Self::Frown => "frown",
            Self::Smile => "smile",
            Self::Pucker => "pucker",
            Self::JawOpen => "jaw_open",
            Self::Blink => "blink",
            Self::MouthLeft => "mouth_left",
        }
    }

    /// The step of this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|step| step.name() == name)
    }

    /// What a performer is told to do.
    pub fn instruction(self) -> &'static str {
        match self {
            Self::Neutral => "look straight ahead and do nothing",
            Self::BrowsUp => "brows up, as high as they go",
            Self::Frown => "frown: brows down and together",
            Self::Smile => "smile broadly",
            Self::Pucker => "pucker, as for a kiss",
            Self::JawOpen => "let the jaw drop",
            Self::Blink => "close both eyes",
            Self::MouthLeft => "pull mouth and jaw to your own left",
        }
    }
}

/// What is asked of the guided fit.
#[derive(Debug, Clone, PartialEq)]
pub enum FitRequest {
    /// Measure a face from the next frames.
    Measure {
        /// Which face.
        step: FitStep,
        /// How long on the sender's clock, seconds, within [`FIT_SECONDS`].
        seconds: f64,
    },
    /// Make a profile of what has been measured and use it.
    Finish {
        /// What the profile shall be called; a server with a folder of profiles keeps it by this name.
        name: Option<RoomName>,
    },
    /// Forget what has been measured.
    Cancel,
}

/// How a performer's face comes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaceKind {
    /// As landmarks.
    Landmarks,
    /// As expression weights.
    Weights,
}

/// Factors by which a performer's expressions are stretched to the character's, about the neutral face, each within
/// [`RANGE_FACTORS`]; 1 where nothing is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[expect(missing_docs, reason = "the steps of the fit")]
pub struct Ranges {
    pub brows_up: f32,
    pub frown: f32,
    pub smile: f32,
    pub pucker: f32,
    pub jaw_open: f32,
    pub blink: f32,
    /// To either side.
    pub mouth_left: f32,
}

impl Ranges {
    /// Nothing is stretched.
    pub const ONE: Self = Self { brows_up: 1.0, frown: 1.0, smile: 1.0, pucker: 1.0, jaw_open: 1.0, blink: 1.0, mouth_left: 1.0 };

    /// The factor of a step; 1 for the neutral face.
    pub fn of(&self, step: FitStep) -> f32 {
        match step {
            FitStep::Neutral => 1.0,
            FitStep::BrowsUp => self.brows_up,
            FitStep::Frown => self.frown,
            FitStep::Smile => self.smile,
            FitStep::Pucker => self.pucker,
            FitStep::JawOpen => self.jaw_open,
            FitStep::Blink => self.blink,
            FitStep::MouthLeft => self.mouth_left,
        }
    }

    /// Sets the factor of a step; the neutral face has none.
    pub fn set(&mut self, step: FitStep, factor: f32) {
        match step {
            FitStep::Neutral => {}
            FitStep::BrowsUp => self.brows_up = factor,
            FitStep::Frown => self.frown = factor,
            FitStep::Smile => self.smile = factor,
            FitStep::Pucker => self.pucker = factor,
            FitStep::JawOpen => self.jaw_open = factor,
            FitStep::Blink => self.blink = factor,
            FitStep::MouthLeft => self.mouth_left = factor,
        }
    }
}

impl Default for Ranges {
    fn default() -> Self {
        Self::ONE
    }
}

/// What is known of a performer before a tracker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// [`PROFILE_VERSION`].
    pub rhytid_profile: u32,
    /// What it is called, by the rule of room names; empty where it has no name.
    #[serde(default)]
    pub name: String,
    /// What the tracker called itself. A server with a folder of profiles uses the newest one of a source that names none.
    #[serde(default)]
    pub source: String,
    /// How the face came that was measured.
    pub measured: FaceKind,
    /// The neutral face. Another kind of tracker searches for its own and uses the rest.
    #[serde(default)]
    pub neutral: Option<Calibration>,
    /// How far each expression goes.
    #[serde(default)]
    pub ranges: Ranges,
    /// Settings in use with it.
    #[serde(default)]
    pub settings: Settings,
}

impl Profile {
    /// Reads a profile's file. The error says what is wrong.
    pub fn from_json(text: &str) -> Result<Self, MessageError> {
        let profile: Self =
            serde_json::from_str(text).map_err(|error| MessageError::new("bad_profile", format!("no profile of Rhytid: {error}")))?;
        profile.check()?;
        Ok(profile)
    }

    /// Checks version, names and numbers.
    pub fn check(&self) -> Result<(), MessageError> {
        let refuse = |message: String| Err(MessageError::new("bad_profile", message));
        if self.rhytid_profile != PROFILE_VERSION {
            return refuse(format!("field rhytid_profile is {}, expected version {PROFILE_VERSION}", self.rhytid_profile));
        }
        if !self.name.is_empty() && RoomName::new(&self.name).is_err() {
            let shown: String = self.name.chars().take(40).collect();
            return refuse(format!("field name is {shown:?}, expected 1 to 64 characters of A-Z a-z 0-9 _ -, or none"));
        }
        if self.source.chars().count() > MAX_SOURCE {
            return refuse(format!("field source has more than {MAX_SOURCE} characters"));
        }
        let [least, most] = RANGE_FACTORS;
        for step in FitStep::ALL {
            let factor = self.ranges.of(step);
            // A NaN is in no range.
            if !(least..=most).contains(&factor) {
                return refuse(format!("field ranges.{} is {factor}, expected {least} to {most}", step.name()));
            }
        }
        if let Some(neutral) = &self.neutral
            && neutral.points.len() > MAX_POINTS
        {
            return refuse(format!("field neutral.points has {} points, expected at most {MAX_POINTS}", neutral.points.len()));
        }
        self.settings.check().map_err(|error| MessageError::new("bad_profile", error.message.replacen("field ", "field settings.", 1)))
    }
}

/// Which profile a publisher uses.
#[derive(Debug, Clone, PartialEq)]
pub enum ProfileChoice {
    /// This one.
    Given(Box<Profile>),
    /// The one that the server keeps by this name.
    Named(RoomName),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_survives_its_file_and_a_wrong_one_is_named() {
        let text =
            r#"{"rhytid_profile":1,"name":"ada","source":"webcam","measured":"weights","ranges":{"smile":1.5},"settings":{"mirror":true}}"#;
        let profile = Profile::from_json(text).unwrap();
        assert_eq!((profile.ranges.smile, profile.ranges.blink, profile.settings.mirror), (1.5, 1.0, Some(true)));
        assert_eq!(Profile::from_json(&serde_json::to_string(&profile).unwrap()).unwrap(), profile);
        for (from, to, says) in [
            ("\"rhytid_profile\":1", "\"rhytid_profile\":2", "field rhytid_profile is 2, expected version 1"),
            ("\"ada\"", "\"../ada\"", "field name is \"../ada\""),
            ("1.5", "9", "field ranges.smile is 9, expected 0.4 to 3"),
            ("\"smile\"", "\"grin\"", "unknown field `grin`"),
            ("\"mirror\":true", "\"gains\":{\"head\":-1}", "field settings.gains.head is -1"),
            ("\"weights\"", "\"mocap\"", "unknown variant `mocap`"),
        ] {
            let error = Profile::from_json(&text.replace(from, to)).expect_err(says).message;
            assert!(error.contains(says), "{error}");
        }
    }

    #[test]
    fn every_step_has_a_factor_of_its_own() {
        let mut ranges = Ranges::ONE;
        for (i, step) in FitStep::ALL.into_iter().enumerate() {
            ranges.set(step, 1.0 + i as f32 / 10.0);
            assert_eq!(FitStep::from_name(step.name()), Some(step));
        }
        for (i, step) in FitStep::ALL.into_iter().enumerate() {
            assert_eq!(ranges.of(step), 1.0 + i as f32 / 10.0);
        }
    }
}
