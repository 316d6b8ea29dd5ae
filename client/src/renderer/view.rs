//! What a drawing shows and how wrinkle maps are blended.

use rhytid_shared::Character;

/// What is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ViewMode {
    /// The face with its wrinkles.
    #[default]
    Beauty,
    /// The face without its wrinkles, by the pipeline that has no wrinkle code.
    Bare,
    /// How strongly reference poses show, as a heat map over a grey face: one pose by its index, or all in their own hues.
    Influence(Option<usize>),
    /// World-space normals after skinning and wrinkles, `n * 0.5 + 0.5`.
    Normals,
    /// The triangles' edges.
    Wireframe,
    /// Left half of the picture with wrinkles, right half without.
    Split,
    /// One part of the light.
    Term(Term),
    /// Masks of the wrinkle zones over a grey face: one zone by its index as a heat map, or all in their own hues.
    Masks(Option<usize>),
    /// Skinning weights of the face's bones, which serve as the masks of the reference poses, each bone in its own hue.
    BoneMasks,
    /// The face of its expression shapes, and how far they move it as a heat map: red at 12 mm.
    ShapeDeltas,
}

/// A part of the light, shown by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Term {
    /// What comes out of the skin, scattered.
    Diffuse,
    /// Highlights.
    Specular,
    /// What scattering changes, about a middle grey.
    Scattering,
    /// What the key light sends through thin flesh.
    Translucency,
    /// Where blood comes (red) and goes (cyan) as the face moves, over a grey face.
    Blood,
}

impl Term {
    /// Every term.
    pub const ALL: [Self; 5] = [Self::Diffuse, Self::Specular, Self::Scattering, Self::Translucency, Self::Blood];

    /// Its name on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Diffuse => "diffuse",
            Self::Specular => "specular",
            Self::Scattering => "scattering",
            Self::Translucency => "translucency",
            Self::Blood => "blood",
        }
    }
}

/// Why a view's name was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("view {got:?} is unknown, expected one of: {expected}")]
pub struct ViewError {
    /// What was given.
    pub got: String,
    /// The names this character knows.
    pub expected: String,
}

impl ViewMode {
    /// Every view of `character`, in the order a list of them should have.
    pub fn all(character: &Character) -> Vec<Self> {
        let mut views = vec![Self::Beauty, Self::Bare, Self::Split, Self::Influence(None)];
        views.extend((0..character.num_poses()).map(|k| Self::Influence(Some(k))));
        views.extend([Self::Normals, Self::Wireframe]);
        views.extend(Term::ALL.map(Self::Term));
        if character.num_zones() > 0 {
            views.push(Self::Masks(None));
            views.extend((0..character.num_zones()).map(|z| Self::Masks(Some(z))));
        }
        views.push(Self::BoneMasks);
        if !character.shapes.is_empty() {
            views.push(Self::ShapeDeltas);
        }
        views
    }

    /// Reads `beauty`, `bare`, `split`, `influence`, `influence:POSE` (a pose's name), `normals`, `wireframe`, a term of
    /// the light, `masks`, `masks:ZONE`, `bone-masks` or `shape-deltas`; the masks and shapes only where the character has them.
    pub fn parse(text: &str, character: &Character) -> Result<Self, ViewError> {
        let all = Self::all(character);
        all.iter().copied().find(|view| view.name(character) == text).ok_or_else(|| ViewError {
            got: text.to_owned(),
            expected: all.iter().map(|view| view.name(character)).collect::<Vec<_>>().join(", "),
        })
    }

    /// The name that [`ViewMode::parse`] reads.
    pub fn name(self, character: &Character) -> String {
        match self {
            Self::Beauty => "beauty".into(),
            Self::Bare => "bare".into(),
            Self::Influence(None) => "influence".into(),
            Self::Influence(Some(k)) => match character.poses.get(k) {
                Some(pose) => format!("influence:{}", pose.name),
                None => format!("influence:{k}"),
            },
            Self::Normals => "normals".into(),
            Self::Wireframe => "wireframe".into(),
            Self::Split => "split".into(),
            Self::Term(term) => term.name().into(),
            Self::Masks(None) => "masks".into(),
            Self::Masks(Some(z)) => match character.zones.as_ref().and_then(|zones| zones.list.get(z)) {
                Some(zone) => format!("masks:{}", zone.name),
                None => format!("masks:{z}"),
            },
            Self::BoneMasks => "bone-masks".into(),
            Self::ShapeDeltas => "shape-deltas".into(),
        }
    }

    /// True for views of light rather than of numbers: they are scattered and toned.
    pub fn is_lit(self) -> bool {
        !matches!(
            self,
            Self::Influence(_)
                | Self::Normals
                | Self::Wireframe
                | Self::Term(Term::Blood)
                | Self::Masks(_)
                | Self::BoneMasks
                | Self::ShapeDeltas
        )
    }
}

/// How a base normal and wrinkle maps become one normal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum BlendMode {
    /// Sum of partial derivatives: `p = base + Σ Inf_k delta_k`, `n = normalize(p, 1)` (Jimenez et al. 2011, 1.2).
    #[default]
    PartialDerivatives,
    /// Weighted mean of whole normals that contain the pores (Dutreve et al. 2009, 5.3, first case).
    Simple,
    /// The formula as Dutreve et al. 2009, 5.3, print it for maps of wrinkles alone, with the rest term it lacks.
    Printed,
}

impl BlendMode {
    /// All modes.
    pub const ALL: [Self; 3] = [Self::PartialDerivatives, Self::Simple, Self::Printed];

    /// The mode's name on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::PartialDerivatives => "pd",
            Self::Simple => "simple",
            Self::Printed => "printed",
        }
    }
}

impl std::fmt::Display for BlendMode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// A blend mode's name was none of [`BlendMode::ALL`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("blend {0:?} is unknown, expected one of: pd, simple, printed")]
pub struct BlendError(String);

impl std::str::FromStr for BlendMode {
    type Err = BlendError;

    fn from_str(text: &str) -> Result<Self, BlendError> {
        Self::ALL.into_iter().find(|mode| mode.name() == text).ok_or_else(|| BlendError(text.to_owned()))
    }
}

/// Whose wrinkles are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WrinkleSystem {
    /// Those of the bones where the character has reference poses with maps, else those of its zones.
    #[default]
    Own,
    /// Those of the bones' reference poses (Dutreve et al. 2009).
    Bones,
    /// Those of the zones (Jimenez et al. 2011).
    Zones,
    /// Both, one over the other.
    Both,
}

/// How the zones' wrinkles are blended over what is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ZoneBlend {
    /// Their partial derivatives are added (Jimenez et al. 2011, 1.2).
    #[default]
    PartialDerivatives,
    /// Differences of unit normals are added and the sum made unit again (1.2.1).
    Difference,
    /// Two maps, one for wrinkled and one for stretched skin, by Whiteout (Oat 2007).
    TwoMaps,
}

impl ZoneBlend {
    /// `ZONES` in `wrinkles.wgsl`.
    pub(super) fn number(self) -> u8 {
        match self {
            Self::PartialDerivatives => 1,
            Self::Difference => 2,
            Self::TwoMaps => 3,
        }
    }
}

/// A name was none of those expected.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{got:?} is unknown, expected one of: {expected}")]
pub struct NameError {
    /// What was given.
    pub got: String,
    /// What there is.
    pub expected: String,
}

/// Names of the values of an enum, for command lines.
macro_rules! named {
    ($ty:ty, [$($value:ident: $name:literal),+ $(,)?]) => {
        impl $ty {
            /// All of them, in the order a list should have.
            pub const ALL: &'static [Self] = &[$(Self::$value),+];

            /// Its name on command lines.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$value => $name),+
                }
            }
        }

        impl std::fmt::Display for $ty {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }

        impl std::str::FromStr for $ty {
            type Err = NameError;

            fn from_str(text: &str) -> Result<Self, NameError> {
                Self::ALL.iter().copied().find(|value| value.name() == text).ok_or_else(|| NameError {
                    got: text.to_owned(),
                    expected: Self::ALL.iter().map(|value| value.name()).collect::<Vec<_>>().join(", "),
                })
            }
        }
    };
}

named!(WrinkleSystem, [Own: "own", Bones: "bones", Zones: "zones", Both: "both"]);
named!(ZoneBlend, [PartialDerivatives: "pd", Difference: "difference", TwoMaps: "two-maps"]);
