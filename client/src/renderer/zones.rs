//! Zone weights as the shaders take them.

use super::RenderFrame;
use super::uniforms::WrinkleWeights;
use super::view::ZoneBlend;
use crate::asset::ZoneMaps;

/// What of a character's zones the weights depend on.
#[derive(Debug)]
pub struct ZoneScales {
    wrinkled: f32,
    stretched: f32,
    has_difference: bool,
    /// Metres from one wrinkle to the next.
    pub wavelength: f32,
}

impl ZoneScales {
    pub fn new(zones: &ZoneMaps) -> Self {
        Self {
            wrinkled: zones.scale,
            stretched: zones.stretch_scale,
            has_difference: zones.difference.is_some(),
            wavelength: zones.wavelength,
        }
    }

    /// Whether the character has what a way of blending reads.
    pub fn has(&self, blend: ZoneBlend) -> bool {
        blend != ZoneBlend::Difference || self.has_difference
    }

    /// A frame's zone weights, four a vec4, the maps' scales and `fade` multiplied in.
    pub fn weights(&self, frame: &RenderFrame, blend: ZoneBlend, fade: f32) -> WrinkleWeights {
        let packed = |weights: &[f32], factor: f32| {
            let mut vectors = [[0.0; 4]; 2];
            for (to, weight) in vectors.iter_mut().flatten().zip(weights) {
                *to = weight.clamp(0.0, 1.0) * factor;
            }
            vectors
        };
        let scale = if blend == ZoneBlend::Difference { 1.0 } else { self.wrinkled };
        WrinkleWeights {
            wrinkled: packed(&frame.zones, scale * fade),
            stretched: packed(&frame.stretched, self.stretched * fade),
            ..bytemuck::Zeroable::zeroed()
        }
    }
}
