//! The skin atlas: which place on the skin each texel shows.

use super::super::bust::{Bust, Region};
use glam::{Vec2, Vec3};

/// Texels beyond the islands that still get their own place, so that bilinear samples at seams are right.
const SKIRT: usize = 3;
const NONE: u32 = u32::MAX;

/// The surface rasterised in texture space, `size`² texels.
pub struct Atlas<'a> {
    surface: &'a Bust,
    size: usize,
    triangles: Vec<u32>,
}

/// What one texel shows. Millimetres, head space.
#[derive(Debug, Clone, Copy)]
pub struct Texel {
    /// Centre of the texel in texture space.
    pub uv: Vec2,
    /// Place on the rest surface, mm.
    pub place: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Unit tangent, along +u.
    pub tangent: Vec3,
    /// Unit bitangent, where green points: along -v, up in the picture.
    pub bitangent: Vec3,
    corners: [Region; 3],
    vertices: [usize; 3],
    weights: [f32; 3],
}

impl Texel {
    /// How much the place belongs to a region, 0 to 1, linear between vertices.
    pub fn share(&self, region: Region) -> f32 {
        (0..3).filter(|&k| self.corners[k] == region).map(|k| self.weights[k]).sum::<f32>().clamp(0.0, 1.0)
    }
}

impl<'a> Atlas<'a> {
    /// Rasterises `surface`.
    pub fn new(surface: &'a Bust, size: usize) -> Self {
        let mut atlas = Self { surface, size, triangles: vec![NONE; size * size] };
        for triangle in 0..surface.triangles.len() {
            atlas.fill(triangle as u32);
        }
        for _ in 0..SKIRT {
            atlas.grow();
        }
        atlas
    }

    /// Texels a side.
    pub fn size(&self) -> usize {
        self.size
    }

    /// What texel `(x, y)` shows; `None` outside the islands.
    pub fn texel(&self, x: usize, y: usize) -> Option<Texel> {
        let triangle = self.triangles[y * self.size + x];
        if triangle == NONE {
            return None;
        }
        let corners = self.surface.triangles[triangle as usize].map(|i| i as usize);
        let weights = self.weights(corners, self.centre(x, y));
        let sum3 = |values: &[Vec3]| (0..3).fold(Vec3::ZERO, |sum, k| sum + values[corners[k]] * weights[k]);
        let normal = sum3(&self.surface.normals).normalize_or(Vec3::Z);
        let raw = (0..3).fold(Vec3::ZERO, |sum, k| sum + self.surface.tangents[corners[k]].truncate() * weights[k]);
        let tangent = (raw - normal * normal.dot(raw)).normalize_or(normal.any_orthonormal_vector());
        Some(Texel {
            uv: self.centre(x, y),
            place: sum3(&self.surface.positions) * 1000.0,
            normal,
            tangent,
            bitangent: normal.cross(tangent) * self.surface.tangents[corners[0]].w,
            corners: corners.map(|i| self.surface.regions[i]),
            vertices: corners,
            weights,
        })
    }

    /// As [`Atlas::texel`], with how far the place moves from texel to texel along x and y, mm.
    pub fn texel_with_steps(&self, x: usize, y: usize) -> Option<(Texel, [Vec3; 2])> {
        let texel = self.texel(x, y)?;
        let [a, b, c] = self.surface.triangles[self.triangles[y * self.size + x] as usize].map(|i| i as usize);
        let (e1, e2) = (self.surface.positions[b] - self.surface.positions[a], self.surface.positions[c] - self.surface.positions[a]);
        let (d1, d2) = (self.surface.uvs[b] - self.surface.uvs[a], self.surface.uvs[c] - self.surface.uvs[a]);
        let per_texel = 1000.0 / (d1.perp_dot(d2) * self.size as f32);
        let steps = [(e1 * d2.y - e2 * d1.y) * per_texel, (e2 * d1.x - e1 * d2.x) * per_texel];
        steps.iter().all(|step| step.is_finite()).then_some((texel, steps))
    }

    /// True on the islands and their skirts.
    pub fn is_covered(&self, x: usize, y: usize) -> bool {
        self.triangles[y * self.size + x] != NONE
    }

    /// A value given for each vertex, linear over the triangle a texel lies in.
    pub fn between_vertices(&self, texel: &Texel, values: &[f32]) -> f32 {
        (0..3).map(|k| values[texel.vertices[k]] * texel.weights[k]).sum()
    }

    /// Computes one value a covered texel, rows shared between two threads; `None` outside the islands.
    pub fn map<T: Send + Clone>(&self, value: impl Fn(&Texel) -> T + Sync) -> Vec<Option<T>> {
        let mut out = vec![None; self.size * self.size];
        let half = self.size / 2 * self.size;
        let (top, bottom) = out.split_at_mut(half);
        std::thread::scope(|scope| {
            for (start, rows) in [(0, top), (half, bottom)] {
                let value = &value;
                scope.spawn(move || {
                    for (offset, slot) in rows.iter_mut().enumerate() {
                        let index = start + offset;
                        *slot = self.texel(index % self.size, index / self.size).map(|texel| value(&texel));
                    }
                });
            }
        });
        out
    }

    fn centre(&self, x: usize, y: usize) -> Vec2 {
        Vec2::new(x as f32 + 0.5, y as f32 + 0.5) / self.size as f32
    }

    fn weights(&self, corners: [usize; 3], uv: Vec2) -> [f32; 3] {
        let [a, b, c] = corners.map(|i| self.surface.uvs[i]);
        let (ab, ac, ap) = (b - a, c - a, uv - a);
        let area = ab.perp_dot(ac);
        if area.abs() < 1e-14 {
            return [1.0, 0.0, 0.0];
        }
        let (second, third) = (ap.perp_dot(ac) / area, ab.perp_dot(ap) / area);
        [1.0 - second - third, second, third]
    }

    fn fill(&mut self, triangle: u32) {
        let corners = self.surface.triangles[triangle as usize].map(|i| i as usize);
        let uvs = corners.map(|i| self.surface.uvs[i] * self.size as f32);
        let low = uvs[0].min(uvs[1]).min(uvs[2]);
        let high = uvs[0].max(uvs[1]).max(uvs[2]);
        let first = |v: f32| ((v - 0.5).ceil().max(0.0)) as usize;
        let end = |v: f32| (((v - 0.5).floor() + 1.0).max(0.0) as usize).min(self.size);
        for y in first(low.y)..end(high.y) {
            for x in first(low.x)..end(high.x) {
                let weights = self.weights(corners, self.centre(x, y));
                if weights.iter().all(|&w| w >= -1e-5) {
                    self.triangles[y * self.size + x] = triangle;
                }
            }
        }
    }

    fn grow(&mut self) {
        let (old, size) = (self.triangles.clone(), self.size);
        for y in 0..size {
            for x in 0..size {
                if old[y * size + x] != NONE {
                    continue;
                }
                let mut found = NONE;
                for (dx, dy) in [(0i32, -1i32), (-1, 0), (1, 0), (0, 1)] {
                    let (nx, ny) = (x as i32 + dx, y as i32 + dy);
                    if (0..size as i32).contains(&nx) && (0..size as i32).contains(&ny) && found == NONE {
                        found = old[ny as usize * size + nx as usize];
                    }
                }
                self.triangles[y * size + x] = found;
            }
        }
    }
}

/// Fills what lies outside the islands from the nearest islands, coarser the farther away, so that no mip level mixes
/// in a foreign colour.
pub fn fill_gaps<const N: usize>(size: usize, texels: &[Option<[f32; N]>]) -> Vec<[f32; N]> {
    if size == 1 {
        return vec![texels[0].unwrap_or([0.0; N])];
    }
    let half = size / 2;
    let coarse: Vec<Option<[f32; N]>> = (0..half * half)
        .map(|i| {
            let (x, y) = (i % half * 2, i / half * 2);
            let (mut sum, mut count) = ([0.0; N], 0.0);
            for texel in [(0, 0), (1, 0), (0, 1), (1, 1)].iter().filter_map(|(dx, dy)| texels[(y + dy) * size + x + dx]) {
                (0..N).for_each(|c| sum[c] += texel[c]);
                count += 1.0;
            }
            (count > 0.0).then(|| sum.map(|v| v / count))
        })
        .collect();
    let coarse = fill_gaps(half, &coarse);
    (0..size * size).map(|i| texels[i].unwrap_or_else(|| coarse[i / size / 2 * half + i % size / 2])).collect()
}

#[cfg(test)]
mod tests {
    use super::super::sample::plane;
    use super::*;

    #[test]
    fn texels_show_the_place_their_centre_lies_on() {
        let surface = plane();
        let atlas = Atlas::new(&surface, 64);
        let texel = atlas.texel(16, 48).expect("inside the island");
        // The plane spans 40 mm over uv 0.1 to 0.9, v downward.
        let expected = |t: f32| ((t + 0.5) / 64.0 - 0.5) * 50.0;
        assert!((texel.place - Vec3::new(expected(16.0), -expected(48.0), 0.0)).length() < 1e-3, "{texel:?}");
        assert!((texel.tangent - Vec3::X).length() < 1e-5 && (texel.bitangent - Vec3::Y).length() < 1e-5);
        assert!(atlas.texel(0, 0).is_none());
    }

    #[test]
    fn gaps_take_the_nearest_colour() {
        let mut texels = vec![None; 64];
        texels[0] = Some([2.0]);
        texels[63] = Some([4.0]);
        let filled = fill_gaps(8, &texels);
        assert_eq!((filled[9], filled[54], filled[0]), ([2.0], [4.0], [2.0]));
    }
}
