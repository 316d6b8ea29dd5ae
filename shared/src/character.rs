//! A character: the description that stands in its `.glb` under `RHYTID_face`, checked once, at load.
//!
//! [`schema`] is the JSON as it is written; [`Character`] is what is left after the checks and cannot hold a wrong
//! value. Both the server and the viewers load through [`Character::from_glb`], so a file one of them takes the other takes too.

mod checked;
mod colour;
mod glb;
mod motion;
pub mod schema;
mod zones;

pub use checked::{
    Bone, Character, CharacterError, Corrective, Drive, GroupDegenerate, LandmarkWeight, LidKind, Mode, Pose, ShapeDeltas, Side, WrinkleMap,
};
pub use colour::{Colour, ColourChange, ColourDriver};
pub use zones::{BridgeRow, Expression, Zone, ZoneMap, Zones};
