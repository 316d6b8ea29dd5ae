//! Rhytid's client: receives face frames, plays them out, poses the character and draws it. What the server computes and
//! how is none of its business; only the `embedded` feature links the server, to run it in this process.

pub mod asset;
pub mod playout;
pub mod renderer;
pub mod twin;

#[cfg(not(target_arch = "wasm32"))]
mod native {
    pub use crate::link::{Link, LinkOptions, LinkState, LinkStats, ServerAddress, ServerAddresses};
    pub use crate::renderer::{Headless, RenderError};
    pub use crate::spectator::{Spectator, Status, StatusKind};
    pub use crate::video::{Video, VideoError};
}
#[cfg(feature = "embedded")]
mod apng;
#[cfg(not(target_arch = "wasm32"))]
pub mod film;
#[cfg(feature = "embedded")]
pub mod gallery;
#[cfg(not(target_arch = "wasm32"))]
pub mod link;
#[cfg(not(target_arch = "wasm32"))]
mod picture_size;
mod rate;
#[cfg(not(target_arch = "wasm32"))]
mod remote;
#[cfg(feature = "embedded")]
pub mod render_cli;
#[cfg(not(target_arch = "wasm32"))]
mod sheet;
#[cfg(not(target_arch = "wasm32"))]
pub mod spectator;
#[cfg(not(target_arch = "wasm32"))]
mod video;
#[cfg(not(target_arch = "wasm32"))]
pub mod view;
#[cfg(target_arch = "wasm32")]
pub mod web;

pub use asset::{AssetError, CharacterAsset};
#[cfg(not(target_arch = "wasm32"))]
pub use native::*;
pub use playout::{Playout, PlayoutState, PlayoutStats};
pub use renderer::{BlendMode, Camera, Deformation, DrawSettings, RenderFrame, Renderer, ViewMode};
