//! Paints the default character: everything on it that is not geometry. All patterns are functions of the place on the
//! rest surface relative to the landmarks, never of the texture coordinates, so seams do not show. The same input gives
//! the same bytes.

mod atlas;
mod chart;
mod encode;
mod eyes;
mod features;
mod furrow;
mod hairs;
mod noise;
mod occlusion;
mod pores;
#[cfg(test)]
mod sample;
mod skin;
mod slopes;
mod teeth;
mod wrinkles;
mod zones;

use super::bust::{Bust, Painted};
use anyhow::Result;
use atlas::Atlas;
use chart::Chart;
use features::Features;
use occlusion::Openness;

/// Texels a side of colour and pores.
const FINE: usize = 2048;
/// Texels a side of wrinkle maps, occlusion and roughness.
const COARSE: usize = 1024;

/// Paints everything.
pub fn paint(bust: &Bust) -> Result<Painted> {
    let chart = Chart::new(bust);
    let features = Features::new(&chart, bust);
    let coarse = Atlas::new(bust, COARSE);
    let openness = Openness::new(bust, &coarse);
    let wrinkles = bust.poses.iter().map(|pose| wrinkles::paint(&chart, &coarse, pose)).collect::<Result<_>>()?;
    let zones = zones::paint(&chart, &coarse)?;
    let skin_surface = occlusion::paint(&coarse, &features, &openness)?;

    let fine = Atlas::new(bust, FINE);
    let hairs = hairs::draw(&fine, &features);
    Ok(Painted {
        skin_albedo: skin::paint(&fine, &features, &hairs, |uv| openness.at(uv))?,
        skin_slopes: pores::paint(&fine, &features, &hairs, &wrinkles::permanent(&chart))?,
        skin_surface,
        wrinkles,
        zones,
        eye_albedo: eyes::paint(bust)?,
        teeth_albedo: teeth::paint()?,
    })
}
