//! What both ends of Rhytid agree on: the messages a tracker publishes, the hello and the frame packets a viewer
//! gets, and the description of a character with its checks. Nothing here opens a socket, reads a clock or a file.

#![forbid(unsafe_code)]

pub mod character;
mod face;
pub mod layout;
pub mod limits;
mod names;
pub mod packet;
#[cfg(test)]
mod testing;
mod tracking;
#[cfg(feature = "trust")]
pub mod trust;
pub mod view;

pub use character::{Character, CharacterError};
pub use face::{FaceFrame, HeadPose};
pub use names::{ARKIT_NAMES, ArkitShape, NUM_ARKIT_SHAPES, NameError, RoomName};
pub use tracking::{
    Calibration, ChannelGroup, ChannelGroups, Command, FIT_SECONDS, FaceKind, FitRequest, FitStep, GroupValues, MessageError,
    PROFILE_VERSION, Profile, ProfileChoice, PublishHello, PublishMessage, PublishReader, RANGE_FACTORS, Ranges, Resume, Settings, Slot,
    TrackingData, TrackingFrame, encode_landmarks,
};

/// The default character (CC0, see the file's `asset.copyright`), as `cargo xtask bake` made it.
pub const DEFAULT_CHARACTER_GLB: &[u8] = include_bytes!("../assets/default.glb");
