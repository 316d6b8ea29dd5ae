//! A map of the face to draw on: the skin unrolled from a cylinder about the vertical axis of the head.

use super::super::bust::{Bust, Region};
use super::super::landmarks::mirror;
use super::noise::{lerp, smoothstep};
use glam::{Mat3, Vec2, Vec3};

/// Grid step of the unrolled skin, mm.
const STEP: f32 = 0.5;
/// Radius at which unrolled millimetres are true ones; about that of a face.
const RADIUS: f32 = 80.0;

/// Landmarks and outer skin in unrolled coordinates: x to the character's left along the skin, y up, millimetres.
pub struct Chart {
    landmarks: [Vec3; 68],
    axis_z: f32,
    scale: f32,
    bottom: f32,
    width: usize,
    skin: Vec<Option<(Vec3, Vec3)>>,
}

/// A side of the face.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The character's left, +X.
    Left,
    /// The character's right.
    Right,
}

impl Side {
    /// Both.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];

    /// +1 on the left, -1 on the right.
    pub fn sign(self) -> f32 {
        match self {
            Self::Left => 1.0,
            Self::Right => -1.0,
        }
    }
}

impl Chart {
    /// Unrolls the outermost skin.
    pub fn new(surface: &Bust) -> Self {
        let landmarks = surface.ibug68.map(|p| p * 1000.0);
        // The axis stands between the front edges of the ears, where a face curves about.
        let axis_z = (landmarks[0].z + landmarks[16].z) / 2.0;
        let pupils = (mean(&landmarks[36..42]), mean(&landmarks[42..48]));
        let heights = || surface.positions.iter().map(|p| p.y * 1000.0);
        let bottom = heights().fold(f32::MAX, f32::min);
        let height = ((heights().fold(f32::MIN, f32::max) - bottom) / STEP) as usize + 2;
        let width = (2.0 * std::f32::consts::PI * RADIUS / STEP) as usize + 1;
        let scale = (pupils.1 - pupils.0).length() / 60.0;
        let mut chart = Self { landmarks, axis_z, scale, bottom, width, skin: vec![None; width * height] };
        for corners in &surface.triangles {
            let corners = corners.map(|i| i as usize);
            if corners.iter().all(|&i| !matches!(surface.regions[i], Region::Mouth | Region::Socket | Region::Cap)) {
                chart.fill(corners.map(|i| surface.positions[i] * 1000.0), corners.map(|i| surface.normals[i]));
            }
        }
        chart
    }

    /// A landmark, mm.
    pub fn landmark(&self, index: usize) -> Vec3 {
        self.landmarks[index]
    }

    /// Mean of some landmarks, mm.
    pub fn middle(&self, indices: &[usize]) -> Vec3 {
        indices.iter().fold(Vec3::ZERO, |sum, &i| sum + self.landmarks[i]) / indices.len() as f32
    }

    /// How much larger this face is than one whose pupils are 60 mm apart.
    pub fn scale(&self) -> f32 {
        self.scale
    }

    /// Unrolls a place.
    pub fn unroll(&self, p: Vec3) -> Vec2 {
        Vec2::new(libm::atan2f(p.x, p.z - self.axis_z) * RADIUS, p.y)
    }

    /// The point `offset` millimetres of a normal face (x away from the middle, y up) from a landmark of the left half
    /// of the face, or from its mirror image.
    pub fn at(&self, side: Side, index: usize, offset: (f32, f32)) -> Vec2 {
        let index = if side == Side::Left { index } else { mirror(index) };
        self.unroll(self.landmarks[index]) + Vec2::new(side.sign() * offset.0, offset.1) * self.scale
    }

    /// Place and normal of the outermost skin there; `None` where there is none.
    pub fn skin(&self, unrolled: Vec2) -> Option<(Vec3, Vec3)> {
        let (x, y) = (unrolled.x / STEP + self.width as f32 / 2.0, (unrolled.y - self.bottom) / STEP);
        let (cx, cy) = (x.floor(), y.floor());
        if cx < 0.0 || cy < 0.0 || cx as usize + 1 >= self.width {
            return None;
        }
        let (mut place, mut normal, mut total) = (Vec3::ZERO, Vec3::ZERO, 0.0);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let index = (cy as usize + dy) * self.width + cx as usize + dx;
            if let Some(Some((p, n))) = self.skin.get(index) {
                let weight = (1.0 - (x - cx - dx as f32).abs()) * (1.0 - (y - cy - dy as f32).abs());
                (place, normal, total) = (place + *p * weight, normal + *n * weight, total + weight);
            }
        }
        (total > 1e-3).then(|| (place / total, normal.normalize_or(Vec3::Z)))
    }

    /// 1 on the front of the head, 0 behind the ears.
    pub fn front(&self, p: Vec3) -> f32 {
        smoothstep(self.axis_z - 25.0, self.axis_z, p.z)
    }

    fn fill(&mut self, places: [Vec3; 3], normals: [Vec3; 3]) {
        let flat = places.map(|p| {
            let u = self.unroll(p);
            Vec2::new(u.x / STEP + self.width as f32 / 2.0, (u.y - self.bottom) / STEP)
        });
        let (low, high) = (flat[0].min(flat[1]).min(flat[2]), flat[0].max(flat[1]).max(flat[2]));
        if high.x - low.x > self.width as f32 / 2.0 {
            // Across the back of the head, where nothing is drawn.
            return;
        }
        let area = (flat[1] - flat[0]).perp_dot(flat[2] - flat[0]);
        if area.abs() < 1e-6 {
            return;
        }
        for y in low.y.ceil() as usize..=high.y.floor().max(0.0) as usize {
            for x in low.x.ceil().max(0.0) as usize..=high.x.floor().max(0.0) as usize {
                let p = Vec2::new(x as f32, y as f32) - flat[0];
                let second = p.perp_dot(flat[2] - flat[0]) / area;
                let third = (flat[1] - flat[0]).perp_dot(p) / area;
                let first = 1.0 - second - third;
                let index = y * self.width + x;
                if first < -1e-4 || second < -1e-4 || third < -1e-4 || x >= self.width || index >= self.skin.len() {
                    continue;
                }
                let blend = |v: [Vec3; 3]| v[0] * first + v[1] * second + v[2] * third;
                let (place, normal) = (blend(places), blend(normals));
                let reach = |p: Vec3| p.x * p.x + (p.z - self.axis_z) * (p.z - self.axis_z);
                if self.skin[index].is_none_or(|(old, _)| reach(place) > reach(old)) {
                    self.skin[index] = Some((place, normal));
                }
            }
        }
    }
}

/// A smooth curve through `points` (centripetal Catmull–Rom would do no better at these spacings), `per_span` samples
/// between two of them.
pub fn spline(points: &[Vec2], per_span: usize) -> Vec<Vec2> {
    let at = |i: isize| points[i.clamp(0, points.len() as isize - 1) as usize];
    let mut out = Vec::new();
    for i in 0..points.len() as isize - 1 {
        let (a, b, c, d) = (at(i - 1), at(i), at(i + 1), at(i + 2));
        for k in 0..per_span {
            let t = k as f32 / per_span as f32;
            out.push(0.5 * (b * 2.0 + (c - a) * t + (a * 2.0 - b * 5.0 + c * 4.0 - d) * t * t + (b * 3.0 - a - c * 3.0 + d) * t * t * t));
        }
    }
    out.extend(points.last());
    out
}

/// The smooth arch (least-squares parabola) through points that run from the middle outwards or the other way.
pub fn arch(points: &[Vec2]) -> Vec<Vec2> {
    let (first, last) = (points[0].x, points[points.len() - 1].x);
    let share = |p: &Vec2| (p.x - first) / (last - first);
    // Normal equations of y = a + b t + c t^2 by Cramer's rule; t in [0, 1] keeps them well conditioned.
    let sum = |of: &dyn Fn(&Vec2) -> f32| points.iter().map(of).sum::<f32>();
    let powers = |p: &Vec2| {
        let t = share(p);
        [1.0, t, t * t, t * t * t, t * t * t * t]
    };
    let power = |n: usize| sum(&|p| powers(p)[n]);
    let moment = |n: usize| sum(&|p| powers(p)[n] * p.y);
    let matrix = |columns: [[f32; 3]; 3]| Mat3::from_cols_array_2d(&columns).determinant();
    let columns = [[power(0), power(1), power(2)], [power(1), power(2), power(3)], [power(2), power(3), power(4)]];
    let right = [moment(0), moment(1), moment(2)];
    let all = matrix(columns);
    let coefficient = |k: usize| {
        let mut replaced = columns;
        replaced[k] = right;
        matrix(replaced) / all
    };
    let [a, b, c] = [0, 1, 2].map(coefficient);
    (0..=32).map(|i| i as f32 / 32.0).map(|t| Vec2::new(lerp(first, last, t), a + (b + c * t) * t)).collect()
}

fn mean(points: &[Vec3]) -> Vec3 {
    points.iter().sum::<Vec3>() / points.len() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splines_pass_through_their_points() {
        let points = [Vec2::ZERO, Vec2::new(3.0, 1.0), Vec2::new(5.0, -2.0)];
        let curve = spline(&points, 8);
        assert_eq!((curve[0], curve[8], curve[16]), (points[0], points[1], points[2]));
    }

    #[test]
    fn an_arch_is_the_parabola_its_points_lie_on() {
        let points: Vec<Vec2> = [3.0, 5.0, 6.0, 9.0, 11.0].iter().map(|&x: &f32| Vec2::new(x, 2.0 + x - 0.1 * x * x)).collect();
        for p in arch(&points) {
            assert!((p.y - (2.0 + p.x - 0.1 * p.x * p.x)).abs() < 1e-4, "{p}");
        }
    }
}
