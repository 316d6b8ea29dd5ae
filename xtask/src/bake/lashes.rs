//! Eyelashes: curved hairs that stand on the lids' margins.

use super::bust::{Eyeball, Region};
use super::part::{Material, Part};
use super::random::Random;
use super::skin::Skin;
use super::strands::{self, Knot};
use super::surface::{Hit, Surface};
use super::weights::{shape, turn_angles};
use glam::{Mat3, Vec3};
use rhytid_shared::ARKIT_NAMES;

/// One row of lashes.
struct Row {
    is_upper: bool,
    num_hairs: usize,
    /// Metres, in the middle of the lid; shorter towards the corners.
    length: f32,
    half_width: f32,
    /// Slope of the root, then how much it curls, both upwards over outwards.
    slope: f32,
    curl: f32,
}

const ROWS: [Row; 2] = [
    Row { is_upper: true, num_hairs: 84, length: 0.0080, half_width: 0.000_10, slope: -0.25, curl: 1.15 },
    Row { is_upper: false, num_hairs: 46, length: 0.0042, half_width: 0.000_07, slope: -0.35, curl: -0.25 },
];
/// Angles of the margin's ends about the vertical axis through the eye, outwards positive, degrees.
const SPAN_DEGREES: [f32; 2] = [-30.0, 52.0];
const NUM_KNOTS: usize = 5;

/// All four rows.
pub fn build(skin: &Skin, eyes: [Eyeball; 2]) -> Part {
    let mut part = strands::empty(Material::Lash);
    for (s, eye) in eyes.into_iter().enumerate() {
        let is_near = |v: usize| skin.mesh.positions[v].distance(eye.centre) < 1.7 * eye.radius && skin.regions[v] != Region::Socket;
        let surface = &Surface::new(&skin.mesh, is_near);
        let outwards = if s == 0 { 1.0 } else { -1.0 };
        let blink = shape(["eyeBlinkLeft", "eyeBlinkRight"][s]);
        for row in &ROWS {
            let mut random = Random::new(101 + 2 * s as u64 + u64::from(row.is_upper));
            for i in 0..row.num_hairs {
                let t = (i as f32 + random.unit()) / row.num_hairs as f32;
                let azimuth = (SPAN_DEGREES[0] + t * (SPAN_DEGREES[1] - SPAN_DEGREES[0])).to_radians();
                let Some(root) = margin(surface, eye, azimuth * outwards, row.is_upper) else { continue };
                let foot = surface.position(&root);
                let arm = foot - eye.centre;
                // Hairs fan out towards the outer corner and stand in small tufts.
                let fan = azimuth + 0.25 * (t - 0.35) + 0.10 * random.signed();
                let away = Vec3::new(libm::sinf(fan) * outwards, 0.0, libm::cosf(fan));
                let fullness = 1.0 - 0.55 * (2.0 * t - 1.1) * (2.0 * t - 1.1);
                let length = row.length * fullness * (0.78 + 0.3 * random.unit());
                let (slope, curl) = (row.slope + 0.12 * random.signed(), row.curl * (0.85 + 0.3 * random.unit()));
                let turned = turn_angles(&[foot], &[surface.morph(&root, blink)], eye.centre, 0.01)[0];
                let (sin, cos) = libm::sincosf(turned);
                let rotation = Mat3::from_cols(Vec3::X, Vec3::new(0.0, cos, sin), Vec3::new(0.0, -sin, cos));
                let binding = surface.binding(&root, &skin.weights);
                let knots: Vec<Knot> = (0..NUM_KNOTS)
                    .map(|k| {
                        let u = k as f32 / (NUM_KNOTS - 1) as f32;
                        let offset = (away * u + Vec3::Y * (slope * u + curl * u * u * 0.5)) * length;
                        let morphs = (0..ARKIT_NAMES.len()).map(|shape| {
                            surface.morph(&root, shape) + if shape == blink { rotation * offset - offset } else { Vec3::ZERO }
                        });
                        Knot {
                            position: foot + offset - arm.normalize_or_zero() * 0.000_1,
                            normal: (Vec3::Y * 0.8 - away * 0.6) * if row.is_upper { -1.0 } else { 1.0 },
                            half_width: row.half_width * (1.0 - 0.7 * u),
                            binding,
                            morphs: morphs.collect(),
                        }
                    })
                    .collect();
                strands::push(&mut part, &knots);
            }
        }
    }
    for normal in &mut part.normals {
        *normal = normal.normalize_or(Vec3::Z);
    }
    part
}

/// The edge of a lid's outer surface in the half plane at `azimuth`: the last point, going from the lid's middle towards
/// the opening, where a ray from the eye's centre still meets skin close to the ball.
pub fn margin(surface: &Surface<'_>, eye: Eyeball, azimuth: f32, is_upper: bool) -> Option<Hit> {
    let side = if is_upper { 1.0 } else { -1.0 };
    let on_lid = |elevation: f32| {
        let (sin, cos) = libm::sincosf(elevation);
        let direction = Vec3::new(libm::sinf(azimuth) * cos, sin * side, libm::cosf(azimuth) * cos);
        // From just outside the ball, so that the pocket behind the lid is not met.
        let start = 1.01 * eye.radius;
        let hit = surface.ray(eye.centre + direction * start, direction)?;
        (hit.distance < 0.006).then_some(hit)
    };
    let (mut last, mut step) = (None, 0);
    // From 60 degrees off the opening's plane towards it in half degrees.
    while step < 160 {
        let elevation = (60.0 - 0.5 * step as f32).to_radians();
        match on_lid(elevation) {
            Some(hit) => last = Some(hit),
            None if last.is_some() => return last,
            None => {}
        }
        step += 1;
    }
    None
}
