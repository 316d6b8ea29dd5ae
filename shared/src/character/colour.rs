//! Colour that follows the face, after its checks.

use super::checked::{CharacterError, Pose, Result};
use super::schema;
use super::zones::Zones;

/// Blood under the skin and what poses do to it, checked. Amounts of haemoglobin are optical densities along its direction.
#[derive(Debug, Clone, PartialEq)]
pub struct Colour {
    /// Index into glTF `textures`: amount at rest and its mean all round as shares of `most`, share of the left half.
    pub base: usize,
    /// Most haemoglobin a place can hold.
    pub most: f32,
    /// What poses and zones do, each once at most.
    pub changes: Vec<ColourChange>,
    /// Multiplies what the changes do to the colour, 0 to 4.
    pub strength: f32,
}

/// What a change of the blood follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColourDriver {
    /// Index of the reference pose: its mean influence on each half of the face.
    Pose(usize),
    /// Index of the wrinkle zone: how strongly its wrinkles show.
    Zone(usize),
}

/// What a pose or a zone does to the blood, checked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColourChange {
    /// What it follows.
    pub driver: ColourDriver,
    /// Index into glTF `textures`: spread in red, shift in green, as `(code - 128) / 127` of the two below.
    pub texture: usize,
    /// Largest change of the unevenness: its ratio less 1.
    pub spread: f32,
    /// Largest change of the amount.
    pub shift: f32,
}

/// Skin with three times the blood of lips is no skin: another unit.
const MOST_BLOOD: f32 = 5.0;
/// Nothing shows more than four times as much as it was measured.
const MOST_STRENGTH: f32 = 4.0;

/// Checks everything but the images.
pub(super) fn check(given: &schema::Colour, poses: &[Pose], zones: Option<&Zones>) -> Result<Colour> {
    let refuse = |field: &str, problem: String| Err(CharacterError::field(format!("RHYTID_face.colour.{field}"), problem));
    // Written so that NaN is refused, too.
    let is_within = |value: f32, most: f32| value > 0.0 && value <= most;
    if !is_within(given.most, MOST_BLOOD) {
        return refuse("most", format!("is {}, expected more than 0 and at most {MOST_BLOOD}", given.most));
    }
    if !(0.0..=MOST_STRENGTH).contains(&given.strength) {
        return refuse("strength", format!("is {}, expected 0 to {MOST_STRENGTH}", given.strength));
    }
    let mut changes: Vec<ColourChange> = Vec::with_capacity(poses.len());
    for (c, change) in given.changes.iter().enumerate() {
        let (field, name, found) = match (&change.pose, &change.zone) {
            (Some(name), None) => ("pose", name, poses.iter().position(|pose| pose.name == *name).map(ColourDriver::Pose)),
            (None, Some(name)) => {
                let list = zones.map_or(&[][..], |zones| &zones.list);
                ("zone", name, list.iter().position(|zone| zone.name == *name).map(ColourDriver::Zone))
            }
            _ => return refuse(&format!("changes[{c}]"), "names a pose and a zone or neither, expected one of both".into()),
        };
        let Some(driver) = found else {
            return refuse(&format!("changes[{c}].{field}"), format!("names {name:?}, which is no {field} of this character"));
        };
        if changes.iter().any(|other| other.driver == driver) {
            return refuse(&format!("changes[{c}].{field}"), format!("names {name:?}, which has its change already"));
        }
        for (field, value, most) in [("spread", change.spread, 4.0), ("shift", change.shift, given.most)] {
            if !is_within(value, most) {
                return refuse(&format!("changes[{c}].{field}"), format!("is {value}, expected more than 0 and at most {most}"));
            }
        }
        changes.push(ColourChange { driver, texture: change.texture, spread: change.spread, shift: change.shift });
    }
    Ok(Colour { base: given.base, most: given.most, changes, strength: given.strength })
}
