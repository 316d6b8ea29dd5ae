//! The lights: a soft key from above to the side, which makes furrows readable, a fill opposite, two rims, and the room.

use super::uniforms::Light;
use glam::camera::rh::{proj, view};
use glam::{Mat4, Vec3};

/// Directions towards the lights in world space and their linear RGB. Tuned by eye on the default character.
const LIGHTS: [([f32; 3], [f32; 3], f32); 4] = [
    ([-0.56, 0.66, 0.70], [1.0, 0.965, 0.92], 2.10),
    ([0.70, 0.12, 0.70], [0.88, 0.94, 1.0], 0.42),
    ([0.88, 0.35, -0.72], [0.90, 0.95, 1.0], 0.70),
    ([-0.90, 0.30, -0.80], [1.0, 0.93, 0.86], 0.45),
];
/// Irradiance of the room from above and from below, linear RGB.
pub const SKY: [f32; 3] = [0.25, 0.26, 0.285];
pub const GROUND: [f32; 3] = [0.125, 0.105, 0.095];

/// The four lights, the key first.
pub fn lights() -> [Light; 4] {
    LIGHTS.map(|(direction, colour, strength)| {
        let [x, y, z] = Vec3::from(direction).normalize().to_array();
        Light { direction: [x, y, z, 0.0], radiance: [colour[0] * strength, colour[1] * strength, colour[2] * strength, 0.0] }
    })
}

/// What the key light sees: a sphere of `radius` metres round `centre` fills its shadow map.
pub fn shadow_from_world(centre: Vec3, radius: f32) -> Mat4 {
    let towards = Vec3::from(LIGHTS[0].0).normalize();
    let view_from_world = view::look_at_mat4(centre + towards * radius * 2.0, centre, Vec3::Y);
    proj::directx::orthographic(-radius, radius, -radius, radius, radius * 0.5, radius * 3.5) * view_from_world
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shadow_map_holds_the_whole_sphere() {
        let (centre, radius) = (Vec3::new(0.1, 1.5, -0.2), 0.3);
        let shadow_from_world = shadow_from_world(centre, radius);
        for direction in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z] {
            let clip = shadow_from_world.project_point3(centre + direction * radius);
            assert!(clip.x.abs() <= 1.001 && clip.y.abs() <= 1.001 && (0.0..=1.0).contains(&clip.z), "{clip}");
        }
    }
}
