//! The values of a publish message's fields, each read straight into its buffer and held to its rules.

use super::fields::{Fields, LayoutField};
use super::profile::{Profile, ProfileChoice};
use super::slot::{ChannelGroup, ChannelGroups};
use crate::limits::{MAX_FEATURE_POINTS, MAX_HEAD_TRAVEL};
use crate::names::{ArkitShape, RoomName};
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

/// A piece of what the sender wrote, short enough for an error.
pub(super) fn cut(text: &str) -> String {
    text.chars().take(40).collect()
}

/// A number; the text says what it stands for.
pub(super) struct Number(pub(super) &'static str);

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
pub(super) struct Numbers<const N: usize>(pub(super) &'static str);

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
pub(super) struct Text(pub(super) &'static str);

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

pub(super) struct Flag;

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

pub(super) struct LayoutSeed;

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
pub(super) struct ProfileSeed<'a>(pub(super) &'a mut Fields);

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

pub(super) struct Groups<'a>(pub(super) &'a mut Fields);

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

pub(super) struct Landmarks<'a>(pub(super) &'a mut Fields);

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

pub(super) struct Confidence<'a>(pub(super) &'a mut Fields);

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

pub(super) struct Weights<'a>(pub(super) &'a mut Fields);

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

pub(super) struct Expressions<'a>(pub(super) &'a mut Fields, pub(super) Option<&'a [String]>);

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

pub(super) struct Bones<'a>(pub(super) &'a mut Fields, pub(super) Option<&'a BTreeMap<String, usize>>);

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

pub(super) struct Head<'a>(pub(super) &'a mut Fields);

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
