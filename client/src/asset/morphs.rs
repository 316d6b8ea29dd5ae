//! Morph targets as the vertex stage reads them: for each vertex only the shapes that move it.
//!
//! How a shape turns the surface is stored as the gradient of its displacement along the vertex's tangent and bitangent,
//! not as a difference of normals. With `t' = t + Σ w_s ∂d_s/∂t` and `b'` alike, `t' × b'` is the normal of the deformed
//! surface exactly, for any number of shapes at any weights and with the skinning on top; differences of normals are right
//! for one shape at weight 1 only, and tell nothing of the tangent.

use super::AssetError;
use super::gradients::Places;
use glam::{Mat3, Vec3};
use half::f16;
use rhytid_shared::ArkitShape;

/// Texels an entry takes: displacement and shape, then its gradients along tangent and bitangent.
pub const TEXELS_PER_ENTRY: usize = 3;
/// Entries side by side in a row of the texture; a row has 2,046 texels, and 2,048 is what WebGL2 guarantees.
pub const ENTRIES_PER_ROW: usize = 682;
/// Most entries of a character: as many rows as WebGL2 guarantees. The built-in character has less than a fifth of it, 6 MB.
pub const MAX_ENTRIES: usize = ENTRIES_PER_ROW * 2048;
/// A shape that moves a vertex by less than this, metres, and turns the surface there by less than [`LEAST_TURN`],
/// leaves the vertex as it is. A pixel of a face that fills a large screen covers a tenth of a millimetre.
const LEAST_TRAVEL: f32 = 1e-6;
/// Radians.
const LEAST_TURN: f32 = 1e-3;
/// Farthest a shape may move a vertex, metres: as far as a vertex may be from the origin.
const FARTHEST: f32 = 10.0;
/// Largest gradient that is kept: far beyond what skin does, within half precision.
const STEEPEST: f32 = 64.0;

/// The deltas of all parts of a character.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Morphs {
    /// [`TEXELS_PER_ENTRY`] texels an entry. First texel: displacement at weight 1, metres, model space, and the shape's
    /// number in [`rhytid_shared::ARKIT_NAMES`]. Second and third: how the displacement changes along the unit tangent and
    /// along `cross(normal, tangent)`; their fourth components are 0.
    pub texels: Vec<[f16; 4]>,
}

/// One shape at one vertex, as the vertex stage reads it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MorphEntry {
    /// Which shape.
    pub shape: usize,
    /// Displacement at weight 1, metres.
    pub displacement: Vec3,
    /// Change of the displacement along tangent and bitangent.
    pub gradients: [Vec3; 2],
}

/// What a mesh without its targets gives.
pub(super) struct MorphedMesh<'a> {
    /// For messages.
    pub(super) name: &'a str,
    /// Neutral.
    pub(super) positions: &'a [Vec3],
    /// Three a triangle.
    pub(super) indices: &'a [u32],
    /// Unit tangent and `cross(normal, tangent)` of each vertex.
    pub(super) frames: &'a [[Vec3; 2]],
}

impl Morphs {
    /// Number of entries.
    pub fn num_entries(&self) -> usize {
        self.texels.len() / TEXELS_PER_ENTRY
    }

    /// True where no shape moves anything.
    pub fn is_empty(&self) -> bool {
        self.texels.is_empty()
    }

    /// Columns and rows of the texture that holds all entries; one entry's worth where there is none.
    pub fn texture_size(&self) -> [u32; 2] {
        let num = self.num_entries().max(1);
        [(num.min(ENTRIES_PER_ROW) * TEXELS_PER_ENTRY) as u32, num.div_ceil(ENTRIES_PER_ROW) as u32]
    }

    /// The entries of a vertex with this [`super::Vertex::morphs`].
    pub fn of_vertex(&self, [first, count]: [u32; 2]) -> impl Iterator<Item = MorphEntry> {
        let texels = first as usize * TEXELS_PER_ENTRY..(first as usize + count as usize) * TEXELS_PER_ENTRY;
        self.texels.get(texels).unwrap_or_default().as_chunks::<TEXELS_PER_ENTRY>().0.iter().map(|entry| {
            let xyz = |texel: [f16; 4]| Vec3::new(texel[0].to_f32(), texel[1].to_f32(), texel[2].to_f32());
            MorphEntry { shape: entry[0][3].to_f32() as usize, displacement: xyz(entry[0]), gradients: [xyz(entry[1]), xyz(entry[2])] }
        })
    }

    /// Adds the entries of a mesh and returns `[first entry, number of entries]` of each of its vertices.
    ///
    /// `targets` have one displacement a vertex each and come ordered by shape; those of one shape add up. Vertices that no
    /// triangle uses get no entries: parts of a file may share one long list of them.
    pub(super) fn add(
        &mut self,
        mesh: &MorphedMesh<'_>,
        targets: impl Iterator<Item = (ArkitShape, Vec<Vec3>)>,
    ) -> Result<Vec<[u32; 2]>, AssetError> {
        let slopes = Slopes::new(mesh);
        let room = MAX_ENTRIES.saturating_sub(self.num_entries());
        let mut num_entries = 0;
        let mut entries_of: Vec<Vec<MorphEntry>> = vec![Vec::new(); mesh.positions.len()];
        let mut targets = targets.peekable();
        while let Some((shape, mut deltas)) = targets.next() {
            while let Some((_, more)) = targets.next_if(|(next, _)| *next == shape) {
                deltas.iter_mut().zip(more).for_each(|(sum, delta)| *sum += delta);
            }
            check(mesh, shape, &deltas)?;
            if deltas.iter().all(|delta| *delta == Vec3::ZERO) {
                continue;
            }
            let gradient_of = slopes.gradients(mesh.indices, &deltas);
            for vertex in (0..deltas.len()).filter(|vertex| slopes.is_used[*vertex]) {
                let (displacement, gradient) = (deltas[vertex], gradient_of[slopes.places.of[vertex]]);
                // Most shapes leave most of a face alone.
                if displacement == Vec3::ZERO && gradient == Mat3::ZERO {
                    continue;
                }
                let gradients = mesh.frames[vertex].map(|along| (gradient * along).clamp_length_max(STEEPEST));
                if displacement.length() >= LEAST_TRAVEL || gradients.iter().any(|gradient| gradient.length() >= LEAST_TURN) {
                    entries_of[vertex].push(MorphEntry { shape: shape.index(), displacement, gradients });
                    num_entries += 1;
                }
            }
            if num_entries > room {
                return Err(AssetError::TooManyDeltas { most: MAX_ENTRIES });
            }
        }
        let mut spans = Vec::with_capacity(entries_of.len());
        for entries in entries_of {
            spans.push([self.num_entries() as u32, entries.len() as u32]);
            self.texels.extend(entries.iter().flat_map(texels_of));
        }
        Ok(spans)
    }
}

fn check(mesh: &MorphedMesh<'_>, shape: ArkitShape, deltas: &[Vec3]) -> Result<(), AssetError> {
    let wrong = deltas.iter().position(|delta| !delta.is_finite() || delta.abs().max_element() > FARTHEST);
    match wrong {
        Some(vertex) => Err(AssetError::Delta { part: mesh.name.to_owned(), shape: shape.name(), vertex, got: deltas[vertex] }),
        None => Ok(()),
    }
}

fn texels_of(entry: &MorphEntry) -> [[f16; 4]; TEXELS_PER_ENTRY] {
    let texel = |v: Vec3, w: f32| [v.x, v.y, v.z, w].map(f16::from_f32);
    [texel(entry.displacement, entry.shape as f32), texel(entry.gradients[0], 0.0), texel(entry.gradients[1], 0.0)]
}

/// What gradients over a mesh need, whatever the values are.
struct Slopes {
    /// Vertices at one place share their triangles, so that normals do not part at texture seams.
    places: Places,
    is_used: Vec<bool>,
    /// For each triangle and corner: gradient of the function that is 1 at the corner and 0 at the others, times the
    /// triangle's area.
    hats: Vec<[Vec3; 3]>,
    /// One over the area of the triangles round each place, 0 where there is none.
    per_area: Vec<f32>,
}

impl Slopes {
    fn new(mesh: &MorphedMesh<'_>) -> Self {
        let places = Places::new(mesh.positions);
        let mut is_used = vec![false; mesh.positions.len()];
        let mut area = vec![0.0; places.num];
        let hats = mesh
            .indices
            .as_chunks::<3>()
            .0
            .iter()
            .map(|triangle| {
                let corners = triangle.map(|index| index as usize);
                let [a, b, c] = corners.map(|corner| mesh.positions[corner]);
                let area_vector = (b - a).cross(c - a);
                let doubled = area_vector.length();
                for corner in corners {
                    is_used[corner] = true;
                    area[places.of[corner]] += 0.5 * doubled;
                }
                // (n × e) / 2A times A, where e is the edge opposite the corner.
                let normal = area_vector / doubled.max(f32::MIN_POSITIVE);
                [c - b, a - c, b - a].map(|edge| normal.cross(edge) * 0.5)
            })
            .collect();
        let per_area = area.into_iter().map(|area: f32| if area > 0.0 { 1.0 / area } else { 0.0 }).collect();
        Self { places, is_used, hats, per_area }
    }

    /// For each place the mean over its triangles, by area, of the gradient `∂d/∂x` of the displacement.
    fn gradients(&self, indices: &[u32], deltas: &[Vec3]) -> Vec<Mat3> {
        let mut sums = vec![Mat3::ZERO; self.places.num];
        for (triangle, hats) in indices.as_chunks::<3>().0.iter().zip(&self.hats) {
            let moved = triangle.map(|index| deltas[index as usize]);
            if moved == [Vec3::ZERO; 3] {
                continue;
            }
            let outer = |d: Vec3, g: Vec3| Mat3::from_cols(d * g.x, d * g.y, d * g.z);
            let gradient = outer(moved[0], hats[0]) + outer(moved[1], hats[1]) + outer(moved[2], hats[2]);
            for index in triangle {
                sums[self.places.of[*index as usize]] += gradient;
            }
        }
        sums.iter().zip(&self.per_area).map(|(sum, per_area)| *sum * *per_area).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(name: &str) -> ArkitShape {
        ArkitShape::from_name(name).expect("an ARKit shape")
    }

    /// A square of two triangles in the plane z = 0.
    const SQUARE: [Vec3; 4] = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
    const INDICES: [u32; 6] = [0, 1, 2, 0, 2, 3];

    fn mesh<'a>(frames: &'a [[Vec3; 2]], indices: &'a [u32]) -> MorphedMesh<'a> {
        MorphedMesh { name: "skin", positions: &SQUARE, indices, frames }
    }

    #[test]
    fn linear_displacement_has_its_slope_at_every_vertex() {
        let mut morphs = Morphs::default();
        // d = (0, 0, x / 4 + y / 2).
        let deltas = SQUARE.map(|p| Vec3::Z * (0.25 * p.x + 0.5 * p.y)).to_vec();
        let spans = morphs.add(&mesh(&[[Vec3::X, Vec3::Y]; 4], &INDICES), [(shape("jawOpen"), deltas)].into_iter()).unwrap();
        for (vertex, span) in spans.into_iter().enumerate() {
            let entries: Vec<MorphEntry> = morphs.of_vertex(span).collect();
            assert_eq!(entries.len(), 1, "also where it stays in place and only turns");
            assert_eq!(entries[0].shape, shape("jawOpen").index());
            assert_eq!(entries[0].displacement, Vec3::Z * (0.25 * SQUARE[vertex].x + 0.5 * SQUARE[vertex].y));
            assert_eq!(entries[0].gradients, [Vec3::Z * 0.25, Vec3::Z * 0.5]);
        }
    }

    #[test]
    fn targets_of_one_shape_add_up_and_still_or_unused_vertices_cost_nothing() {
        let mut morphs = Morphs::default();
        let lifted = |x: f32| vec![Vec3::ZERO, Vec3::ZERO, Vec3::ZERO, Vec3::new(x, 0.0, 0.0)];
        let targets = [(shape("cheekPuff"), lifted(0.25)), (shape("cheekPuff"), lifted(0.5)), (shape("jawOpen"), vec![Vec3::ZERO; 4])];
        // Only the first triangle is drawn: vertex 3 is none of its.
        let spans = morphs.add(&mesh(&[[Vec3::X, Vec3::Y]; 4], &INDICES[..3]), targets.clone().into_iter()).unwrap();
        assert_eq!((morphs.num_entries(), spans), (0, vec![[0, 0]; 4]));
        let spans = morphs.add(&mesh(&[[Vec3::X, Vec3::Y]; 4], &INDICES), targets.into_iter()).unwrap();
        let entries: Vec<MorphEntry> = morphs.of_vertex(spans[3]).collect();
        assert_eq!((entries.len(), entries[0].displacement), (1, Vec3::X * 0.75));
        assert_eq!(spans[1][1], 0, "no triangle of it moves");
    }

    #[test]
    fn deltas_that_no_device_could_draw_are_refused_with_their_place() {
        for wrong in [f32::NAN, f32::INFINITY, 1e4] {
            let deltas = vec![Vec3::ZERO, Vec3::new(0.0, wrong, 0.0), Vec3::ZERO, Vec3::ZERO];
            let error = Morphs::default()
                .add(&mesh(&[[Vec3::X, Vec3::Y]; 4], &INDICES), [(shape("jawOpen"), deltas)].into_iter())
                .expect_err("no displacement");
            assert!(error.to_string().contains("jawOpen") && error.to_string().contains("vertex 1"), "{error}");
        }
    }

    #[test]
    fn built_in_character_takes_less_than_a_fifth_of_the_largest_texture() {
        let asset = crate::CharacterAsset::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).unwrap();
        let morphs = &asset.morphs;
        let most = asset.primitives.iter().flat_map(|p| &p.vertices).map(|vertex| vertex.morphs[1]).max();
        assert!(morphs.num_entries() > 100_000 && morphs.num_entries() < MAX_ENTRIES / 5, "{}", morphs.num_entries());
        assert!(most.is_some_and(|most| most as usize <= rhytid_shared::NUM_ARKIT_SHAPES));
    }

    #[test]
    fn texture_fits_what_webgl2_guarantees_up_to_the_last_entry_and_one_more_is_refused() {
        let full = Morphs { texels: vec![[f16::ZERO; 4]; MAX_ENTRIES * TEXELS_PER_ENTRY] };
        assert_eq!(full.texture_size(), [2046, 2048]);
        let mut morphs = full;
        let deltas = SQUARE.map(|p| Vec3::Z * p.x).to_vec();
        let result = morphs.add(&mesh(&[[Vec3::X, Vec3::Y]; 4], &INDICES), [(shape("jawOpen"), deltas)].into_iter());
        assert!(matches!(result, Err(AssetError::TooManyDeltas { .. })), "{result:?}");
        assert_eq!(Morphs::default().texture_size(), [3, 1]);
    }
}
