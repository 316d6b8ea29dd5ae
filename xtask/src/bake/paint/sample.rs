//! Surfaces to test on.

use super::super::bust::{Bust, Eyeball, PoseField, Region};
use glam::{Vec2, Vec3, Vec4};

/// A square of 40 mm that faces +Z, over UV 0.1 to 0.9.
pub fn plane() -> Bust {
    grid(1, |s, t| (Vec3::new(0.04 * (s - 0.5), 0.04 * (0.5 - t), 0.0), Vec3::Z, Vec2::new(s, t) * 0.8 + Vec2::splat(0.1)))
}

/// An egg with the landmarks of a face, unrolled about its vertical axis.
pub fn head() -> Bust {
    let mut bust = grid(96, |s, t| {
        let (sin, cos) = libm::sincosf((s - 0.5) * 5.8);
        let y = 0.125 - 0.245 * t;
        let (place, normal) = on_egg(sin, cos, y);
        (place, normal, Vec2::new(s, t) * 0.96 + Vec2::splat(0.02))
    });
    bust.ibug68 = FACE.map(|(x, y)| {
        let (x, y) = (x * 0.001, y * 0.001);
        let ring = (1.0 - y * y / (0.13 * 0.13)).sqrt();
        let z = 0.105 * (ring * ring - x * x / (0.078 * 0.078)).max(0.0).sqrt();
        Vec3::new(x, y, z)
    });
    bust
}

fn on_egg(sin: f32, cos: f32, y: f32) -> (Vec3, Vec3) {
    let ring = (1.0 - y * y / (0.13 * 0.13)).max(0.0).sqrt();
    let place = Vec3::new(0.078 * ring * sin, y, 0.105 * ring * cos);
    let slope = Vec3::new(place.x / (0.078 * 0.078), place.y / (0.13 * 0.13), place.z / (0.105 * 0.105));
    (place, slope.normalize_or(Vec3::Y))
}

fn grid(cells: usize, at: impl Fn(f32, f32) -> (Vec3, Vec3, Vec2)) -> Bust {
    let row = cells + 1;
    let points: Vec<(Vec3, Vec3, Vec2)> =
        (0..row * row).map(|i| at((i % row) as f32 / cells as f32, (i / row) as f32 / cells as f32)).collect();
    let step = 1.0e-3;
    let tangents = (0..row * row).map(|i| {
        let (s, t) = ((i % row) as f32 / cells as f32, (i / row) as f32 / cells as f32);
        let (along, normal) = (at(s + step, t).0 - at(s - step, t).0, points[i].1);
        (along - normal * normal.dot(along)).normalize_or(Vec3::X).extend(1.0)
    });
    let triangles = (0..cells * cells).flat_map(|i| {
        let a = (i / cells * row + i % cells) as u32;
        let below = a + row as u32;
        [[a, below, a + 1], [a + 1, below, below + 1]]
    });
    Bust {
        tangents: tangents.collect::<Vec<Vec4>>(),
        triangles: triangles.collect(),
        regions: vec![Region::Face; points.len()],
        positions: points.iter().map(|p| p.0).collect(),
        normals: points.iter().map(|p| p.1).collect(),
        uvs: points.iter().map(|p| p.2).collect(),
        ibug68: [Vec3::ZERO; 68],
        eyes: [0.03, -0.03].map(|x| Eyeball { centre: Vec3::new(x, 0.02, 0.075), radius: 0.012 }),
        poses: Vec::<PoseField>::new(),
    }
}

/// A face from the front: x to the character's left, y up, mm.
const FACE: [(f32, f32); 68] = [
    (-68., 20.),
    (-68., 5.),
    (-63., -11.),
    (-57., -45.),
    (-54., -53.),
    (-45., -66.),
    (-28., -82.),
    (-15., -86.),
    (0., -86.),
    (15., -86.),
    (28., -82.),
    (45., -66.),
    (54., -53.),
    (57., -45.),
    (63., -11.),
    (68., 5.),
    (68., 20.),
    (-54., 29.),
    (-48., 34.),
    (-40., 36.),
    (-29., 35.),
    (-10., 32.),
    (10., 32.),
    (29., 35.),
    (40., 36.),
    (48., 34.),
    (54., 29.),
    (0., 19.),
    (0., 5.),
    (0., -6.),
    (0., -13.),
    (-12., -21.),
    (-9., -27.),
    (0., -24.),
    (9., -27.),
    (12., -21.),
    (-42., 20.),
    (-36., 23.),
    (-25., 24.),
    (-15., 16.),
    (-22., 14.),
    (-34., 14.),
    (15., 16.),
    (25., 24.),
    (36., 23.),
    (42., 20.),
    (34., 14.),
    (22., 14.),
    (-22., -45.),
    (-13., -40.),
    (-8., -38.),
    (0., -39.),
    (8., -38.),
    (13., -40.),
    (22., -45.),
    (13., -54.),
    (7., -55.),
    (0., -56.),
    (-7., -55.),
    (-13., -54.),
    (-22., -46.),
    (-5., -42.),
    (0., -43.),
    (5., -42.),
    (22., -46.),
    (5., -45.),
    (0., -44.),
    (-5., -45.),
];
