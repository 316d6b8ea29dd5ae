//! The fields of a publish message, read straight into reused buffers: no tree of JSON is built, because the tree of
//! one frame of 478 points costs more time than everything the solve does with it.

use super::MessageError;
use super::profile::{Profile, ProfileChoice};
use super::reader::{Names, TYPES};
use super::settings::Settings;
use super::slot::{ChannelGroup, ChannelGroups};
use crate::limits::{MAX_EXPRESSIONS, MAX_FEATURE_POINTS, MAX_HEAD_TRAVEL};
use crate::names::{ArkitShape, NUM_ARKIT_SHAPES, RoomName};
use glam::{Quat, Vec3};
use serde::de::{DeserializeSeed, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use std::collections::BTreeMap;
use std::fmt;

/// Farthest a landmark may lie from the picture's origin, pixels: more than any camera has, less than what overflows.
pub(super) const MAX_PIXELS: f64 = 1e5;
/// Largest weight that still reads as a slip of a tracker and not as another unit (percent, degrees).
const MAX_WEIGHT: f64 = 10.0;
/// Largest weight passed on; trackers overshoot 1 a little.
const WEIGHT_CEILING: f64 = 1.2;
/// Largest amount of an expression, as of a weight.
const MAX_AMOUNT: f64 = 1.2;
/// A bone's point this far from the origin of head space, metres, is in another unit.
const MAX_POINT: f64 = 1.0;
/// A head this far from its neutral place, metres, is in another unit.
const MAX_HEAD: f64 = 10.0;
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
        (self.takeover, self.keep_neutral) = (false, false);
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
    fn refuse(&mut self, code: &'static str, message: impl FnOnce() -> String) {
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
const KEYS: [&str; 30] = [
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

/// A piece of what the sender wrote, short enough for an error.
pub(super) fn cut(text: &str) -> String {
    text.chars().take(40).collect()
}

/// A number; the text says what it stands for.
struct Number(&'static str);

impl<'de> DeserializeSeed<'de> for Number {
    type Value = f64;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<f64, D::Error> {
        deserializer.deserialize_f64(self)
    }
}

impl Visitor<'_> for Number {
    type Value = f64;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a number ({})", self.0)
    }
    fn visit_f64<E: Error>(self, value: f64) -> Result<f64, E> {
        Ok(value)
    }
    fn visit_u64<E: Error>(self, value: u64) -> Result<f64, E> {
        Ok(value as f64)
    }
    fn visit_i64<E: Error>(self, value: i64) -> Result<f64, E> {
        Ok(value as f64)
    }
}

/// Up to `N` numbers; gives them with how many there were.
struct Numbers<const N: usize>(&'static str);

impl<'de, const N: usize> DeserializeSeed<'de> for Numbers<N> {
    type Value = ([f64; N], usize);
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, const N: usize> Visitor<'de> for Numbers<N> {
    type Value = ([f64; N], usize);
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0)
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Self::Value, A::Error> {
        let (mut values, mut count) = ([0.0; N], 0);
        while let Some(value) = seq.next_element_seed(Number(self.0))? {
            if let Some(slot) = values.get_mut(count) {
                *slot = value;
            }
            count += 1;
        }
        Ok((values, count))
    }
}

/// A short text; the text says what it stands for.
struct Text(&'static str);

impl<'de> DeserializeSeed<'de> for Text {
    type Value = String;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<String, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for Text {
    type Value = String;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "text ({})", self.0)
    }
    fn visit_str<E: Error>(self, value: &str) -> Result<String, E> {
        Ok(value.to_owned())
    }
}

struct Flag;

impl<'de> DeserializeSeed<'de> for Flag {
    type Value = bool;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<bool, D::Error> {
        deserializer.deserialize_bool(self)
    }
}

impl Visitor<'_> for Flag {
    type Value = bool;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("true or false")
    }
    fn visit_bool<E: Error>(self, value: bool) -> Result<bool, E> {
        Ok(value)
    }
}

struct LayoutSeed;

impl<'de> DeserializeSeed<'de> for LayoutSeed {
    type Value = LayoutField;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<LayoutField, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for LayoutSeed {
    type Value = LayoutField;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of a layout or a list of feature points")
    }
    fn visit_str<E: Error>(self, value: &str) -> Result<LayoutField, E> {
        Ok(LayoutField::Name(value.to_owned()))
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<LayoutField, A::Error> {
        let mut names = Vec::new();
        while let Some(name) = seq.next_element_seed(Text("the name of a feature point"))? {
            // One more than allowed is kept, for the check to see.
            if names.len() <= MAX_FEATURE_POINTS {
                names.push(name);
            }
        }
        Ok(LayoutField::List(names))
    }
}

/// A profile, or the name of one.
struct ProfileSeed<'a>(&'a mut Fields);

impl<'de> DeserializeSeed<'de> for ProfileSeed<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for ProfileSeed<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a profile, or the name of one that the server keeps")
    }
    fn visit_str<E: Error>(self, name: &str) -> Result<(), E> {
        match RoomName::new(name) {
            Ok(name) => self.0.profile = Some(ProfileChoice::Named(name)),
            Err(_) => self.0.refuse("out_of_range", || {
                format!("field profile is {:?}, expected a profile, or a name of 1 to 64 characters of A-Z a-z 0-9 _ -", cut(name))
            }),
        }
        Ok(())
    }
    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<(), A::Error> {
        let profile = <Profile as serde::Deserialize>::deserialize(serde::de::value::MapAccessDeserializer::new(map))?;
        match profile.check() {
            Ok(()) => self.0.profile = Some(ProfileChoice::Given(Box::new(profile))),
            Err(error) => self.0.refuse(error.code, || format!("field profile: {}", error.message)),
        }
        Ok(())
    }
}

struct Groups<'a>(&'a mut Fields);

impl<'de> DeserializeSeed<'de> for Groups<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Groups<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of channel groups")
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        let fields = self.0;
        let mut groups = ChannelGroups::NONE;
        while let Some(name) = seq.next_element_seed(Text("a channel group"))? {
            match ChannelGroup::from_name(&name) {
                Some(group) => groups = groups.with(group),
                None => fields.refuse("out_of_range", || {
                    format!("field groups has {:?}, expected brows, lids, gaze, mouth and head only", cut(&name))
                }),
            }
        }
        if groups == ChannelGroups::NONE {
            fields.refuse("out_of_range", || "field groups is empty, expected at least one of brows, lids, gaze, mouth, head".to_owned());
        }
        fields.groups = Some(groups);
        Ok(())
    }
}

const LANDMARKS: &str = "an array of [x, y] or [x, y, z] in pixels";

struct Landmarks<'a>(&'a mut Fields);

impl<'de> DeserializeSeed<'de> for Landmarks<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Landmarks<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(LANDMARKS)
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        let fields = self.0;
        fields.has_landmarks = true;
        fields.landmarks.clear();
        let mut index = 0;
        while let Some((point, count)) = seq.next_element_seed(Numbers::<3>("[x, y] or [x, y, z] in pixels"))? {
            if !(2..=3).contains(&count) {
                fields.refuse("wrong_count", || format!("field landmarks[{index}] has {count} numbers, expected 2 or 3"));
            }
            // False for NaN, too.
            if !point.iter().all(|value| value.abs() <= MAX_PIXELS) {
                fields.refuse("out_of_range", || format!("field landmarks[{index}] is {point:?}, expected pixels within ±{MAX_PIXELS}"));
            }
            if index < MAX_FEATURE_POINTS {
                fields.landmarks.push(point.map(|value| value as f32));
            }
            index += 1;
        }
        fields.num_landmarks = index;
        Ok(())
    }
}

struct Confidence<'a>(&'a mut Fields);

impl<'de> DeserializeSeed<'de> for Confidence<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Confidence<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of confidences, one a landmark")
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        // A tracker's rounding; anything farther out is no confidence.
        const SLACK: f64 = 0.01;
        let fields = self.0;
        fields.has_confidence = true;
        fields.confidence.clear();
        while let Some(value) = seq.next_element_seed(Number("a confidence, 0 to 1"))? {
            let index = fields.confidence.len();
            if !(-SLACK..=1.0 + SLACK).contains(&value) {
                fields.refuse("out_of_range", || format!("field confidence[{index}] is {value}, expected 0 to 1"));
            }
            // One more than allowed is kept, so that the count shows as wrong.
            if index <= MAX_FEATURE_POINTS {
                fields.confidence.push(value.clamp(0.0, 1.0) as f32);
            }
        }
        Ok(())
    }
}

struct Weights<'a>(&'a mut Fields);

impl<'de> DeserializeSeed<'de> for Weights<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

/// An expression shape by name; `None` for names that are none (`_neutral`, a tracker's own).
struct ShapeKey(Option<ArkitShape>);

impl<'de> serde::Deserialize<'de> for ShapeKey {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ShapeVisitor;
        impl Visitor<'_> for ShapeVisitor {
            type Value = ShapeKey;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of an expression")
            }
            fn visit_str<E: Error>(self, name: &str) -> Result<ShapeKey, E> {
                Ok(ShapeKey(ArkitShape::from_name(name)))
            }
        }
        deserializer.deserialize_str(ShapeVisitor)
    }
}

impl<'de> Visitor<'de> for Weights<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object of expression weights by ARKit name")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let fields = self.0;
        fields.has_weights = true;
        fields.weights.fill(0.0);
        let (mut num_known, mut num_unknown) = (0, 0);
        while let Some(ShapeKey(shape)) = map.next_key()? {
            let value = map.next_value_seed(Number("a weight, 0 to 1"))?;
            let Some(shape) = shape else {
                num_unknown += 1;
                continue;
            };
            num_known += 1;
            if value.abs() > MAX_WEIGHT {
                fields.refuse("out_of_range", || format!("field weights.{} is {value}, expected 0 to 1", shape.name()));
            }
            fields.weights[shape.index()] = value.clamp(0.0, WEIGHT_CEILING) as f32;
        }
        if num_known == 0 && num_unknown > 0 {
            fields.refuse("unknown_shape", || {
                format!("field weights has {num_unknown} names and none is an ARKit shape, expected jawOpen, browInnerUp, …")
            });
        }
        Ok(())
    }
}

struct Expressions<'a>(&'a mut Fields, Option<&'a [String]>);

impl<'de> DeserializeSeed<'de> for Expressions<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

/// An expression by name, or the name where the character has no such expression.
struct ExpressionKey<'a>(&'a [String]);

impl<'de> DeserializeSeed<'de> for ExpressionKey<'_> {
    type Value = Result<usize, String>;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for ExpressionKey<'_> {
    type Value = Result<usize, String>;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of an expression")
    }
    fn visit_str<E: Error>(self, name: &str) -> Result<Self::Value, E> {
        Ok(self.0.iter().position(|known| known == name).ok_or_else(|| cut(name)))
    }
}

impl<'de> Visitor<'de> for Expressions<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object of amounts by the character's names of expressions")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let Self(fields, names) = self;
        fields.has_expressions = true;
        fields.expressions.fill(0.0);
        let known = names.unwrap_or_default();
        while let Some(expression) = map.next_key_seed(ExpressionKey(known))? {
            let value = map.next_value_seed(Number("an amount, 0 to 1.2"))?;
            let name = || expression.as_ref().map_or_else(String::as_str, |&index| known[index].as_str());
            // False for NaN, too.
            if !(0.0..=MAX_AMOUNT).contains(&value) {
                fields.refuse("out_of_range", || format!("field expressions.{} is {value}, expected 0 to {MAX_AMOUNT}", name()));
            }
            match &expression {
                // A checked character has no more than fit.
                Ok(index) => fields.expressions[*index] = value as f32,
                Err(_) if known.is_empty() => {}
                Err(name) => fields.refuse("unknown_expression", || {
                    format!("field expressions.{name} is no expression of this character, expected {}", known.join(", "))
                }),
            }
        }
        Ok(())
    }
}

struct Bones<'a>(&'a mut Fields, Option<&'a BTreeMap<String, usize>>);

impl<'de> DeserializeSeed<'de> for Bones<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

/// A bone by name, or the name where the character has no such bone.
struct BoneKey<'a>(Option<&'a BTreeMap<String, usize>>);

impl<'de> DeserializeSeed<'de> for BoneKey<'_> {
    type Value = Result<usize, String>;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for BoneKey<'_> {
    type Value = Result<usize, String>;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of a bone")
    }
    fn visit_str<E: Error>(self, name: &str) -> Result<Self::Value, E> {
        Ok(self.0.and_then(|names| names.get(name)).copied().ok_or_else(|| cut(name)))
    }
}

impl<'de> Visitor<'de> for Bones<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object of points [x, y, z] by bone name")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let Self(fields, names) = self;
        fields.has_bones = true;
        fields.bones.clear();
        while let Some(bone) = map.next_key_seed(BoneKey(names))? {
            let (point, count) = map.next_value_seed(Numbers::<3>("[x, y, z] in metres, head space"))?;
            let bone = match bone {
                Ok(bone) => bone,
                Err(_) if names.is_none() => continue,
                Err(name) => {
                    fields.refuse("unknown_bone", || format!("field bones.{name} is no bone of this character; the view hello lists them"));
                    continue;
                }
            };
            if count != 3 || !point.iter().all(|value| value.abs() <= MAX_POINT) {
                let name = || names.into_iter().flatten().find(|(_, index)| **index == bone).map_or("", |(name, _)| name.as_str());
                fields.refuse("out_of_range", || {
                    format!(
                        "field bones.{} is {:?}, expected 3 numbers, metres in head space within ±{MAX_POINT}",
                        name(),
                        &point[..count.min(3)]
                    )
                });
            }
            // A name twice in one object: the last one counts, and the buffer cannot outgrow the character.
            let point = Vec3::from(point.map(|value| value as f32));
            match fields.bones.iter_mut().find(|(index, _)| *index == bone) {
                Some(slot) => slot.1 = point,
                None => fields.bones.push((bone, point)),
            }
        }
        Ok(())
    }
}

struct Head<'a>(&'a mut Fields);

impl<'de> DeserializeSeed<'de> for Head<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Head<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with rotation [x, y, z, w] and position [x, y, z]")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        /// Fields of the head.
        #[derive(serde::Deserialize)]
        #[serde(rename_all = "snake_case")]
        enum HeadKey {
            Rotation,
            Position,
            #[serde(other)]
            Unknown,
        }
        let fields = self.0;
        while let Some(key) = map.next_key()? {
            match key {
                HeadKey::Rotation => {
                    let (q, count) = map.next_value_seed(Numbers::<4>("a quaternion [x, y, z, w]"))?;
                    let length = q.iter().map(|value| value * value).sum::<f64>().sqrt();
                    // A tracker's quaternion is of unit length but for rounding; far from it, it is something else.
                    if count != 4 || !(0.1..=10.0).contains(&length) {
                        fields.refuse("out_of_range", || {
                            format!("field head.rotation is {:?}, expected a unit quaternion [x, y, z, w]", &q[..count.min(4)])
                        });
                    } else {
                        let [x, y, z, w] = q.map(|value| (value / length) as f32);
                        fields.head_rotation = Some(Quat::from_xyzw(x, y, z, w));
                    }
                }
                HeadKey::Position => {
                    let (p, count) = map.next_value_seed(Numbers::<3>("[x, y, z] in metres"))?;
                    if count != 3 || !p.iter().all(|value| value.abs() <= MAX_HEAD) {
                        fields.refuse("out_of_range", || {
                            format!(
                                "field head.position is {:?}, expected 3 numbers, metres from neutral within ±{MAX_HEAD}",
                                &p[..count.min(3)]
                            )
                        });
                    } else {
                        let travel = f64::from(MAX_HEAD_TRAVEL);
                        fields.head_position = Some(Vec3::from(p.map(|value| value.clamp(-travel, travel) as f32)));
                    }
                }
                HeadKey::Unknown => {
                    map.next_value::<IgnoredAny>()?;
                }
            }
        }
        Ok(())
    }
}
