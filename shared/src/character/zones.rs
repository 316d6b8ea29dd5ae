//! Wrinkle zones after their checks.

use super::checked::{CharacterError, Pose, Result, Side};
use super::schema;
use crate::limits::{MAX_EXPRESSIONS, MAX_ZONES};
use std::collections::BTreeMap;

/// Wrinkle zones of a character ([J11]), checked: `z` zones, `e` expressions.
#[derive(Debug, Clone, PartialEq)]
pub struct Zones {
    /// The `z` zones, 1 to 8. Zone `i` is channel `i % 4` of mask `i / 4`.
    pub list: Vec<Zone>,
    /// Indices into glTF `textures`, one for every four zones begun; all of one size.
    pub masks: Vec<usize>,
    /// The wrinkles of all zones.
    pub map: ZoneMap,
    /// What takes the creases out of the neutral face where a zone's sum is below 0; of the size of `map`.
    pub stretch: Option<ZoneMap>,
    /// The same wrinkles as differences of unit normals: index into glTF `textures`; of the size of `map`.
    pub difference: Option<usize>,
    /// Distance from one wrinkle to the next, metres.
    pub wavelength: f32,
    /// The `e` expressions, at most 16.
    pub expressions: Vec<Expression>,
    /// How influences weigh on zones.
    pub bridge: Vec<BridgeRow>,
}

/// A wrinkle zone, checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Zone {
    /// Unique name.
    pub name: String,
    /// The half of the face it lies on; none for one in the middle.
    pub side: Option<Side>,
}

/// A map of partial derivatives: `p = (code - 128) / 127 * scale` in red and green.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZoneMap {
    /// Index into glTF `textures`.
    pub texture: usize,
    /// Largest slope the codes reach.
    pub scale: f32,
}

/// A row of the expression table, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Expression {
    /// Unique name.
    pub name: String,
    /// `z` weights, each within ±2.
    pub weights: Vec<f32>,
}

/// A share of a pose's influence at a bone in a zone, checked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BridgeRow {
    /// Index of the reference pose.
    pub pose: usize,
    /// Index of the bone.
    pub bone: usize,
    /// Index of the zone.
    pub zone: usize,
    /// What influence 1 adds to the zone's sum, within ±2.
    pub gain: f32,
}

impl Zones {
    /// Index of the expression called `name`.
    pub fn expression_index(&self, name: &str) -> Option<usize> {
        self.expressions.iter().position(|expression| expression.name == name)
    }
}

/// Largest weight of an expression on a zone, and gain of the bridge: twice what shows all of it.
const MOST_WEIGHT: f32 = 2.0;
/// Most rows of the bridge: each costs a multiplication a frame.
const MAX_BRIDGE_ROWS: usize = 512;
/// Wrinkles nearer to each other than pores, or farther apart than a forehead is high, are in another unit. Metres.
const WAVELENGTHS: std::ops::RangeInclusive<f32> = 0.0005..=0.05;

/// Checks everything but the images.
pub(super) fn check(given: &schema::Zones, poses: &[Pose], bones: &BTreeMap<&str, usize>) -> Result<Zones> {
    let num_zones = given.list.len();
    let refuse = |field: &str, problem: String| Err(CharacterError::field(format!("RHYTID_face.zones.{field}"), problem));
    if !(1..=MAX_ZONES).contains(&num_zones) {
        return refuse("list", format!("has {num_zones} zones, expected 1 to {MAX_ZONES}"));
    }
    check_names("list", given.list.iter().map(|zone| zone.name.as_str()))?;
    if given.masks.len() != num_zones.div_ceil(4) {
        return refuse(
            "masks",
            format!("has {} textures, expected {}: one for every four zones begun", given.masks.len(), num_zones.div_ceil(4)),
        );
    }
    if !WAVELENGTHS.contains(&given.wavelength) {
        return refuse(
            "wavelength",
            format!("is {}, expected metres from {} to {}", given.wavelength, WAVELENGTHS.start(), WAVELENGTHS.end()),
        );
    }
    if given.expressions.len() > MAX_EXPRESSIONS {
        return refuse("expressions", format!("has {} rows, at most {MAX_EXPRESSIONS} are allowed", given.expressions.len()));
    }
    check_names("expressions", given.expressions.iter().map(|expression| expression.name.as_str()))?;
    for (e, expression) in given.expressions.iter().enumerate() {
        if expression.weights.len() != num_zones {
            return refuse(
                &format!("expressions[{e}].weights"),
                format!("has {} values, expected {num_zones}, one a zone", expression.weights.len()),
            );
        }
        for (z, &weight) in expression.weights.iter().enumerate() {
            check_weight(&format!("expressions[{e}].weights[{z}]"), weight)?;
        }
    }
    Ok(Zones {
        list: given.list.iter().map(|zone| Zone { name: zone.name.clone(), side: zone.side }).collect(),
        masks: given.masks.clone(),
        map: check_map("map", &given.map)?,
        stretch: given.stretch.as_ref().map(|map| check_map("stretch", map)).transpose()?,
        difference: given.difference,
        wavelength: given.wavelength,
        expressions: given
            .expressions
            .iter()
            .map(|expression| Expression { name: expression.name.clone(), weights: expression.weights.clone() })
            .collect(),
        bridge: check_bridge(given, poses, bones)?,
    })
}

fn check_names<'a>(field: &str, names: impl Iterator<Item = &'a str> + Clone) -> Result<()> {
    for (i, name) in names.clone().enumerate() {
        if name.is_empty() || name.len() > 64 || names.clone().take(i).any(|other| other == name) {
            return Err(CharacterError::field(
                format!("RHYTID_face.zones.{field}[{i}].name"),
                format!("is {name:?}, expected 1 to 64 bytes, unique"),
            ));
        }
    }
    Ok(())
}

fn check_weight(field: &str, weight: f32) -> Result<()> {
    // False for NaN, too.
    if weight.abs() <= MOST_WEIGHT {
        return Ok(());
    }
    Err(CharacterError::field(format!("RHYTID_face.zones.{field}"), format!("is {weight}, expected finite and within ±{MOST_WEIGHT}")))
}

fn check_map(field: &str, map: &schema::ZoneMap) -> Result<ZoneMap> {
    if map.scale > 0.0 && map.scale <= 4.0 {
        return Ok(ZoneMap { texture: map.texture, scale: map.scale });
    }
    Err(CharacterError::field(format!("RHYTID_face.zones.{field}.scale"), format!("is {}, expected more than 0 and at most 4", map.scale)))
}

fn check_bridge(given: &schema::Zones, poses: &[Pose], bones: &BTreeMap<&str, usize>) -> Result<Vec<BridgeRow>> {
    if given.bridge.len() > MAX_BRIDGE_ROWS {
        return Err(CharacterError::field(
            "RHYTID_face.zones.bridge",
            format!("has {} rows, at most {MAX_BRIDGE_ROWS} are allowed", given.bridge.len()),
        ));
    }
    let mut rows = Vec::with_capacity(given.bridge.len());
    for (r, row) in given.bridge.iter().enumerate() {
        let find = |part: &str, name: &str, index: Option<usize>| {
            index.ok_or_else(|| {
                CharacterError::field(
                    format!("RHYTID_face.zones.bridge[{r}].{part}"),
                    format!("names {name:?}, which is no {part} of this character"),
                )
            })
        };
        check_weight(&format!("bridge[{r}].gain"), row.gain)?;
        rows.push(BridgeRow {
            pose: find("pose", &row.pose, poses.iter().position(|pose| pose.name == row.pose))?,
            bone: find("bone", &row.bone, bones.get(row.bone.as_str()).copied())?,
            zone: find("zone", &row.zone, given.list.iter().position(|zone| zone.name == row.zone))?,
            gain: row.gain,
        });
    }
    Ok(rows)
}
