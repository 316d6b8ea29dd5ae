//! Rhytid's client: receives face frames, plays them out, poses the character and draws it. What the server computes and
//! how is none of its business; only the `embedded` feature links the server, to run it in this process.

pub mod asset;
pub mod film;
#[cfg(feature = "embedded")]
pub mod gallery;
pub mod link;
mod picture_size;
pub mod playout;
#[cfg(feature = "embedded")]
pub mod render_cli;
pub mod renderer;
mod sheet;
pub mod spectator;
pub mod twin;
mod video;
pub mod view;

pub use asset::{AssetError, CharacterAsset};
pub use link::{Link, LinkOptions, LinkState, LinkStats, ServerAddress};
pub use playout::{Playout, PlayoutState, PlayoutStats};
pub use renderer::{BlendMode, Camera, Deformation, DrawSettings, Headless, RenderError, RenderFrame, Renderer, ViewMode};
pub use spectator::{Spectator, Status, StatusKind};
pub use video::{Video, VideoError};
