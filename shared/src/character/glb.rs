//! Reads the parts of a `.glb` that both ends check: the extension, the skin, weights, morph targets, image sizes.
//!
//! The file may come from a stranger. What the gltf crate takes for granted (it panics otherwise) is checked before it is asked,
//! and whatever may be named many times at no cost is bounded by what reading it costs.

mod accessors;
mod images;
mod nodes;

use super::checked::{Character, CharacterError, ShapeDeltas};
use super::schema::{EXTENSION, Face};
use crate::limits::{MAX_CHARACTER_BYTES, MAX_CHARACTER_JSON_BYTES, MAX_INDICES, MAX_VERTICES};
use crate::names::{ArkitShape, NUM_ARKIT_SHAPES};
use accessors::Layout;
use glam::Vec3;
use gltf::Semantic;
use gltf::mesh::Reader;
use sha2::{Digest, Sha256};
use std::fmt::Write;

type Result<T> = std::result::Result<T, CharacterError>;

/// How far a vertex's weights may be from summing to one: four u8 weights each rounded by half a code.
const WEIGHT_SUM_TOLERANCE: f32 = 2.5 / 255.0;

/// Farthest a vertex may be from the origin of head space, metres: more than any body, less than one in centimetres.
const FARTHEST_VERTEX: f32 = 10.0;

pub(super) fn load(bytes: &[u8]) -> Result<Character> {
    check_header(bytes)?;
    let (document, blob) = parse(bytes)?;
    let (document, blob) = (&document, blob.as_slice());
    let extension = document.extension_value(EXTENSION).ok_or_else(|| {
        // The two things a head from elsewhere mostly lacks, told at once.
        let skin = if document.skins().len() == 0 { " and no skin" } else { "" };
        CharacterError::field(
            EXTENSION,
            format!("is missing: this .glb has no Rhytid description{skin} (see README, \"Bring your own head\")"),
        )
    })?;
    let face: Face =
        serde_json::from_value(extension.clone()).map_err(|error| CharacterError::field(EXTENSION, one_line(&error.to_string())))?;

    let rest_of = nodes::check_skin(document, blob, &face)?;
    let mut character = Character::from_schema(&face, rest_of[face.head.as_str()], hex(&Sha256::digest(bytes)))?;
    for (i, bone) in character.bones.iter().enumerate() {
        let field = || format!("RHYTID_face.bones[{i}].joint");
        if !rest_of.contains_key(bone.joint.as_str()) {
            return Err(CharacterError::field(field(), format!("{:?} is not a joint of the skin", bone.joint)));
        }
        if character.bones[..i].iter().any(|other| other.joint == bone.joint) {
            return Err(CharacterError::field(
                field(),
                format!("{:?} is moved by another bone already, expected one bone a joint", bone.joint),
            ));
        }
    }
    images::check_images(document, blob, &character)?;
    check_meshes(document, blob, &mut character)?;
    Ok(character)
}

/// The file is as long as it says, and its JSON not longer than may be parsed.
fn check_header(bytes: &[u8]) -> Result<()> {
    if bytes.len() > MAX_CHARACTER_BYTES {
        return Err(CharacterError::Glb(format!("{} bytes, at most {MAX_CHARACTER_BYTES} are allowed", bytes.len())));
    }
    if !bytes.starts_with(b"glTF") {
        return Err(CharacterError::Glb("it does not start with \"glTF\"".into()));
    }
    // Magic, version, length of the file; length and kind of the JSON chunk.
    const HEADERS: usize = 20;
    let word = |at: usize| bytes.get(at..at + 4).and_then(|word| word.try_into().ok()).map(u32::from_le_bytes);
    let (Some(declared), Some(json_bytes)) = (word(8), word(12)) else {
        return Err(CharacterError::Glb(format!("it ends after {} bytes, within its header", bytes.len())));
    };
    if declared as usize > bytes.len() || bytes.len() < HEADERS {
        return Err(CharacterError::Glb(format!("it is cut off: {} of {declared} bytes are there", bytes.len())));
    }
    if (declared as usize) < HEADERS {
        return Err(CharacterError::Glb(format!("it says that it is {declared} bytes long, expected at least {HEADERS}")));
    }
    if json_bytes as usize > MAX_CHARACTER_JSON_BYTES {
        return Err(CharacterError::Glb(format!("{json_bytes} bytes of JSON, at most {MAX_CHARACTER_JSON_BYTES} are allowed")));
    }
    Ok(())
}

/// The file's two chunks, the JSON validated as far as the gltf crate does.
fn parse(bytes: &[u8]) -> Result<(gltf::Document, Vec<u8>)> {
    let refused = |error: gltf::Error| CharacterError::Glb(one_line(&error.to_string()));
    let gltf = gltf::Gltf::from_slice_without_validation(bytes).map_err(refused)?;
    let blob = gltf.blob.ok_or_else(|| CharacterError::Glb("it has no binary chunk".into()))?;
    let json = gltf.document.into_json();
    // The crate's validation looks at the accessor of the positions before it looks whether there is one.
    for (m, mesh) in json.meshes.iter().enumerate() {
        for (p, primitive) in mesh.primitives.iter().enumerate() {
            let positions = primitive.attributes.get(&gltf::json::validation::Checked::Valid(Semantic::Positions));
            if let Some(index) = positions.filter(|index| index.value() >= json.accessors.len()) {
                return Err(CharacterError::field(
                    format!("meshes[{m}].primitives[{p}].attributes.POSITION"),
                    format!("is {}, but there are {} accessors", index.value(), json.accessors.len()),
                ));
            }
        }
    }
    Ok((gltf::Document::from_json(json).map_err(refused)?, blob))
}

/// Another's message, made fit for one line.
fn one_line(message: &str) -> String {
    const MOST: usize = 300;
    message.split_whitespace().flat_map(|word| [" ", word]).collect::<String>().trim_start().chars().take(MOST).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn check_meshes(document: &gltf::Document, blob: &[u8], character: &mut Character) -> Result<()> {
    let num_joints = document.skins().next().map_or(0, |skin| skin.joints().count());
    let (mut num_vertices, mut num_indices) = (0, 0);
    let mut samples = Samples::new(character);
    for mesh in document.meshes() {
        let targets = target_names(&mesh);
        for primitive in mesh.primitives() {
            let field = format!("meshes[{}].primitives[{}]", mesh.index(), primitive.index());
            if primitive.mode() != gltf::mesh::Mode::Triangles {
                return Err(CharacterError::field(format!("{field}.mode"), format!("is {:?}, expected Triangles", primitive.mode())));
            }
            num_indices += check_accessors(&primitive, blob, &field)?;
            if num_indices > MAX_INDICES {
                return Err(CharacterError::field("meshes", format!("have more than {MAX_INDICES} vertex indices")));
            }
            let reader = primitive.reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob));
            let positions: Vec<Vec3> = reader
                .read_positions()
                .ok_or_else(|| CharacterError::field(format!("{field}.attributes.POSITION"), "is missing"))?
                .map(Vec3::from)
                .collect();
            if let Some(v) = positions.iter().position(|p| !p.is_finite() || p.abs().max_element() > FARTHEST_VERTEX) {
                return Err(CharacterError::field(
                    format!("{field}.attributes.POSITION[{v}]"),
                    format!("is {}, expected finite metres within ±{FARTHEST_VERTEX}", positions[v]),
                ));
            }
            num_vertices += positions.len();
            if num_vertices > MAX_VERTICES {
                return Err(CharacterError::field("meshes", format!("have more than {MAX_VERTICES} vertices")));
            }
            check_indices(&reader, positions.len(), &field)?;
            check_weights(&reader, num_joints, &field)?;
            sample_shapes(&reader, &targets, &positions, &mut samples, character, &field)?;
        }
    }
    if num_vertices == 0 {
        return Err(CharacterError::field("meshes", "there is none"));
    }
    Ok(())
}

/// Checks every accessor of a primitive that is ever read; returns the number of its indices.
fn check_accessors(primitive: &gltf::Primitive<'_>, blob: &[u8], field: &str) -> Result<usize> {
    let num_vertices = primitive.get(&Semantic::Positions).map_or(0, |accessor| accessor.count());
    let check_count = |accessor: &gltf::Accessor<'_>, field: &str| {
        if accessor.count() == num_vertices {
            return Ok(());
        }
        Err(CharacterError::field(field, format!("has {} elements for {num_vertices} vertices", accessor.count())))
    };
    for (semantic, accessor) in primitive.attributes() {
        let field = format!("{field}.attributes.{}", semantic.to_string());
        if matches!(semantic, Semantic::Joints(set) | Semantic::Weights(set) if set > 0) {
            return Err(CharacterError::field(field, "is present, expected at most 4 weights a vertex"));
        }
        if let Some(layout) = Layout::of(&semantic) {
            accessors::check(&accessor, layout, MAX_VERTICES, blob, &field)?;
            check_count(&accessor, &field)?;
        }
    }
    // Not only ARKit's: a character may carry its own targets besides; more than this is a mistake.
    const MAX_TARGETS: usize = 4 * NUM_ARKIT_SHAPES;
    let num_targets = primitive.morph_targets().count();
    if num_targets > MAX_TARGETS {
        return Err(CharacterError::field(
            format!("{field}.targets"),
            format!("has {num_targets} targets, at most {MAX_TARGETS} are allowed"),
        ));
    }
    for (t, target) in primitive.morph_targets().enumerate() {
        for accessor in [target.positions(), target.normals(), target.tangents()].into_iter().flatten() {
            let field = format!("{field}.targets[{t}]");
            accessors::check(&accessor, Layout::VECTOR, MAX_VERTICES, blob, &field)?;
            check_count(&accessor, &field)?;
        }
    }
    match primitive.indices() {
        Some(accessor) => {
            accessors::check(&accessor, Layout::INDEX, MAX_INDICES, blob, &format!("{field}.indices"))?;
            Ok(accessor.count())
        }
        None => Ok(num_vertices),
    }
}

fn target_names(mesh: &gltf::Mesh<'_>) -> Vec<Option<ArkitShape>> {
    let Some(extras) = mesh.extras() else { return Vec::new() };
    let Ok(extras) = serde_json::from_str::<serde_json::Value>(extras.get()) else { return Vec::new() };
    let Some(names) = extras.get("targetNames").and_then(|names| names.as_array()) else { return Vec::new() };
    names.iter().map(|name| name.as_str().and_then(ArkitShape::of_target)).collect()
}

type PrimitiveReader<'a, 's, F> = Reader<'a, 's, F>;

fn check_indices<'a, 's, F>(reader: &PrimitiveReader<'a, 's, F>, num_vertices: usize, field: &str) -> Result<()>
where
    F: Clone + Fn(gltf::Buffer<'a>) -> Option<&'s [u8]>,
{
    let Some(indices) = reader.read_indices() else { return Ok(()) };
    for (at, index) in indices.into_u32().enumerate() {
        if index as usize >= num_vertices {
            return Err(CharacterError::field(
                format!("{field}.indices[{at}]"),
                format!("is {index}, but there are {num_vertices} vertices"),
            ));
        }
    }
    Ok(())
}

fn check_weights<'a, 's, F>(reader: &PrimitiveReader<'a, 's, F>, num_joints: usize, field: &str) -> Result<()>
where
    F: Clone + Fn(gltf::Buffer<'a>) -> Option<&'s [u8]>,
{
    let (Some(joints), Some(weights)) = (reader.read_joints(0), reader.read_weights(0)) else {
        return Err(CharacterError::field(format!("{field}.attributes"), "lack JOINTS_0 or WEIGHTS_0, expected a skinned mesh"));
    };
    for (v, (joints, weights)) in joints.into_u16().zip(weights.into_f32()).enumerate() {
        for (joint, weight) in joints.into_iter().zip(weights) {
            if usize::from(joint) >= num_joints {
                return Err(CharacterError::field(
                    format!("{field}.attributes.JOINTS_0[{v}]"),
                    format!("is {joint}, but there are {num_joints} joints"),
                ));
            }
            if !(0.0..=1.0 + WEIGHT_SUM_TOLERANCE).contains(&weight) {
                return Err(CharacterError::field(format!("{field}.attributes.WEIGHTS_0[{v}]"), format!("is {weight}, expected 0 to 1")));
            }
        }
        let sum: f32 = weights.iter().sum();
        if (sum - 1.0).abs() > WEIGHT_SUM_TOLERANCE {
            return Err(CharacterError::field(format!("{field}.attributes.WEIGHTS_0[{v}]"), format!("sum to {sum}, expected 1")));
        }
    }
    Ok(())
}

/// Where shapes are sampled: each bone's point, then each landmark; and how near the nearest vertex so far is to it, squared.
struct Samples {
    places: Vec<Vec3>,
    nearest: Vec<f32>,
}

impl Samples {
    fn new(character: &Character) -> Self {
        let places: Vec<Vec3> = character.bones.iter().map(|bone| bone.rest).chain(character.ibug68.iter().copied()).collect();
        Self { nearest: vec![f32::INFINITY; places.len()], places }
    }

    /// The places that these vertices come nearer to than those before them, each with the nearest.
    fn take_nearer(&mut self, positions: &[Vec3]) -> Vec<(usize, usize)> {
        let mut taken = Vec::new();
        for (i, (place, nearest)) in self.places.iter().zip(&mut self.nearest).enumerate() {
            let mut best = None;
            for (v, position) in positions.iter().enumerate() {
                let distance = position.distance_squared(*place);
                if distance < *nearest {
                    *nearest = distance;
                    best = Some(v);
                }
            }
            taken.extend(best.map(|v| (i, v)));
        }
        taken
    }
}

/// Takes each shape's displacement at the mesh vertex nearest to each bone's point and each landmark; targets of one shape
/// add up.
fn sample_shapes<'a, 's, F>(
    reader: &PrimitiveReader<'a, 's, F>,
    targets: &[Option<ArkitShape>],
    positions: &[Vec3],
    samples: &mut Samples,
    character: &mut Character,
    field: &str,
) -> Result<()>
where
    F: Clone + Fn(gltf::Buffer<'a>) -> Option<&'s [u8]>,
{
    let num_bones = character.bones.len();
    let vertex_of = samples.take_nearer(positions);
    let mut seen = [false; NUM_ARKIT_SHAPES];
    for (t, (displacements, _, _)) in reader.read_morph_targets().enumerate() {
        let Some(shape) = targets.get(t).copied().flatten() else { continue };
        let deltas: Vec<Vec3> = displacements.map(|all| all.map(Vec3::from).collect()).unwrap_or_default();
        let at = match character.shapes.iter().position(|known| known.shape == shape) {
            Some(at) => at,
            None => {
                let none = |num| vec![Vec3::ZERO; num];
                character.shapes.push(ShapeDeltas { shape, target: t, deltas: none(num_bones), landmarks: none(character.ibug68.len()) });
                character.shapes.len() - 1
            }
        };
        let is_first = !std::mem::replace(&mut seen[shape.index()], true);
        for &(place, vertex) in &vertex_of {
            let delta = deltas.get(vertex).copied().unwrap_or_default();
            if !delta.is_finite() {
                return Err(CharacterError::field(format!("{field}.targets[{t}].POSITION[{vertex}]"), "is not finite"));
            }
            let shape = &mut character.shapes[at];
            let sampled = if place < num_bones { &mut shape.deltas[place] } else { &mut shape.landmarks[place - num_bones] };
            *sampled = if is_first { delta } else { *sampled + delta };
        }
    }
    Ok(())
}
