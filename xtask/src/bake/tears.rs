//! Line of tears: the thin hollow of water between the eyeball and the lower lid, which catches the light.

use super::bust::{Eyeball, Region};
use super::eyes;
use super::lashes;
use super::part::{Material, Part, sparse};
use super::skin::Skin;
use super::strands;
use super::surface::Surface;
use glam::{Vec2, Vec3};
use rhytid_shared::ARKIT_NAMES;

/// Angles of its ends about the vertical axis through the eye, outwards positive, degrees.
const SPAN_DEGREES: [f32; 2] = [-33.0, 52.0];
const NUM_STEPS: usize = 56;
/// How far the water climbs up the ball over the lid's edge in the middle, metres; it thins out towards the ends. Tears stand
/// 0.2 to 0.3 mm high (Doughty 2001); twice that, so that a pixel shows it.
const HEIGHT: f32 = 0.000_55;
/// It lies this far off the ball, metres.
const OFF_BALL: f32 = 0.000_10;
/// Rows of vertices from the lid up.
const NUM_ROWS: usize = 4;

/// Both lines.
pub fn build(skin: &Skin, eyes: [Eyeball; 2]) -> Part {
    let mut part = strands::empty(Material::Tear);
    for (s, eye) in eyes.into_iter().enumerate() {
        let is_near = |v: usize| skin.mesh.positions[v].distance(eye.centre) < 1.7 * eye.radius && skin.regions[v] != Region::Socket;
        let surface = &Surface::new(&skin.mesh, is_near);
        let outwards = if s == 0 { 1.0 } else { -1.0 };
        let roots: Vec<_> = (0..=NUM_STEPS)
            .filter_map(|i| {
                let t = i as f32 / NUM_STEPS as f32;
                let azimuth = (SPAN_DEGREES[0] + t * (SPAN_DEGREES[1] - SPAN_DEGREES[0])).to_radians() * outwards;
                lashes::margin(surface, eye, azimuth, false).map(|hit| (t, hit))
            })
            .collect();
        let first = part.positions.len() as u32;
        let mut deltas: Vec<Vec<Vec3>> = vec![Vec::new(); ARKIT_NAMES.len()];
        for (t, hit) in &roots {
            let thickness = (4.0 * t * (1.0 - t)).sqrt();
            let lid = surface.position(hit) - eye.centre;
            // On the ball, in the half plane through the lid's edge and the vertical axis.
            let on_ball = |climb: f32| {
                let flat = Vec3::new(lid.x, 0.0, lid.z).normalize_or(Vec3::Z);
                let elevation = libm::asinf((lid.y / lid.length()).clamp(-1.0, 1.0)) + climb / eye.radius;
                let (sin, cos) = libm::sincosf(elevation);
                let direction = flat * cos + Vec3::Y * sin;
                direction * (eyes::surface_radius(direction, eye.radius) + OFF_BALL)
            };
            let top = on_ball(HEIGHT * (0.35 + 0.65 * thickness));
            let foot = lid.lerp(on_ball(0.0), 0.3);
            for row in 0..NUM_ROWS {
                let u = row as f32 / (NUM_ROWS - 1) as f32;
                // A hollow: at the lid it faces up, at the ball outwards.
                let normal = Vec3::Y.lerp(top.normalize(), u.sqrt()).normalize_or(Vec3::Z);
                let chord = foot.lerp(top, u);
                let sagged = chord.lerp(on_ball(0.0).lerp(top, u), 2.0 * u * (1.0 - u));
                part.positions.push(eye.centre + sagged);
                part.normals.push(normal);
                part.uvs.push(Vec2::new(*t, 1.0 - u));
                part.bindings.push(surface.binding(hit, &skin.weights));
                deltas.iter_mut().enumerate().for_each(|(shape, all)| all.push(surface.morph(hit, shape)));
            }
        }
        for (all, own) in part.morphs.iter_mut().zip(deltas) {
            all.extend(sparse(own.into_iter()).into_iter().map(|(v, delta)| (v + first, delta)));
        }
        let rows = NUM_ROWS as u32;
        for column in 0..roots.len().saturating_sub(1) as u32 {
            for row in 0..rows - 1 {
                let a = first + column * rows + row;
                let (b, c, d) = (a + 1, a + rows, a + rows + 1);
                // Columns go outwards: to the character's left on its left, the other way on its right.
                if s == 0 {
                    part.triangles.extend([[a, c, b], [b, c, d]]);
                } else {
                    part.triangles.extend([[a, b, c], [b, d, c]]);
                }
            }
        }
    }
    part
}
