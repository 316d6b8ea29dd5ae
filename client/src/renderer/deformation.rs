//! What deforms the face.

use super::RenderFrame;
use rhytid_shared::NUM_ARKIT_SHAPES;

/// What deforms the face: one or the other, never both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Deformation {
    /// The bones.
    #[default]
    Bones,
    /// The mesh's own expression shapes, for frames that carry weights and characters that have shapes; else the bones.
    /// The face's bones stay at rest: shapes move jaw, lids and eyeballs, too. The head is turned by its joint all the same.
    Shapes,
}

impl Deformation {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Bones, Self::Shapes];

    /// Its name on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bones => "bones",
            Self::Shapes => "shapes",
        }
    }

    /// The weights that deform `frame`; none where its bones do.
    pub fn weights_of(self, frame: &RenderFrame) -> Option<&[f32; NUM_ARKIT_SHAPES]> {
        match self {
            Self::Bones => None,
            Self::Shapes => frame.shapes.as_ref(),
        }
    }
}

impl std::fmt::Display for Deformation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// A name was none of [`Deformation::ALL`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("deformation {0:?} is unknown, expected one of: bones, shapes")]
pub struct DeformationError(String);

impl std::str::FromStr for Deformation {
    type Err = DeformationError;

    fn from_str(text: &str) -> Result<Self, DeformationError> {
        Self::ALL.into_iter().find(|deformation| deformation.name() == text).ok_or_else(|| DeformationError(text.to_owned()))
    }
}
