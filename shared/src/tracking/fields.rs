//! The fields of a publish message, read straight into reused buffers: no tree of JSON is built, because the tree of
//! one frame of 478 points costs more time than everything the solve does with it.

use super::MessageError;
use super::profile::ProfileChoice;
use super::reader::{Names, TYPES};
use super::settings::Settings;
use super::slot::ChannelGroups;
use super::values::{
    Bones, Confidence, Expressions, Flag, Groups, Head, Landmarks, LayoutSeed, Number, Numbers, ProfileSeed, Text, Weights, cut,
};
use crate::limits::MAX_EXPRESSIONS;
use crate::names::NUM_ARKIT_SHAPES;
use glam::{Quat, Vec3};
use serde::de::{Deserializer, Error, IgnoredAny, MapAccess, Visitor};
use std::fmt;

/// Longest name a sender gives itself, characters.
const MAX_SOURCE: usize = 128;

/// Which message it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Hello,
    Frame,
    Calibrate,
    Settings,
    Recentre,
    Fit,
    Profile,
}

/// The layout of a hello as it was written.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum LayoutField {
    Name(String),
    List(Vec<String>),
}

/// Everything a message may say. `None`, or `has_…` false, for fields that were not there.
#[derive(Debug, Clone)]
pub(super) struct Fields {
    pub kind: Option<Kind>,
    pub version: Option<f64>,
    pub source: Option<String>,
    pub fps: Option<f64>,
    pub layout: Option<LayoutField>,
    pub image: Option<[f64; 2]>,
    pub focal: Option<f64>,
    pub takeover: bool,
    pub resume: Option<f64>,
    pub resume_key: Option<String>,
    pub slot: Option<String>,
    pub priority: Option<f64>,
    pub groups: Option<ChannelGroups>,
    /// Of a hello, and those of a message of their own.
    pub settings: Option<Settings>,
    pub change: Settings,
    pub keep_neutral: bool,
    pub profile: Option<ProfileChoice>,
    /// Of the guided fit.
    pub step: Option<String>,
    pub seconds: Option<f64>,
    pub name: Option<String>,
    pub t: Option<f64>,
    pub face: Option<bool>,
    pub has_landmarks: bool,
    /// Points the message had; those past [`MAX_FEATURE_POINTS`] are counted, not kept.
    pub num_landmarks: usize,
    pub landmarks: Vec<[f32; 3]>,
    pub has_confidence: bool,
    pub confidence: Vec<f32>,
    pub has_weights: bool,
    pub weights: Box<[f32; NUM_ARKIT_SHAPES]>,
    pub has_expressions: bool,
    /// In the order of the character's table; 0 where it is not known.
    pub expressions: [f32; MAX_EXPRESSIONS],
    pub has_bones: bool,
    pub bones: Vec<(usize, Vec3)>,
    pub head_rotation: Option<Quat>,
    pub head_position: Option<Vec3>,
    /// The first value that breaks a rule; reading goes on behind it, so that malformed JSON is still found.
    pub problem: Option<MessageError>,
    /// The field that was being read when reading stopped.
    pub reading: &'static str,
}

impl Fields {
    pub fn new() -> Self {
        Self {
            kind: None,
            version: None,
            source: None,
            fps: None,
            layout: None,
            image: None,
            focal: None,
            takeover: false,
            resume: None,
            resume_key: None,
            slot: None,
            priority: None,
            groups: None,
            settings: None,
            change: Settings::default(),
            keep_neutral: false,
            profile: None,
            step: None,
            seconds: None,
            name: None,
            t: None,
            face: None,
            has_landmarks: false,
            num_landmarks: 0,
            landmarks: Vec::new(),
            has_confidence: false,
            confidence: Vec::new(),
            has_weights: false,
            weights: Box::new([0.0; NUM_ARKIT_SHAPES]),
            has_expressions: false,
            expressions: [0.0; MAX_EXPRESSIONS],
            has_bones: false,
            bones: Vec::new(),
            head_rotation: None,
            head_position: None,
            problem: None,
            reading: "",
        }
    }

    /// Empties the fields; the buffers stay, each is emptied when its field is read.
    fn clear(&mut self) {
        self.kind = None;
        (self.version, self.fps, self.focal, self.t) = (None, None, None, None);
        (self.source, self.layout, self.image) = (None, None, None);
        (self.takeover, self.resume, self.resume_key, self.keep_neutral) = (false, None, None, false);
        (self.slot, self.priority, self.groups) = (None, None, None);
        (self.settings, self.change) = (None, Settings::default());
        (self.profile, self.step, self.seconds, self.name) = (None, None, None, None);
        self.face = None;
        (self.has_landmarks, self.has_confidence, self.has_weights) = (false, false, false);
        (self.has_bones, self.has_expressions) = (false, false);
        (self.head_rotation, self.head_position) = (None, None);
        (self.problem, self.reading) = (None, "");
    }

    /// Reads `text`. Broken JSON and wrong types are errors here; broken rules stand in `problem`.
    pub fn read(&mut self, text: &str, names: Option<&Names>) -> Result<(), MessageError> {
        self.clear();
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let result = deserializer.deserialize_map(MessageVisitor { fields: self, names });
        let Err(error) = result.and_then(|()| deserializer.end()) else { return Ok(()) };
        let field = self.reading;
        Err(if error.is_data() {
            let place = if field.is_empty() { String::new() } else { format!("field {field}: ") };
            MessageError::new("wrong_type", format!("{place}{error}"))
        } else if field.is_empty() {
            MessageError::new("malformed_json", format!("message is not JSON: {error}"))
        } else {
            MessageError::new(
                "malformed_json",
                format!("message is not JSON: {error}, in field {field} (NaN and Infinity are no JSON numbers)"),
            )
        })
    }

    /// Notes the first broken rule.
    pub(super) fn refuse(&mut self, code: &'static str, message: impl FnOnce() -> String) {
        if self.problem.is_none() {
            self.problem = Some(MessageError::new(code, message()));
        }
    }
}

struct MessageVisitor<'a> {
    fields: &'a mut Fields,
    names: Option<&'a Names>,
}

/// The fields that mean something, as one word each; anything else is skipped.
enum Key {
    Known(&'static str),
    Unknown,
}

/// Every field of every message.
const KEYS: [&str; 32] = [
    "type",
    "t",
    "landmarks",
    "confidence",
    "weights",
    "expressions",
    "head",
    "bones",
    "face",
    "version",
    "source",
    "fps",
    "layout",
    "image",
    "focal",
    "takeover",
    "resume",
    "resume_key",
    "keep_neutral",
    "slot",
    "priority",
    "groups",
    "settings",
    "mirror",
    "gains",
    "smoothing",
    "swap_jaw",
    "swap_mouth",
    "profile",
    "step",
    "seconds",
    "name",
];

impl<'de> serde::Deserialize<'de> for Key {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct KeyVisitor;
        impl Visitor<'_> for KeyVisitor {
            type Value = Key;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a field name")
            }
            fn visit_str<E: Error>(self, key: &str) -> Result<Key, E> {
                Ok(KEYS.iter().find(|known| **known == key).map_or(Key::Unknown, |known| Key::Known(known)))
            }
        }
        deserializer.deserialize_str(KeyVisitor)
    }
}

impl<'de> Visitor<'de> for MessageVisitor<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object with a field \"type\"")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let Self { fields, names } = self;
        while let Some(key) = map.next_key::<Key>()? {
            let Key::Known(key) = key else {
                map.next_value::<IgnoredAny>()?;
                continue;
            };
            fields.reading = key;
            match key {
                "type" => {
                    let name = map.next_value_seed(Text(TYPES))?;
                    match name.as_str() {
                        "hello" => fields.kind = Some(Kind::Hello),
                        "frame" => fields.kind = Some(Kind::Frame),
                        "calibrate" => fields.kind = Some(Kind::Calibrate),
                        "settings" => fields.kind = Some(Kind::Settings),
                        "recentre" => fields.kind = Some(Kind::Recentre),
                        "fit" => fields.kind = Some(Kind::Fit),
                        "profile" => fields.kind = Some(Kind::Profile),
                        _ => fields.refuse("unknown_type", || format!("field type is {:?}, expected {TYPES}", cut(&name))),
                    }
                }
                "t" => fields.t = Some(map.next_value_seed(Number("seconds on the sender's clock"))?),
                "landmarks" => map.next_value_seed(Landmarks(fields))?,
                "confidence" => map.next_value_seed(Confidence(fields))?,
                "weights" => map.next_value_seed(Weights(fields))?,
                "head" => map.next_value_seed(Head(fields))?,
                "expressions" => map.next_value_seed(Expressions(fields, names.map(|names| names.expressions.as_slice())))?,
                "bones" => map.next_value_seed(Bones(fields, names.map(|names| &names.bones)))?,
                "face" => fields.face = Some(map.next_value_seed(Flag)?),
                "version" => fields.version = Some(map.next_value_seed(Number("the protocol's version, 1"))?),
                "source" => fields.source = Some(map.next_value_seed(Text("the sender's name"))?.chars().take(MAX_SOURCE).collect()),
                "fps" => fields.fps = Some(map.next_value_seed(Number("frames a second"))?),
                "layout" => fields.layout = Some(map.next_value_seed(LayoutSeed)?),
                "image" => {
                    let (size, count) = map.next_value_seed(Numbers::<2>("[width, height] in pixels"))?;
                    if count != 2 {
                        fields.refuse("wrong_count", || format!("field image has {count} numbers, expected 2: [width, height] in pixels"));
                    }
                    fields.image = Some(size);
                }
                "focal" => fields.focal = Some(map.next_value_seed(Number("pixels"))?),
                "takeover" => fields.takeover = map.next_value_seed(Flag)?,
                "resume" => fields.resume = Some(map.next_value_seed(Number("a session's number"))?),
                "resume_key" => fields.resume_key = Some(map.next_value_seed(Text("the key that ready told"))?),
                "slot" => fields.slot = Some(map.next_value_seed(Text("the name of a source slot"))?),
                "priority" => fields.priority = Some(map.next_value_seed(Number("a priority, 0 to 100"))?),
                "groups" => map.next_value_seed(Groups(fields))?,
                "settings" => fields.settings = Some(map.next_value()?),
                "mirror" => fields.change.mirror = Some(map.next_value_seed(Flag)?),
                "gains" => fields.change.gains = map.next_value()?,
                "smoothing" => fields.change.smoothing = map.next_value()?,
                "swap_jaw" => fields.change.swap_jaw = Some(map.next_value_seed(Flag)?),
                "swap_mouth" => fields.change.swap_mouth = Some(map.next_value_seed(Flag)?),
                "profile" => map.next_value_seed(ProfileSeed(fields))?,
                "step" => fields.step = Some(map.next_value_seed(Text("a step of the fit"))?),
                "seconds" => fields.seconds = Some(map.next_value_seed(Number("seconds to measure"))?),
                "name" => fields.name = Some(map.next_value_seed(Text("a profile's name"))?),
                _ => fields.keep_neutral = map.next_value_seed(Flag)?,
            }
            fields.reading = "";
        }
        Ok(())
    }
}
