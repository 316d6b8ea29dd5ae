//! Twins of the skin's light: highlights, what shines through, what spreads.

use crate::renderer::scattering::KernelSample;
use glam::Vec3;

/// Twin of `highlight` in `lighting.wgsl`, all vectors unit: `N·L · PH(N·H) · F / |L + V|²` with Beckmann's `PH` (Kelemen
/// and Szirmay-Kalos 2001). `slope` is the root mean square slope of the microfacets.
pub fn highlight(normal: Vec3, view: Vec3, light: Vec3, slope: f32, f0: f32) -> f32 {
    let n_dot_l = normal.dot(light);
    if n_dot_l <= 0.0 {
        return 0.0;
    }
    let sum = light + view;
    let halfway = sum.normalize();
    let fresnel = f0 + (1.0 - f0) * (1.0 - view.dot(halfway).clamp(0.0, 1.0)).powi(5);
    n_dot_l * beckmann(normal.dot(halfway), slope) * fresnel / sum.length_squared()
}

/// Twin of `masking` in `lighting.wgsl`, view and light unit: `(V·H)² / mix((V·H)², 1, slope)` (Lazarov 2011).
pub fn masking(view: Vec3, light: Vec3, slope: f32) -> f32 {
    let h2 = (light + view).length_squared().max(1e-4);
    h2 / (h2 + (4.0 - h2) * slope.clamp(0.0, 1.0))
}

/// Twin of `intensity_of` in `surface.wgsl`: what a code of the map of intensity multiplies highlights by.
pub fn intensity(code: u8, has_intensity: bool) -> f32 {
    if has_intensity { f32::from(code) / 128.0 } else { 1.0 }
}

/// `exp(-tan²(acos x) / m²) / (m² x⁴)`: pi times Beckmann's distribution.
fn beckmann(cos: f32, slope: f32) -> f32 {
    let x2 = (cos * cos).clamp(1e-4, 1.0);
    ((x2 - 1.0) / (x2 * slope * slope)).exp() / (slope * slope * x2 * x2)
}

/// Twin of `transmittance` in `lighting.wgsl`: what is left of white light behind `thickness_mm` of skin, linear RGB.
pub fn transmittance(thickness_mm: f32) -> Vec3 {
    const TERMS: [(f32, [f32; 3]); 6] = [
        (0.0064, [0.233, 0.455, 0.649]),
        (0.0484, [0.100, 0.336, 0.344]),
        (0.187, [0.118, 0.198, 0.0]),
        (0.567, [0.113, 0.007, 0.007]),
        (1.99, [0.358, 0.004, 0.0]),
        (7.41, [0.078, 0.0, 0.0]),
    ];
    TERMS.iter().map(|&(variance, weight)| Vec3::from(weight) * (-thickness_mm * thickness_mm / variance).exp()).sum()
}

/// Twin of `fs_scatter` in `scatter.wgsl` on one row of pixels: `light` and metres behind the depth origin of each, how
/// much the surface scatters, and by how many pixels a millimetre at a metre spreads.
pub fn scatter_row(
    kernel: &[KernelSample],
    row: &[(Vec3, f32)],
    strength: &[f32],
    pixels_per_mm_at_metre: f32,
    depth_origin: f32,
    rejection: f32,
) -> Vec<Vec3> {
    // Linear between the middles of pixels, held at the ends.
    let at = |x: f32| {
        let x = (x - 0.5).clamp(0.0, (row.len() - 1) as f32);
        let (i, f) = (x as usize, x.fract());
        let (a, b) = (row[i], row[(i + 1).min(row.len() - 1)]);
        (a.0.lerp(b.0, f), a.1 + (b.1 - a.1) * f)
    };
    (0..row.len())
        .map(|i| {
            let (light, depth) = row[i];
            if strength[i] <= 0.0 {
                return light;
            }
            let step = pixels_per_mm_at_metre * strength[i] / (depth + depth_origin).max(0.01);
            kernel[1..].iter().fold(kernel[0].weight * light, |sum, sample| {
                let (there, there_depth) = at(i as f32 + 0.5 + step * sample.offset_mm);
                sum + sample.weight * there.lerp(light, ((there_depth - depth).abs() * rejection).clamp(0.0, 1.0))
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn highlight_matches_the_worked_numbers() {
        for (cos, expected) in [(1.0, 11.11111111), (0.95, 4.10723249), (0.8, 0.05236692)] {
            assert!((beckmann(cos, 0.3) - expected).abs() < 1e-4 * expected, "{cos}: {}", beckmann(cos, 0.3));
        }
        let tilted = |degrees: f32| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            Vec3::new(0.0, sin, cos)
        };
        let spec = highlight(Vec3::Z, tilted(-40.0), tilted(30.0), 0.3, 0.028);
        assert!((spec - 0.09424349).abs() < 1e-6, "{spec}");
    }

    #[test]
    fn masking_leaves_light_from_the_front_and_holds_back_light_from_behind() {
        let behind = Vec3::new(0.6, 0.0, -0.8);
        assert!((masking(Vec3::Z, Vec3::Z, 0.7) - 1.0).abs() < 1e-6);
        assert!((masking(Vec3::Z, behind, 0.5) - 0.1 / 0.55).abs() < 1e-6, "{}", masking(Vec3::Z, behind, 0.5));
        assert!(masking(Vec3::Z, Vec3::NEG_Z, 0.3) < 1e-3);
        assert!((masking(Vec3::Z, behind, 0.0) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn intensity_is_one_in_the_middle_and_where_there_is_no_map() {
        assert_eq!([0, 64, 128].map(|code| intensity(code, true)), [0.0, 0.5, 1.0]);
        assert_eq!(intensity(0, false), 1.0);
    }

    #[test]
    fn transmittance_matches_the_worked_numbers() {
        for (thickness, expected) in [
            (0.0, [1.0, 1.0, 1.0]),
            (0.1, [0.78715345, 0.56720138, 0.42270283]),
            (0.5, [0.49542213, 0.06195742, 0.00646885]),
            (1.0, [0.30467766, 0.00456234, 0.0011999]),
            (2.0, [0.09352605, 0.00054197, 0.00000604]),
        ] {
            assert!((transmittance(thickness) - Vec3::from(expected)).abs().max_element() < 1e-6, "{thickness}");
        }
    }
}
