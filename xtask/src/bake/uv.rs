//! Packs the bust's UV islands into the unit square. In MakeHuman's body atlas the face fills a fifth and lies on its side.

use super::mesh::Mesh;
use anyhow::{Result, ensure};
use glam::Vec2;
use std::collections::BTreeMap;

/// Where the cut's closing surface is put before packing: far outside the atlas, so that it is told from the islands.
pub fn cap_uv(flat: Vec2) -> Vec2 {
    Vec2::new(5.0, 5.0) + flat * 0.5
}

/// What an island of the atlas shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Island {
    /// Face, scalp, ears, front and back of the neck.
    Head,
    /// Shoulders, chest and back.
    Torso,
    /// Inside of the mouth.
    Mouth,
    /// Behind the lids, left eye.
    SocketLeft,
    /// Behind the lids, right eye.
    SocketRight,
    /// The surface that closes the bust below.
    Cap,
}

impl Island {
    /// By the middle of an island in MakeHuman's atlas (origin bottom-left).
    fn at(middle: Vec2) -> Self {
        match middle {
            m if m.x > 2.0 => Self::Cap,
            m if m.x > 0.63 && m.y > 0.14 => Self::Head,
            m if m.x > 0.7 => Self::Mouth,
            m if m.x < 0.08 && m.y < 0.7 && m.y > 0.5 => Self::SocketRight,
            m if m.x < 0.16 && m.y < 0.7 && m.y > 0.5 => Self::SocketLeft,
            _ => Self::Torso,
        }
    }

    /// Its rectangle in the new atlas, glTF's UV (origin top-left): `(corner, size)`. The gaps between them are 8 texels
    /// and more at 1024.
    fn place(self) -> (Vec2, Vec2) {
        let rectangle = |x, y, w, h| (Vec2::new(x, y), Vec2::new(w, h));
        match self {
            Self::Head => rectangle(0.006, 0.006, 0.988, 0.800),
            Self::Torso => rectangle(0.006, 0.816, 0.420, 0.178),
            Self::Mouth => rectangle(0.436, 0.816, 0.230, 0.178),
            Self::SocketLeft => rectangle(0.676, 0.816, 0.120, 0.178),
            Self::SocketRight => rectangle(0.806, 0.816, 0.120, 0.178),
            Self::Cap => rectangle(0.936, 0.816, 0.058, 0.178),
        }
    }
}

/// How much the head island's middle is magnified: `atan(k x) / atan(k)` about a centre. Monotone in each direction, so
/// nothing can overlap that did not.
const WARP_X: f32 = 2.0;
const WARP_Y: f32 = 1.9;
/// Height in the head island round which it is magnified, 0 crown to 1 neck: between nose and eyes.
const WARP_CENTRE_Y: f32 = 0.66;

/// Moves every island to its place. Returns what island each UV belongs to.
pub fn pack(mesh: &mut Mesh) -> Result<Vec<Island>> {
    let root_of = islands(mesh);
    let mut bounds: BTreeMap<u32, (Vec2, Vec2)> = BTreeMap::new();
    for (t, &root) in root_of.iter().enumerate() {
        let uv = mesh.uvs[t];
        let entry = bounds.entry(root).or_insert((uv, uv));
        *entry = (entry.0.min(uv), entry.1.max(uv));
    }
    let mut island_of_root: BTreeMap<u32, Island> = BTreeMap::new();
    for (&root, &(low, high)) in &bounds {
        let island = Island::at((low + high) * 0.5);
        ensure!(!island_of_root.values().any(|&other| other == island), "two UV islands would lie on each other: {island:?}");
        island_of_root.insert(root, island);
    }
    ensure!(island_of_root.len() == 6, "expected 6 UV islands, got {:?}", island_of_root.values());
    let mut island_of = Vec::with_capacity(mesh.uvs.len());
    for (t, &root) in root_of.iter().enumerate() {
        let island = island_of_root[&root];
        let (low, high) = bounds[&root];
        let unit = (mesh.uvs[t] - low) / (high - low).max(Vec2::splat(1e-6));
        let turned = match island {
            // The atlas has the face on its side: its up is -u, its left (the character's) is +v.
            Island::Head => magnify(Vec2::new(unit.y, unit.x)),
            _ => Vec2::new(unit.x, 1.0 - unit.y),
        };
        let (corner, size) = island.place();
        mesh.uvs[t] = corner + turned * size;
        island_of.push(island);
    }
    Ok(island_of)
}

fn magnify(unit: Vec2) -> Vec2 {
    let warp = |x: f32, centre: f32, k: f32| {
        let at = |x: f32| libm::atanf(k * (x - centre) * 2.0);
        (at(x) - at(0.0)) / (at(1.0) - at(0.0))
    };
    Vec2::new(warp(unit.x, 0.5, WARP_X), warp(unit.y, WARP_CENTRE_Y, WARP_Y))
}

/// The smallest UV index of each UV's island.
fn islands(mesh: &Mesh) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..mesh.uvs.len() as u32).collect();
    fn root(parent: &mut [u32], mut t: u32) -> u32 {
        while parent[t as usize] != t {
            parent[t as usize] = parent[parent[t as usize] as usize];
            t = parent[t as usize];
        }
        t
    }
    for face in &mesh.faces {
        for &t in &face.uvs[1..] {
            let (a, b) = (root(&mut parent, face.uvs[0]), root(&mut parent, t));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    (0..mesh.uvs.len() as u32).map(|t| root(&mut parent, t)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn magnifying_keeps_the_border_and_the_order_and_triples_the_middle() {
        assert!(magnify(Vec2::ZERO).length() < 1e-6 && (magnify(Vec2::ONE) - Vec2::ONE).length() < 1e-6);
        let at: Vec<f32> = (0..=100).map(|i| magnify(Vec2::splat(i as f32 / 100.0)).x).collect();
        assert!(at.windows(2).all(|pair| pair[1] > pair[0]));
        assert!((at[51] - at[49]) / (at[2] - at[0]) > 3.0);
    }

    #[test]
    fn places_do_not_touch() {
        let all = [Island::Head, Island::Torso, Island::Mouth, Island::SocketLeft, Island::SocketRight, Island::Cap];
        for (i, a) in all.iter().enumerate() {
            for b in &all[i + 1..] {
                let ((ca, sa), (cb, sb)) = (a.place(), b.place());
                let gap = (cb - (ca + sa)).max(ca - (cb + sb));
                assert!(gap.max_element() > 8.0 / 1024.0, "{a:?} and {b:?}");
            }
        }
    }
}
