//! Rhytid's client: receives face frames, plays them out, poses the character and draws it. What the server computes and
//! how is none of its business; only the `embedded` feature links the server, to run it in this process.

pub mod asset;
pub mod renderer;

pub use asset::{AssetError, CharacterAsset};
pub use renderer::{BlendMode, Camera, DrawSettings, Headless, RenderError, RenderFrame, Renderer, ViewMode};
