//! How the skin's colour follows the face.

use serde::{Deserialize, Serialize};

/// Blood under the skin at rest and what each reference pose or wrinkle zone does to it (Jimenez, Scully and others 2010, "A practical
/// appearance model for dynamic facial color"). Amounts of haemoglobin are optical densities along its direction:
/// `albedo * exp(-amount * (0.2988, 0.6838, 0.6657))`, linear RGB. With a pose's amount `a`, the mean influence over the
/// bones it moves on that half of the face, or with a zone's weight,
/// `H = clamp(H0 + sum over changes of a * (spread * (H0 - mean) + shift), 0, most)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Colour {
    /// Index into glTF `textures`: a PNG, linear, a square with a power of two a side (64). Red: `H0 / most`; green: its mean
    /// all round, likewise; blue: how much a place belongs to the left half of the face.
    pub base: usize,
    /// Most haemoglobin a place can hold: what code 255 of the base stands for.
    pub most: f32,
    /// One a pose and one a zone at most.
    pub changes: Vec<ColourChange>,
    /// Multiplies what the changes do to the colour.
    #[serde(default = "whole")]
    pub strength: f32,
}

/// What a pose does to the blood, or, for characters without reference poses, a wrinkle zone. One of both is named.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ColourChange {
    /// Name of the reference pose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<String>,
    /// Name of the wrinkle zone. One that lies on a half of the face changes that half alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zone: Option<String>,
    /// Index into glTF `textures`: a PNG, linear, of the base's size. `(code - 128) / 127` in red times `spread` is how much more
    /// uneven the blood becomes (ratio less 1), in green times `shift` how much more of it there is.
    pub texture: usize,
    /// See `texture`.
    pub spread: f32,
    /// See `texture`.
    pub shift: f32,
}

fn whole() -> f32 {
    1.0
}
