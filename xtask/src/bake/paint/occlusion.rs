//! How much of the sky each place on the skin sees, and how rough it is.

use super::super::bust::{Bust, Encoded};
use super::atlas::{Atlas, Texel, fill_gaps};
use super::encode;
use super::features::{Features, Marks};
use super::noise::{fractal, lerp};
use anyhow::Result;
use glam::{Vec2, Vec3};

/// Directions light comes from, evenly spread over the sphere.
const NUM_DIRECTIONS: usize = 72;
/// Pixels a side of the depth picture seen from each of them.
const DEPTH_SIZE: usize = 576;
/// What lies less than this behind the nearest surface is lit, mm.
const BIAS: f32 = 1.6;

/// Least light at the corners of the mouth.
const CORNER_LIGHT: f32 = 0.5;

/// Share of the sky seen from each texel, cosine-weighted.
pub struct Openness {
    size: usize,
    shares: Vec<[f32; 1]>,
}

impl Openness {
    /// Looks at the bust from all sides.
    pub fn new(bust: &Bust, atlas: &Atlas) -> Self {
        let views: Vec<DepthView> = (0..NUM_DIRECTIONS).map(|i| DepthView::new(bust, spiral(i))).collect();
        let balls = bust.eyes.map(|eye| (eye.centre * 1000.0, eye.radius * 1000.0));
        let shares = atlas.map(|texel| {
            let (mut lit, mut all) = (0.0, 0.0);
            for view in &views {
                let weight = texel.normal.dot(view.towards);
                if weight > 0.0 {
                    all += weight;
                    let is_free = view.sees(texel.place + texel.normal * 0.3) && !balls.iter().any(|ball| hits(texel, view.towards, *ball));
                    lit += if is_free { weight } else { 0.0 };
                }
            }
            [lit / all.max(1e-6)]
        });
        Self { size: atlas.size(), shares: fill_gaps(atlas.size(), &shares) }
    }

    /// At a place in texture space, linear between texels.
    pub fn at(&self, uv: Vec2) -> f32 {
        let p = (uv * self.size as f32 - Vec2::splat(0.5)).clamp(Vec2::ZERO, Vec2::splat(self.size as f32 - 1.001));
        let (x, y) = (p.x as usize, p.y as usize);
        let row = |y: usize| lerp(self.shares[y * self.size + x][0], self.shares[y * self.size + x + 1][0], p.x.fract());
        lerp(row(y), row(y + 1), p.y.fract())
    }
}

/// Occlusion in red, roughness in green, strength of highlights in blue (half is 1): skin is no metal, whatever blue says.
pub fn paint(atlas: &Atlas, features: &Features, openness: &Openness) -> Result<Encoded> {
    let size = atlas.size();
    let texels = atlas.map(|texel| {
        // A gamma below 1: what is shut off from the sky still gets light from the skin around it.
        let marks = features.marks(texel);
        // Short hair lies in its own shadow.
        let lit = libm::powf(openness.at(texel.uv), 0.75) * (1.0 - 0.25 * marks.hair);
        // At rest the corners of the mouth are shut; they are seen when they have opened.
        [lit.max(CORNER_LIGHT * marks.lip_corner), roughness(texel, &marks), 128.0 / 255.0 * intensity(&marks)]
    });
    let code = |x: f32| (x.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    let rgb: Vec<u8> = fill_gaps(size, &texels).iter().flat_map(|t| t.map(code)).collect();
    encode::jpeg(size, &rgb, 88)
}

/// Of the skin, perceptual (glTF): oily along the middle of the face, matt on the cheeks. Tuned by eye.
fn roughness(texel: &Texel, marks: &Marks) -> f32 {
    let uneven = 0.035 * fractal(texel.place / 6.0, 3, 301) + 0.02 * fractal(texel.place / 1.4, 2, 302);
    let oily = marks.nose.max(0.40 * marks.forehead).max(0.4 * marks.chin);
    let mut roughness = lerp(0.60, 0.47, oily) + uneven;
    roughness = lerp(roughness, 0.52, marks.upper_lid * 0.6);
    roughness = lerp(roughness, 0.40 + uneven, marks.lip);
    roughness = lerp(roughness, 0.22, marks.waterline.max(0.8 * marks.eye_corner).max(0.6 * marks.lip * marks.lip_gap));
    roughness = lerp(roughness, 0.25, marks.mouth.max(marks.socket));
    lerp(roughness, 0.88, marks.hair.max(0.6 * marks.brow))
}

/// How strong the skin's highlights are, by its oil: nose and lips shine, cheeks hardly, hair breaks light up. Tuned by eye.
fn intensity(marks: &Marks) -> f32 {
    let oily = marks.nose.max(0.45 * marks.forehead).max(0.4 * marks.chin);
    let mut intensity = lerp(0.85, 1.30, oily);
    intensity = lerp(intensity, 1.40, marks.lip);
    intensity = lerp(intensity, 1.50, marks.waterline.max(0.8 * marks.eye_corner));
    intensity = lerp(intensity, 1.30, marks.mouth.max(marks.socket));
    lerp(intensity, 0.35, marks.hair.max(0.6 * marks.brow))
}

/// Nearest distances seen along one direction.
struct DepthView {
    towards: Vec3,
    right: Vec3,
    up: Vec3,
    corner: Vec2,
    scale: f32,
    depths: Vec<f32>,
}

impl DepthView {
    fn new(bust: &Bust, towards: Vec3) -> Self {
        let right = towards.any_orthonormal_vector();
        let up = towards.cross(right);
        let flat = |p: Vec3| Vec2::new(p.dot(right), p.dot(up)) * 1000.0;
        let (low, high) =
            bust.positions.iter().fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(low, high), &p| (low.min(flat(p)), high.max(flat(p))));
        let scale = (DEPTH_SIZE - 1) as f32 / (high - low).max_element();
        let mut view = Self { towards, right, up, corner: low, scale, depths: vec![f32::NEG_INFINITY; DEPTH_SIZE * DEPTH_SIZE] };
        for triangle in &bust.triangles {
            view.fill(triangle.map(|i| view.project(bust.positions[i as usize] * 1000.0)));
        }
        view
    }

    /// Pixel coordinates, and distance along the direction, mm.
    fn project(&self, p: Vec3) -> Vec3 {
        let flat = (Vec2::new(p.dot(self.right), p.dot(self.up)) - self.corner) * self.scale;
        flat.extend(p.dot(self.towards))
    }

    fn sees(&self, p: Vec3) -> bool {
        let p = self.project(p);
        let (x, y) = ((p.x + 0.5).max(0.0) as usize, (p.y + 0.5).max(0.0) as usize);
        self.depths[y.min(DEPTH_SIZE - 1) * DEPTH_SIZE + x.min(DEPTH_SIZE - 1)] <= p.z + BIAS
    }

    fn fill(&mut self, [a, b, c]: [Vec3; 3]) {
        let (ab, ac) = ((b - a).truncate(), (c - a).truncate());
        let area = ab.perp_dot(ac);
        if area.abs() < 1e-9 {
            return;
        }
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        for y in low.y.ceil().max(0.0) as usize..=(high.y.floor() as usize).min(DEPTH_SIZE - 1) {
            for x in low.x.ceil().max(0.0) as usize..=(high.x.floor() as usize).min(DEPTH_SIZE - 1) {
                let p = Vec2::new(x as f32, y as f32) - a.truncate();
                let (second, third) = (p.perp_dot(ac) / area, ab.perp_dot(p) / area);
                if second >= 0.0 && third >= 0.0 && second + third <= 1.0 {
                    let depth = a.z + (b.z - a.z) * second + (c.z - a.z) * third;
                    let nearest = &mut self.depths[y * DEPTH_SIZE + x];
                    *nearest = nearest.max(depth);
                }
            }
        }
    }
}

/// Points of a spiral over the sphere (Vogel): evenly spread without clusters.
fn spiral(index: usize) -> Vec3 {
    let y = 1.0 - (2.0 * index as f32 + 1.0) / NUM_DIRECTIONS as f32;
    let radius = (1.0 - y * y).sqrt();
    // The golden angle, radians.
    let (sin, cos) = libm::sincosf(2.399_963_2 * index as f32);
    Vec3::new(cos * radius, y, sin * radius)
}

fn hits(texel: &Texel, towards: Vec3, (centre, radius): (Vec3, f32)) -> bool {
    let to_centre = centre - texel.place;
    let along = to_centre.dot(towards);
    let squared = to_centre.length_squared();
    // From inside the ball (the back of the lids) nothing is decided by it.
    squared > radius * radius && along > 0.0 && squared - along * along < radius * radius * 0.96
}
