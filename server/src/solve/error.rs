//! What can be wrong with a session or a frame once its messages have been parsed.

use super::config::ConfigError;

/// Why a session or a frame was refused. Each message names the field and what was expected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// The settings are out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The hello's layout names a point the character does not have.
    #[error("layout[{index}] is {name:?}, expected a feature point or bone of the character")]
    UnknownFeature {
        /// Place in the list.
        index: usize,
        /// The name.
        name: String,
    },
    /// The hello's layout names a point twice.
    #[error("layout[{index}] is {name:?} a second time, expected each point once")]
    RepeatedFeature {
        /// Place in the list.
        index: usize,
        /// The name.
        name: String,
    },
    /// Too few points to place a face.
    #[error("layout has {got} points, expected at least {expected}")]
    TooFewFeatures {
        /// Points in the layout.
        got: usize,
        /// What a regression needs.
        expected: usize,
    },
    /// Landmarks without the picture's size.
    #[error("hello.image is missing, expected [width, height] in pixels of the picture the landmarks are in")]
    NoImage,
    /// The picture's size or the focal length makes no sense.
    #[error("hello.{field} is {got}, expected finite and more than 0")]
    BadCamera {
        /// `image` or `focal`.
        field: &'static str,
        /// Its value.
        got: f32,
    },
    /// No lens has such a focal length.
    #[error("hello.focal is {got}, expected {least} to {most} pixels, a tenth to fifty times the picture's width")]
    FocalRange {
        /// Its value.
        got: f32,
        /// Shortest, pixels.
        least: f32,
        /// Longest, pixels.
        most: f32,
    },
    /// Landmarks in a session whose hello named no layout.
    #[error("frame has landmarks, but hello.layout is missing")]
    NoLayout,
    /// A feed that asks for a profile by name.
    #[error("profile {name:?} is asked for by its name, which only a server with a folder of profiles knows")]
    NamedProfile {
        /// The name.
        name: String,
    },
    /// Time stood still, went back, or on by less than a packet can tell.
    #[error("t is {got} s, expected a microsecond or more after the frame before it, {previous} s")]
    Time {
        /// The frame's time.
        got: f64,
        /// The previous accepted frame's.
        previous: f64,
    },
    /// Time is no number, or none that a clock could show.
    #[error("t is {got}, expected seconds from 0 to 9e9")]
    TimeRange {
        /// The frame's time.
        got: f64,
    },
    /// The wrong number of points.
    #[error("landmarks has {got} points, expected {expected}")]
    PointCount {
        /// Points in the frame.
        got: usize,
        /// Points of the layout.
        expected: usize,
    },
    /// The wrong number of confidences.
    #[error("confidence has {got} entries, expected {expected} or none")]
    ConfidenceCount {
        /// Entries in the frame.
        got: usize,
        /// Points of the layout.
        expected: usize,
    },
    /// A value that is not finite or far outside anything a tracker gives.
    #[error("{field}[{index}] is {got}, expected finite and {expected}")]
    Value {
        /// `landmarks`, `confidence`, `weights`, `bones`, `head.rotation` or `head.position`.
        field: &'static str,
        /// Index of the point, shape or bone.
        index: usize,
        /// The value.
        got: f32,
        /// The range.
        expected: &'static str,
    },
    /// A bone the character does not have.
    #[error("bones names bone {got}, but the character has {num_bones}")]
    BoneIndex {
        /// Its index.
        got: usize,
        /// Bones of the character.
        num_bones: usize,
    },
    /// The points do not span a face (all in one place, or on one line).
    #[error("landmarks do not span a face: {problem}")]
    NoFaceShape {
        /// What is degenerate.
        problem: &'static str,
    },
    /// A restored calibration belongs to another layout or was damaged.
    #[error("calibration {problem}")]
    BadCalibration {
        /// What was wrong and what was expected.
        problem: String,
    },
}
