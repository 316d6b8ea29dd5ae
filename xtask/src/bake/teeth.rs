//! Teeth, gums and tongue. MakeHuman's helper teeth are two bars: they only say where the arches lie.

use super::base::Base;
use super::mesh::{Face, Mesh};
use super::part::{Binding, Material, Part, sparse};
use super::random::Random;
use super::rig::HEAD;
use super::subdivide::subdivide;
use super::weights::{shape, smoothstep};
use glam::{Vec2, Vec3};
use rhytid_shared::ARKIT_NAMES;
use std::f32::consts::TAU;

/// A crown: width along the arch, height, thickness from lip to tongue (all metres, after mean human crowns), and how
/// sharp its edge is (1 a blade, 0 flat).
struct Crown {
    width: f32,
    height: f32,
    depth: f32,
    sharpness: f32,
}

const fn crown(width_mm: f32, height_mm: f32, depth_mm: f32, sharpness: f32) -> Crown {
    Crown { width: width_mm * 1e-3, height: height_mm * 1e-3, depth: depth_mm * 1e-3, sharpness }
}

/// From the middle backwards.
const UPPER: [Crown; 7] = [
    crown(8.6, 10.4, 6.6, 0.80),
    crown(6.7, 9.4, 6.0, 0.80),
    crown(7.7, 10.2, 7.6, 0.65),
    crown(7.0, 8.6, 8.6, 0.25),
    crown(6.8, 7.8, 8.6, 0.20),
    crown(9.9, 7.2, 10.2, 0.05),
    crown(9.4, 6.8, 10.0, 0.05),
];
const LOWER: [Crown; 7] = [
    crown(5.4, 8.8, 5.8, 0.80),
    crown(6.0, 9.0, 6.0, 0.80),
    crown(7.0, 10.2, 7.2, 0.65),
    crown(7.1, 8.4, 7.6, 0.30),
    crown(7.2, 8.0, 8.0, 0.20),
    crown(10.8, 7.2, 9.8, 0.05),
    crown(10.2, 6.9, 9.6, 0.05),
];

/// Outer line of an arch from the middle backwards: millimetres from the middle, and behind the foremost point.
type Line = [(f32, f32); 10];

/// Cusps of the canines 34 mm apart, of the first molars about 50 (means of grown people): the helper bars are as wide as
/// the mouth, and teeth as wide as that would stand out of its corners.
const UPPER_LINE: Line =
    [(0.0, 0.0), (4.5, 0.3), (8.8, 1.4), (13.8, 3.8), (17.4, 7.8), (19.8, 13.6), (22.2, 20.6), (24.6, 29.0), (26.6, 39.0), (27.6, 47.0)];
/// Canines 26 mm apart, first molars about 44.
const LOWER_LINE: Line =
    [(0.0, 0.0), (4.0, 0.3), (7.8, 1.5), (11.2, 4.0), (14.0, 7.8), (16.6, 13.5), (19.2, 20.5), (22.0, 29.5), (24.4, 39.5), (25.6, 48.0)];

/// How far behind the helper bar's front the outer surface lies, metres.
const UPPER_INSET: f32 = 0.000_6;
const LOWER_INSET: f32 = 0.002_9;
/// How much lower than the helper bars' meeting plane the edges stand, metres. The upper incisors show below a parted
/// upper lip, the lower ones stay behind the lower lip.
const UPPER_DROP: f32 = 0.005_4;
const LOWER_DROP: f32 = 0.005_6;
/// How far crowns reach into the gum, metres.
const BURIED: f32 = 0.002_0;
/// How far the gum reaches beyond the crowns' necks, metres.
const GUM_HEIGHT: f32 = 0.008;

const NUM_AROUND: u32 = 12;
/// Heights of a crown's rings, root to edge, with their size: width, depth.
const RINGS: [(f32, f32, f32); 8] = [
    (0.00, 0.86, 0.88),
    (0.20, 0.92, 0.98),
    (0.42, 0.97, 1.00),
    (0.64, 1.00, 0.92),
    (0.82, 1.00, 0.80),
    (0.93, 0.96, 0.66),
    (0.985, 0.87, 0.52),
    (1.0, 0.70, 0.36),
];

/// One dental arch in the frame of the head.
struct Arch {
    low: Vec3,
    high: Vec3,
    line: &'static Line,
    inset: f32,
    drop: f32,
    /// -1 for the upper jaw, whose crowns grow down.
    up: f32,
}

impl Arch {
    fn upper(base: &Base) -> Self {
        let (low, high) = bounds(base, UPPER_BAR);
        Self { low, high, line: &UPPER_LINE, inset: UPPER_INSET, drop: UPPER_DROP, up: -1.0 }
    }

    fn lower(base: &Base) -> Self {
        let (low, high) = bounds(base, LOWER_BAR);
        Self { low, high, line: &LOWER_LINE, inset: LOWER_INSET, drop: LOWER_DROP, up: 1.0 }
    }

    /// Point of the outer line; `u` -1 to 1 from the right end over the middle to the left one.
    fn outer(&self, u: f32) -> Vec2 {
        let x = u.abs().min(1.0) * (self.line.len() - 1) as f32;
        let i = (x as usize).min(self.line.len() - 2);
        let p = Vec2::from(self.line[i]).lerp(Vec2::from(self.line[i + 1]), x - i as f32) * 1e-3;
        let middle = 0.5 * (self.low.x + self.high.x);
        Vec2::new(middle + u.signum() * p.x, self.high.z - self.inset - p.y)
    }

    /// Samples of the outer line: place and length from the middle, one side.
    fn lengths(&self, side: f32) -> Vec<(Vec2, f32)> {
        const NUM_SAMPLES: usize = 160;
        let mut length = 0.0;
        let mut last = self.outer(0.0);
        (0..=NUM_SAMPLES)
            .map(|i| {
                let at = self.outer(side * i as f32 / NUM_SAMPLES as f32);
                length += at.distance(last);
                last = at;
                (at, length)
            })
            .collect()
    }

    /// Height of the crowns' edges: the plane in which the two bars meet.
    fn edge(&self, z: f32) -> f32 {
        let t = (z - self.low.z) / (self.high.z - self.low.z);
        let front = if self.up < 0.0 { self.low.y } else { self.high.y - 0.22 * (self.high.y - self.low.y) };
        let back = if self.up < 0.0 { self.low.y + 0.30 * (self.high.y - self.low.y) } else { self.high.y };
        back + (front - back) * t - self.drop
    }
}

const UPPER_BAR: &str = "helper-upper-teeth";
const LOWER_BAR: &str = "helper-lower-teeth";

fn bounds(base: &Base, group: &str) -> (Vec3, Vec3) {
    let points = base.obj.vertices_of(group).into_iter().map(|v| base.positions[v as usize]);
    points.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

/// Both rows of teeth with their gums.
pub fn build(base: &Base, jaw: u8) -> Part {
    let mut part = Part {
        material: Material::Teeth,
        positions: Vec::new(),
        normals: Vec::new(),
        tangents: None,
        uvs: Vec::new(),
        bindings: Vec::new(),
        morphs: vec![Vec::new(); ARKIT_NAMES.len()],
        triangles: Vec::new(),
    };
    for (arch, group, crowns, joint) in [(Arch::upper(base), UPPER_BAR, &UPPER, HEAD), (Arch::lower(base), LOWER_BAR, &LOWER, jaw)] {
        let first = part.positions.len() as u32;
        row(&mut part, &arch, crowns);
        part.bindings.resize(part.positions.len(), Binding::rigid(joint));
        carry(&mut part, base, group, first);
    }
    part.normals = smooth_normals(&part.positions, &part.triangles);
    part
}

/// Crowns and gum of one arch.
fn row(part: &mut Part, arch: &Arch, crowns: &[Crown; 7]) {
    let mut random = Random::new(if arch.up < 0.0 { 5 } else { 6 });
    let mut necks: Vec<(Vec3, Vec3, f32)> = Vec::new();
    for side in [-1.0, 1.0] {
        let samples = arch.lengths(side);
        let whole: f32 = crowns.iter().map(|crown| crown.width).sum();
        let scale = (samples[samples.len() - 1].1 / whole).min(1.0);
        let mut from = 0.0;
        for (number, crown) in crowns.iter().enumerate() {
            let width = crown.width * scale;
            let at = |length: f32| samples.iter().find(|sample| sample.1 >= length).map_or(samples[samples.len() - 1].0, |sample| sample.0);
            let (start, end, middle) = (at(from), at(from + width), at(from + 0.5 * width));
            from += width;
            let flat = (end - start).normalize_or(Vec2::X) * side;
            // Real rows are never quite straight.
            let turn = 0.05 * random.signed();
            let along = Vec3::new(flat.x + turn * flat.y, 0.0, flat.y - turn * flat.x).normalize();
            let outwards = along.cross(Vec3::Y) * -1.0;
            let outwards = if outwards.z * 2.0 + outwards.x * side > 0.0 { outwards } else { -outwards };
            let edge = arch.edge(middle.y) + 0.000_35 * random.signed();
            let height = crown.height * (1.0 + 0.03 * random.signed());
            let neck = Vec3::new(middle.x, edge - arch.up * height, middle.y) - outwards * (0.5 * crown.depth + 0.000_3 * random.unit());
            let first = part.uvs.len();
            necks.push((neck + outwards * 0.5 * crown.depth, outwards, crown.depth));
            push_crown(part, crown, neck, [along, Vec3::Y * arch.up, outwards], width * 0.985, height);
            // Each has its own stripe of the picture: the further back, the less light comes in.
            part.uvs[first..].iter_mut().for_each(|uv| uv.x = (number as f32 + 0.1 + 0.8 * uv.x) / crowns.len() as f32);
        }
        if side < 0.0 {
            necks.reverse();
        }
    }
    gum(part, &necks, arch.up);
}

/// A crown from its neck; `frame`: along the arch, towards the edge, towards the lip.
fn push_crown(part: &mut Part, crown: &Crown, neck: Vec3, frame: [Vec3; 3], width: f32, height: f32) {
    let first = part.positions.len() as u32;
    let [along, grows, outwards] = frame;
    for (t, w, d) in RINGS {
        // A blade is thin at its edge, a molar keeps its depth.
        let depth = crown.depth * (d * crown.sharpness + (0.82 + 0.18 * d) * (1.0 - crown.sharpness));
        let y = -BURIED + t * (height + BURIED);
        for i in 0..NUM_AROUND {
            let (sin, cos) = libm::sincosf(TAU * i as f32 / NUM_AROUND as f32);
            // Superellipse: between a circle and a box. The outer face stays over the neck's, the inner one recedes.
            let square = |x: f32| x.signum() * libm::powf(x.abs(), 0.62);
            let x = square(cos) * 0.5 * width * (w + (1.0 - w) * 0.3 * (1.0 - crown.sharpness));
            let z = 0.5 * crown.depth - 0.5 * depth * (1.0 - square(sin)) - 0.06 * crown.depth * (2.0 * t - 1.0) * (2.0 * t - 1.0);
            part.positions.push(neck + along * x + grows * y + outwards * z);
            part.uvs.push(Vec2::new(i as f32 / NUM_AROUND as f32, 0.02 + 0.44 * t));
        }
    }
    let top = part.positions.len() as u32;
    let last_ring = &part.positions[(top - NUM_AROUND) as usize..];
    let middle = last_ring.iter().copied().sum::<Vec3>() / NUM_AROUND as f32;
    part.positions.push(middle + grows * 0.000_1);
    part.uvs.push(Vec2::new(0.5, 0.47));
    let is_flipped = along.cross(grows).dot(outwards) < 0.0;
    let mut push = |t: [u32; 3]| part.triangles.push(if is_flipped { [t[0], t[2], t[1]] } else { t });
    for i in 0..NUM_AROUND {
        let j = (i + 1) % NUM_AROUND;
        for ring in 0..RINGS.len() as u32 - 1 {
            let (a, b) = (first + ring * NUM_AROUND + i, first + ring * NUM_AROUND + j);
            push([a, a + NUM_AROUND, b]);
            push([b, a + NUM_AROUND, b + NUM_AROUND]);
        }
        push([top - NUM_AROUND + i, top, top - NUM_AROUND + j]);
    }
}

/// The gum: a band round the necks, drawn out between the crowns and back over each of them.
fn gum(part: &mut Part, necks: &[(Vec3, Vec3, f32)], up: f32) {
    const STEPS: usize = 6;
    /// Across the band from the lip's side over the ridge to the tongue's: outwards in half depths, towards the root in metres.
    const PROFILE: [(f32, f32); 7] = [(1.00, 1.0), (1.12, 0.55), (1.08, 0.15), (0.72, -0.02), (-0.9, -0.02), (-1.18, 0.2), (-1.1, 1.0)];
    /// How far the gum reaches up between two crowns, counted from the last molar, metres.
    const PAPILLA: [f32; 5] = [0.001_6, 0.001_8, 0.002_2, 0.002_8, 0.003_2];
    let first = part.positions.len() as u32;
    let num_columns = (necks.len() - 1) * STEPS + 1;
    for column in 0..num_columns {
        let (i, f) = (column / STEPS, (column % STEPS) as f32 / STEPS as f32);
        let (a, b) = (necks[i], necks[(i + 1).min(necks.len() - 1)]);
        let (at, outwards, depth) = (a.0.lerp(b.0, f), a.1.lerp(b.1, f).normalize(), a.2 + (b.2 - a.2) * f);
        let between = libm::sinf(std::f32::consts::PI * f);
        let between = between * between;
        // It fills what the crowns leave open down to where they touch; between molars that is less.
        let from_end = i.min((necks.len() - 2).saturating_sub(i)).min(PAPILLA.len() - 1);
        let papilla = PAPILLA[from_end] * between * between - 0.000_2;
        let middle = at - outwards * 0.5 * depth;
        for (p, (out, root)) in PROFILE.into_iter().enumerate() {
            let drop = if root > 0.9 { -GUM_HEIGHT } else { papilla - root * 0.006 };
            let thickness = 0.5 * depth * (1.0 - 0.10 * between);
            part.positions.push(middle + outwards * (out * thickness) + Vec3::Y * (up * drop));
            part.uvs.push(Vec2::new(column as f32 / num_columns as f32, 0.95 - 0.4 * (p as f32 / 6.0)));
        }
    }
    let width = PROFILE.len() as u32;
    for column in 0..num_columns as u32 - 1 {
        for p in 0..width - 1 {
            let a = first + column * width + p;
            let (b, c, d) = (a + 1, a + width, a + width + 1);
            let quad = [[a, c, b], [b, c, d]];
            part.triangles.extend(quad.map(|t| if up > 0.0 { t } else { [t[0], t[2], t[1]] }));
        }
    }
}

/// Gives the vertices from `first` on the rigid motion the shapes give the helper bar: its mean displacement, and for
/// `jawOpen` that of the bar's nearest vertex, which is exact for a turn.
fn carry(part: &mut Part, base: &Base, group: &str, first: u32) {
    let helpers = base.obj.vertices_of(group);
    for shape in 0..ARKIT_NAMES.len() {
        let dense = base.dense_morph(shape);
        if helpers.iter().all(|&v| dense[v as usize] == Vec3::ZERO) {
            continue;
        }
        let fit = Affine::fit(&helpers.iter().map(|&v| (base.positions[v as usize], dense[v as usize])).collect::<Vec<_>>());
        let deltas = part.positions[first as usize..].iter().map(|&p| fit.at(p));
        part.morphs[shape].extend(sparse(deltas).into_iter().map(|(v, delta)| (v + first, delta)));
    }
}

/// A displacement that is linear in the position.
struct Affine {
    centre: Vec3,
    mean: Vec3,
    linear: glam::Mat3,
}

impl Affine {
    /// Least squares over `(position, displacement)`.
    fn fit(samples: &[(Vec3, Vec3)]) -> Self {
        let count = samples.len() as f32;
        let centre = samples.iter().map(|s| s.0).sum::<Vec3>() / count;
        let mean = samples.iter().map(|s| s.1).sum::<Vec3>() / count;
        let (mut moments, mut products) = (glam::Mat3::ZERO, glam::Mat3::ZERO);
        for &(p, d) in samples {
            let arm = p - centre;
            let outer = |a: Vec3, b: Vec3| glam::Mat3::from_cols(a * b.x, a * b.y, a * b.z);
            moments += outer(arm, arm);
            products += outer(d - mean, arm);
        }
        Self { centre, mean, linear: products * moments.inverse() }
    }

    fn at(&self, p: Vec3) -> Vec3 {
        self.mean + self.linear * (p - self.centre)
    }
}

fn smooth_normals(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; positions.len()];
    for &triangle in triangles {
        let [a, b, c] = triangle.map(|v| positions[v as usize]);
        triangle.iter().for_each(|&v| normals[v as usize] += (b - a).cross(c - a));
    }
    normals.into_iter().map(|normal| normal.normalize_or(Vec3::Y)).collect()
}

/// The tongue: MakeHuman's helper, flattened (it fills the closed mouth and would bulge out of the open one), smoothed,
/// bound to the jaw.
pub fn tongue(base: &Base, jaw: u8) -> Part {
    const FLATNESS: f32 = 0.66;
    /// It lies inside the lower arch: narrower than the helper, and its tip behind the incisors.
    const NARROWNESS: f32 = 0.78;
    const SHORTNESS: f32 = 0.90;
    /// What it is shorter by it must reach further to come out.
    const STRETCH: f32 = 1.35;
    let polygons = &base.obj.groups["helper-tongue"];
    let mut coarse = Mesh {
        positions: base.positions.clone(),
        morphs: (0..ARKIT_NAMES.len()).map(|shape| base.dense_morph(shape)).collect(),
        uvs: base.obj.uvs.clone(),
        faces: polygons
            .iter()
            .map(|polygon| Face { vertices: polygon.iter().map(|c| c.0).collect(), uvs: polygon.iter().map(|c| c.1).collect() })
            .collect(),
    };
    coarse.compact();
    let (low, high) = coarse.positions.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)));
    let fixed = Vec3::new(0.5 * (low.x + high.x), low.y, low.z);
    for position in &mut coarse.positions {
        *position = fixed + (*position - fixed) * Vec3::new(NARROWNESS, FLATNESS, SHORTNESS);
    }
    let mut mesh = subdivide(&coarse);
    for (position, out) in mesh.positions.iter().zip(&mut mesh.morphs[shape("tongueOut")]) {
        // Over the lower teeth and lip, and down again in front of them.
        out.z *= STRETCH;
        let reached = position.z + out.z;
        out.y += 0.008 * smoothstep(0.045, 0.068, reached) - 0.006 * smoothstep(0.078, 0.096, reached);
    }
    let mut uvs = vec![Vec2::ZERO; mesh.positions.len()];
    for face in &mesh.faces {
        face.vertices.iter().zip(&face.uvs).for_each(|(&v, &t)| uvs[v as usize] = mesh.uvs[t as usize]);
    }
    Part {
        material: Material::Tongue,
        normals: mesh.normals(&mesh.positions),
        tangents: None,
        uvs,
        bindings: vec![Binding::rigid(jaw); mesh.positions.len()],
        morphs: mesh.morphs.iter().map(|shape| sparse(shape.iter().copied())).collect(),
        triangles: mesh.triangles().into_iter().map(|triangle| triangle.map(|corner| corner.0)).collect(),
        positions: mesh.positions,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn affine_fit_recovers_a_turn() {
        let turn = |p: Vec3| Vec3::new(0.0, -0.1 * p.z, 0.1 * p.y) + Vec3::new(0.0, 0.01, 0.0);
        let samples: Vec<(Vec3, Vec3)> = (0..20)
            .map(|i| Vec3::new(libm::sinf(i as f32), libm::cosf(2.3 * i as f32), libm::sinf(1.1 * i as f32 + 1.0)))
            .map(|p| (p, turn(p)))
            .collect();
        let p = Vec3::new(0.4, -0.2, 0.9);
        assert!(Affine::fit(&samples).at(p).distance(turn(p)) < 1e-5);
    }
}
