//! Eyeballs: spheres with a cornea, in the place and size of MakeHuman's helper eyes.

use super::base::{Base, mean};
use super::bust::Eyeball;
use super::part::{Binding, Material, Part, sparse};
use glam::{Mat3, Vec2, Vec3};
use rhytid_shared::ARKIT_NAMES;
use std::f32::consts::TAU;

/// Angle from the front pole at which the eye's texture ends, radians; what lies behind is never seen.
pub const TEXTURE_ANGLE: f32 = 1.75;
/// Radius of the iris on the ball, metres (a grown person's is 5.8 to 6.2 mm).
pub const IRIS_RADIUS: f32 = 0.0061;
/// How far the cornea's top stands out of the sphere, as a share of the sphere's radius.
const CORNEA_HEIGHT: f32 = 0.045;
/// The ball is a little smaller than the helper eye, which is meant to overlap the lids: here they only touch.
const BALL_SHARE: f32 = 0.972;
const NUM_RINGS: u32 = 22;
const NUM_SECTORS: u32 = 36;

/// Centre and radius of the helper eye of one side (`l` or `r`).
pub fn eyeball(base: &Base, group: &str) -> Eyeball {
    let vertices = base.obj.vertices_of(group);
    let (low, high) = vertices.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &v| {
        (low.min(base.positions[v as usize]), high.max(base.positions[v as usize]))
    });
    let centre = (low + high) * 0.5;
    let radius = vertices.iter().map(|&v| base.positions[v as usize].distance(centre)).sum::<f32>() / vertices.len() as f32;
    Eyeball { centre, radius: radius * BALL_SHARE }
}

/// The rotation one expression shape gives the helper eye, from the displacement of its frontmost point.
fn turn(base: &Base, group: &str, eye: Eyeball, shape: usize) -> Mat3 {
    let vertices = base.obj.vertices_of(group);
    let front: Vec<u32> = vertices.iter().copied().filter(|&v| base.positions[v as usize].z > eye.centre.z + 0.8 * eye.radius).collect();
    let delta = mean(&base.dense_morph(shape), &front);
    let rest = (mean(&base.positions, &front) - eye.centre).normalize();
    let turned = (mean(&base.positions, &front) + delta - eye.centre).normalize();
    rotation_between(rest, turned)
}

/// Shortest rotation from one unit vector to another (Rodrigues without angles).
fn rotation_between(from: Vec3, to: Vec3) -> Mat3 {
    let v = from.cross(to);
    let k = Mat3::from_cols(Vec3::new(0.0, v.z, -v.y), Vec3::new(-v.z, 0.0, v.x), Vec3::new(v.y, -v.x, 0.0));
    Mat3::IDENTITY + k + k * k * (1.0 / (1.0 + from.dot(to)))
}

/// Both eyes as one part. `joints` are those of the left and the right eye.
pub fn build(base: &Base, eyes: [Eyeball; 2], joints: [u8; 2]) -> Part {
    let mut part = Part {
        material: Material::Eye,
        positions: Vec::new(),
        normals: Vec::new(),
        tangents: None,
        uvs: Vec::new(),
        bindings: Vec::new(),
        morphs: vec![Vec::new(); ARKIT_NAMES.len()],
        triangles: Vec::new(),
    };
    for ((eye, group), joint) in eyes.into_iter().zip(["helper-l-eye", "helper-r-eye"]).zip(joints) {
        let first = part.positions.len() as u32;
        let profile = |ring: u32| {
            let angle = TEXTURE_ANGLE * ring as f32 / NUM_RINGS as f32;
            (angle, radius_at(angle, eye.radius))
        };
        for ring in 0..=NUM_RINGS {
            let (angle, radius) = profile(ring);
            let step = 1.0e-3;
            for sector in 0..=NUM_SECTORS {
                let (sin, cos) = libm::sincosf(TAU * sector as f32 / NUM_SECTORS as f32);
                let at = |angle: f32, radius: f32| Vec3::new(cos * libm::sinf(angle), sin * libm::sinf(angle), libm::cosf(angle)) * radius;
                let along = at(angle + step, radius_at(angle + step, eye.radius)) - at(angle - step, radius_at(angle - step, eye.radius));
                part.positions.push(eye.centre + at(angle, radius));
                part.normals.push(along.cross(Vec3::new(-sin, cos, 0.0)).normalize());
                part.uvs.push(Vec2::new(0.5, 0.5) + Vec2::new(cos, -sin) * 0.5 * (angle / TEXTURE_ANGLE));
                part.bindings.push(Binding::rigid(joint));
            }
        }
        let row = NUM_SECTORS + 1;
        for ring in 0..NUM_RINGS {
            for sector in 0..NUM_SECTORS {
                let a = first + ring * row + sector;
                let (b, c, d) = (a + 1, a + row, a + row + 1);
                if ring > 0 {
                    part.triangles.push([a, d, b]);
                }
                part.triangles.push([a, c, d]);
            }
        }
        for shape in 0..ARKIT_NAMES.len() {
            if !ARKIT_NAMES[shape].starts_with("eyeLook") {
                continue;
            }
            let rotation = turn(base, group, eye, shape);
            let deltas = part.positions[first as usize..].iter().map(|&p| rotation * (p - eye.centre) - (p - eye.centre));
            part.morphs[shape].extend(sparse(deltas).into_iter().map(|(v, delta)| (v + first, delta)));
        }
    }
    part
}

/// Distance of the surface of an eye that looks ahead from its centre, in the direction of `arm`.
pub fn surface_radius(arm: Vec3, radius: f32) -> f32 {
    radius_at(libm::acosf((arm.z / arm.length()).clamp(-1.0, 1.0)), radius)
}

/// Distance of the eye's surface from its centre, `angle` from the front pole: sphere plus a smooth cornea.
fn radius_at(angle: f32, radius: f32) -> f32 {
    let limbus = libm::asinf(IRIS_RADIUS / radius) * 1.12;
    let t = (angle.abs() / limbus).min(1.0);
    let bump = (1.0 - t * t) * (1.0 - t * t) * (1.0 + 2.0 * t * t) * (1.0 - 0.5 * t * t);
    radius * (1.0 + CORNEA_HEIGHT * bump)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cornea_is_smooth_and_ends_at_the_limbus() {
        let radius = 0.015;
        assert!(radius_at(0.0, radius) > 1.03 * radius);
        assert_eq!(radius_at(0.6, radius), radius);
        let steps: Vec<f32> = (0..100).map(|i| radius_at(i as f32 * 0.006, radius)).collect();
        assert!(steps.windows(2).all(|pair| pair[1] <= pair[0]));
    }

    #[test]
    fn rotation_between_carries_one_direction_to_the_other() {
        let (from, to) = (Vec3::new(0.0, 0.6, 0.8), Vec3::new(0.48, 0.36, 0.8));
        assert!((rotation_between(from, to) * from).distance(to) < 1e-6);
    }
}
