//! Draws the gallery's single pictures.

use super::Result;
use crate::asset::CharacterAsset;
use crate::render_cli::{PictureError, averaged, load_character, solve_first};
use crate::renderer::{Camera, DrawSettings, Headless, RenderFrame};
use crate::view::expressions::Amounts;
use glam::Vec3;
use image::RgbaImage;
use rhytid_shared::limits::MAX_EXPRESSIONS;
use rhytid_shared::{ArkitShape, Character, NUM_ARKIT_SHAPES, TrackingData, TrackingFrame};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// How much nearer than the usual front view, and how much higher, metres: the face from the hair to the chin fills the
/// picture. Tuned by eye.
const CLOSE: f32 = 0.72;
const HIGHER: f32 = 0.011;

/// A character on a device.
pub(super) struct Easel {
    pub(super) asset: CharacterAsset,
    /// Where the character came from, where it is not the built-in one.
    path: Option<PathBuf>,
    /// A feed of landmarks.
    pub(super) feed: PathBuf,
    headless: Headless,
    supersample: u32,
}

impl Easel {
    pub(super) fn open(character: Option<&Path>, feed: &Path, supersample: u32) -> Result<Self> {
        let asset = load_character(character)?;
        let headless = Headless::new(&asset)?;
        tracing::info!(adapter = headless.adapter().name, "drawing");
        Ok(Self { asset, path: character.map(Path::to_owned), feed: feed.to_owned(), headless, supersample })
    }

    /// The same character with a change, on a device of its own.
    pub(super) fn variant(&self, change: impl FnOnce(&mut CharacterAsset)) -> Result<Self> {
        let mut asset = load_character(self.path.as_deref())?;
        change(&mut asset);
        let headless = Headless::new(&asset)?;
        Ok(Self { asset, path: self.path.clone(), feed: self.feed.clone(), headless, supersample: self.supersample })
    }

    pub(super) fn device(&self) -> (&wgpu::Device, &wgpu::Queue) {
        self.headless.device()
    }

    pub(super) fn headless(&mut self) -> &mut Headless {
        &mut self.headless
    }

    pub(super) fn character(&self) -> &Arc<Character> {
        &self.asset.character
    }

    pub(super) fn draw(&mut self, size: [u32; 2], settings: &DrawSettings, frame: &RenderFrame) -> Result<RgbaImage> {
        let picture = self.headless.render(size.map(|side| side * self.supersample), settings, frame)?;
        Ok(if self.supersample > 1 { averaged(&picture, self.supersample) } else { picture })
    }

    /// From the front, the face filling the picture.
    pub(super) fn face(&self) -> DrawSettings {
        let mut camera = Camera::front(self.character());
        camera.target.y += HIGHER;
        camera.zoom(CLOSE);
        DrawSettings::new(camera)
    }

    /// From the front on a place, `width` metres of it.
    pub(super) fn close_up(&self, place: Vec3, width: f32) -> DrawSettings {
        let mut camera = Camera::front(self.character());
        camera.target = place;
        camera.distance = 0.5 * width / (0.5 * camera.fovy).tan();
        DrawSettings::new(camera)
    }

    /// The face of expression weights by ARKit's names, with amounts of the character's expressions for its zones.
    pub(super) fn expression(&self, weights: &Amounts, expressions: &Amounts) -> Result<RenderFrame> {
        let mut values = Box::new([0.0; NUM_ARKIT_SHAPES]);
        for &(name, value) in weights {
            let shape = ArkitShape::from_name(name).ok_or_else(|| unknown("weight", name))?;
            values[shape.index()] += value;
        }
        values.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        self.solve(TrackingData::Weights { weights: values, head: None }, expressions)
    }

    /// The face of bones' points, metres, head space.
    pub(super) fn posed(&self, points: Vec<(usize, Vec3)>) -> Result<RenderFrame> {
        self.solve(TrackingData::Bones { points, head: None }, &[])
    }

    fn solve(&self, data: TrackingData, expressions: &Amounts) -> Result<RenderFrame> {
        let character = self.character();
        let mut tracked = TrackingFrame::new(0.0, data);
        if !expressions.is_empty() {
            let zones = character.zones.as_ref().ok_or(PictureError::Lacks("wrinkle zones"))?;
            let mut amounts = [0.0; MAX_EXPRESSIONS];
            for &(name, amount) in expressions {
                let at = zones.expressions.iter().position(|row| row.name == name).ok_or_else(|| unknown("expression", name))?;
                amounts[at] += amount;
            }
            tracked.expressions = Some(amounts);
        }
        Ok(RenderFrame::from(&solve_first(character, &tracked)?))
    }
}

fn unknown(what: &'static str, name: &str) -> PictureError {
    PictureError::Name { what, got: name.to_owned(), expected: "a name that the character has".into() }
}
