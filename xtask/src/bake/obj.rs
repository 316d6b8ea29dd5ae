//! Reads MakeHuman's Wavefront `.obj` and `.target` files.

use anyhow::{Context, Result, ensure};
use glam::{Vec2, Vec3};
use std::collections::BTreeMap;

/// Corners of one polygon: `(position index, UV index)`.
pub type Polygon = Vec<(u32, u32)>;

/// A parsed `.obj`; lengths in the file's own unit.
pub struct Obj {
    /// Vertices.
    pub positions: Vec<Vec3>,
    /// Texture coordinates, origin bottom-left.
    pub uvs: Vec<Vec2>,
    /// Polygons by group name.
    pub groups: BTreeMap<String, Vec<Polygon>>,
}

impl Obj {
    /// Parses `v`, `vt`, `g` and `f` lines.
    pub fn parse(text: &str) -> Result<Self> {
        let mut obj = Self { positions: Vec::new(), uvs: Vec::new(), groups: BTreeMap::new() };
        let mut group = String::new();
        for (number, line) in text.lines().enumerate() {
            let mut words = line.split_whitespace();
            let context = || format!("line {} of the .obj", number + 1);
            match words.next() {
                Some("v") => obj.positions.push(Vec3::from_array(numbers(words).with_context(context)?)),
                Some("vt") => obj.uvs.push(Vec2::from_array(numbers(words).with_context(context)?)),
                Some("g") => group = words.next().unwrap_or_default().to_owned(),
                Some("f") => {
                    let polygon = words.map(corner).collect::<Result<Polygon>>().with_context(context)?;
                    obj.groups.entry(group.clone()).or_default().push(polygon);
                }
                _ => {}
            }
        }
        let is_valid = |&(v, vt): &(u32, u32)| (v as usize) < obj.positions.len() && (vt as usize) < obj.uvs.len();
        ensure!(obj.groups.values().flatten().flatten().all(is_valid), "a face of the .obj names a vertex that is not there");
        Ok(obj)
    }

    /// Position indices the group uses, ascending.
    pub fn vertices_of(&self, group: &str) -> Vec<u32> {
        let mut vertices: Vec<u32> = self.groups.get(group).into_iter().flatten().flatten().map(|corner| corner.0).collect();
        vertices.sort_unstable();
        vertices.dedup();
        vertices
    }
}

/// Displacements of vertices, one line each: index and three numbers. Sorted by index in MakeHuman's files.
pub fn parse_target(text: &str) -> Result<Vec<(u32, Vec3)>> {
    let mut deltas = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with(['#', '"']) {
            continue;
        }
        let context = || format!("line {} of a .target", number + 1);
        let mut words = line.split_whitespace();
        let index: u32 = words.next().and_then(|word| word.parse().ok()).with_context(context)?;
        deltas.push((index, Vec3::from_array(numbers(words).with_context(context)?)));
    }
    Ok(deltas)
}

fn numbers<'a, const N: usize>(mut words: impl Iterator<Item = &'a str>) -> Result<[f32; N]> {
    let mut values = [0.0; N];
    for value in &mut values {
        *value = words.next().and_then(|word| word.parse().ok()).with_context(|| format!("expected {N} numbers"))?;
    }
    Ok(values)
}

fn corner(word: &str) -> Result<(u32, u32)> {
    let mut parts = word.split('/').map(|part| part.parse::<u32>().ok().and_then(|index| index.checked_sub(1)));
    let (Some(Some(v)), Some(Some(vt))) = (parts.next(), parts.next()) else {
        anyhow::bail!("expected vertex/uv, both from 1, got {word:?}")
    };
    Ok((v, vt))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn obj_indices_count_from_zero_and_groups_keep_their_faces() -> Result<()> {
        let obj = Obj::parse("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\ng a\nf 1/1 2/2 3/3\n")?;
        assert_eq!(obj.groups["a"], vec![vec![(0, 0), (1, 1), (2, 2)]]);
        assert_eq!(obj.vertices_of("a"), [0, 1, 2]);
        Ok(())
    }

    #[test]
    fn obj_with_a_face_beyond_its_vertices_is_refused() {
        assert!(Obj::parse("v 0 0 0\nvt 0 0\nf 1/1 1/1 2/1\n").is_err());
    }

    #[test]
    fn target_reads_numbers_without_leading_zero() -> Result<()> {
        assert_eq!(parse_target("# licence\n616 0 .001 -.5\n")?, [(616, Vec3::new(0.0, 0.001, -0.5))]);
        Ok(())
    }
}
