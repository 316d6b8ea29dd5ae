//! Webs of flesh behind the corners of the mouth. Where lips part, the skin's own inside lies too deep to be seen as
//! flesh: the corner would show a black hole.

use super::part::{Binding, Part, sparse};
use super::skin::Skin;
use glam::{Vec2, Vec3};

/// Outline of the web in the plane of the face, millimetres: from the corner towards the middle, then how far up and down
/// from it. It ends within the lips' flesh, which below the corner lies further back, and in a point between them.
const OUTLINE: [(f32, [f32; 2]); 5] = [(0.0, [0.6, -0.3]), (0.7, [0.9, -0.5]), (1.8, [1.0, -0.6]), (3.2, [0.7, -0.4]), (4.2, [0.1, -0.1])];
/// How far behind the corner it stands.
const DEPTH_MM: f32 = 0.8;
/// Where on the picture of the teeth it finds the colour of shaded gum.
const COLOR_UV: Vec2 = Vec2::new(0.16, 0.75);

/// Adds both webs; they go with the skin of the corners.
pub fn push(part: &mut Part, skin: &Skin) {
    for (&corner, inwards) in skin.lip_corners.iter().zip([1.0, -1.0]) {
        let first = part.positions.len() as u32;
        let at = skin.mesh.positions[corner as usize];
        for (along, ends) in OUTLINE {
            for up in ends {
                part.positions.push(at + Vec3::new(along * inwards, up, -DEPTH_MM) * 1e-3);
                part.normals.push(Vec3::Z);
                part.uvs.push(COLOR_UV);
                part.bindings.push(Binding::from_weights(skin.weights[corner as usize].clone()));
            }
        }
        for column in 0..OUTLINE.len() as u32 - 1 {
            let a = first + 2 * column;
            // Seen from the front: a is above a + 1, the next column nearer to the middle.
            for [p, q, r] in [[a, a + 1, a + 2], [a + 2, a + 1, a + 3]] {
                part.triangles.push(if inwards > 0.0 { [p, q, r] } else { [p, r, q] });
            }
        }
        let num_added = part.positions.len() - first as usize;
        for (all, moved) in part.morphs.iter_mut().zip(&skin.mesh.morphs) {
            let deltas = sparse(std::iter::repeat_n(moved[corner as usize], num_added));
            all.extend(deltas.into_iter().map(|(v, delta)| (v + first, delta)));
        }
    }
}
