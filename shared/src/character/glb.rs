//! Reads the parts of a `.glb` that both ends check: the extension, the skin, weights, morph targets, image sizes.

use super::checked::{Character, CharacterError, ShapeDeltas};
use super::schema::{EXTENSION, Face};
use crate::limits::{MAX_CHARACTER_BYTES, MAX_JOINTS, MAX_TEXTURE_SIDE, MAX_VERTICES};
use crate::names::{ArkitShape, NUM_ARKIT_SHAPES};
use glam::Vec3;
use gltf::Semantic;
use gltf::mesh::Reader;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write;

type Result<T> = std::result::Result<T, CharacterError>;

/// How far a vertex's weights may be from summing to one: four u8 weights each rounded by half a code.
const WEIGHT_SUM_TOLERANCE: f32 = 2.5 / 255.0;

pub(super) fn load(bytes: &[u8]) -> Result<Character> {
    if bytes.len() > MAX_CHARACTER_BYTES {
        return Err(CharacterError::Glb(format!("{} bytes, at most {MAX_CHARACTER_BYTES} are allowed", bytes.len())));
    }
    if !bytes.starts_with(b"glTF") {
        return Err(CharacterError::Glb("it does not start with \"glTF\"".into()));
    }
    let gltf = gltf::Gltf::from_slice(bytes).map_err(|error| CharacterError::Glb(error.to_string()))?;
    let blob = gltf.blob.as_deref().ok_or_else(|| CharacterError::Glb("it has no binary chunk".into()))?;
    let document = &gltf.document;
    let extension = document.extension_value(EXTENSION).ok_or_else(|| {
        CharacterError::field(EXTENSION, "is missing: this .glb has no Rhytid description (see README, \"Bring your own head\")")
    })?;
    let face: Face = serde_json::from_value(extension.clone()).map_err(|error| CharacterError::field(EXTENSION, error.to_string()))?;

    let rest_of = check_skin(document, &face)?;
    let mut character = Character::from_schema(&face, rest_of[face.head.as_str()], hex(&Sha256::digest(bytes)))?;
    for (i, bone) in character.bones.iter().enumerate() {
        if !rest_of.contains_key(bone.joint.as_str()) {
            return Err(CharacterError::field(
                format!("RHYTID_face.bones[{i}].joint"),
                format!("{:?} is not a joint of the skin", bone.joint),
            ));
        }
    }
    check_images(document, blob, &character)?;
    check_meshes(document, blob, &mut character)?;
    Ok(character)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Joint names and their origins in the scene's frame.
fn check_skin(document: &gltf::Document, face: &Face) -> Result<BTreeMap<String, Vec3>> {
    let mut skins = document.skins();
    let skin = skins.next().ok_or_else(|| CharacterError::field("skins", "there is none, expected one skin with the face's joints"))?;
    if skins.next().is_some() {
        return Err(CharacterError::field("skins", "there are several, expected one"));
    }
    let num_joints = skin.joints().count();
    if num_joints == 0 || num_joints > MAX_JOINTS {
        return Err(CharacterError::field("skins[0].joints", format!("has {num_joints} joints, expected 1 to {MAX_JOINTS}")));
    }
    let mut world_of = vec![None; document.nodes().count()];
    for scene in document.scenes() {
        for node in scene.nodes() {
            place(&node, glam::Mat4::IDENTITY, &mut world_of, 0)?;
        }
    }
    let mut rest_of = BTreeMap::new();
    for joint in skin.joints() {
        let world: glam::Mat4 = world_of[joint.index()]
            .ok_or_else(|| CharacterError::field(format!("nodes[{}]", joint.index()), "is a joint but stands in no scene"))?;
        let name = joint
            .name()
            .ok_or_else(|| CharacterError::field(format!("nodes[{}].name", joint.index()), "is missing, expected joints to be named"))?;
        rest_of.insert(name.to_owned(), world.w_axis.truncate());
    }
    if !rest_of.contains_key(&face.head) {
        return Err(CharacterError::field("RHYTID_face.head", format!("{:?} is not a joint of the skin", face.head)));
    }
    Ok(rest_of)
}

fn place(node: &gltf::Node<'_>, parent: glam::Mat4, world_of: &mut [Option<glam::Mat4>], depth: usize) -> Result<()> {
    // Deeper than any rig, and a cycle ends here.
    const MAX_DEPTH: usize = 256;
    if depth > MAX_DEPTH {
        return Err(CharacterError::field("nodes", format!("are nested deeper than {MAX_DEPTH}")));
    }
    let world = parent * glam::Mat4::from_cols_array_2d(&node.transform().matrix());
    world_of[node.index()] = Some(world);
    node.children().try_for_each(|child| place(&child, world, world_of, depth + 1))
}

fn check_images(document: &gltf::Document, blob: &[u8], character: &Character) -> Result<()> {
    let mut size_of = Vec::new();
    for image in document.images() {
        let field = format!("images[{}]", image.index());
        let gltf::image::Source::View { view, .. } = image.source() else {
            return Err(CharacterError::field(field, "refers to another file, expected it inside the .glb"));
        };
        let bytes = blob
            .get(view.offset()..view.offset().saturating_add(view.length()))
            .ok_or_else(|| CharacterError::field(&field, "reaches past the end of the file"))?;
        let (width, height) = image::ImageReader::new(std::io::Cursor::new(bytes))
            .with_guessed_format()
            .map_err(image::ImageError::IoError)
            .and_then(|reader| reader.into_dimensions())
            .map_err(|error| CharacterError::field(&field, format!("is neither PNG nor JPEG: {error}")))?;
        if width == 0 || height == 0 || width > MAX_TEXTURE_SIDE || height > MAX_TEXTURE_SIDE {
            return Err(CharacterError::field(&field, format!("is {width} x {height}, expected sides of 1 to {MAX_TEXTURE_SIDE}")));
        }
        size_of.push((width, height));
    }
    let textures: Vec<_> = document.textures().collect();
    let mut first: Option<(u32, u32)> = None;
    for (k, map) in character.poses.iter().enumerate().filter_map(|(k, pose)| Some((k, pose.map?))) {
        let field = format!("RHYTID_face.poses[{k}].map.texture");
        let texture = textures
            .get(map.texture)
            .ok_or_else(|| CharacterError::field(&field, format!("is {}, but there are {} textures", map.texture, textures.len())))?;
        let (width, height) = size_of[texture.source().index()];
        if width != height || !width.is_power_of_two() {
            return Err(CharacterError::field(&field, format!("is {width} x {height}, expected a square with a power of two a side")));
        }
        let expected = *first.get_or_insert((width, height));
        if expected != (width, height) {
            return Err(CharacterError::field(
                &field,
                format!("is {width} x {height}, expected {} x {} as the first: wrinkle maps share one array", expected.0, expected.1),
            ));
        }
    }
    Ok(())
}

fn check_meshes(document: &gltf::Document, blob: &[u8], character: &mut Character) -> Result<()> {
    let num_joints = document.skins().next().map_or(0, |skin| skin.joints().count());
    let mut num_vertices = 0;
    let mut nearest = vec![f32::INFINITY; character.num_bones()];
    for mesh in document.meshes() {
        let targets = target_names(&mesh);
        for primitive in mesh.primitives() {
            let field = format!("meshes[{}].primitives[{}]", mesh.index(), primitive.index());
            let reader = primitive.reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob));
            for (semantic, accessor) in primitive.attributes() {
                check_accessor(&accessor, blob, &format!("{field}.attributes.{semantic:?}"))?;
            }
            if let Some(accessor) = primitive.indices() {
                check_accessor(&accessor, blob, &format!("{field}.indices"))?;
            }
            if primitive.get(&Semantic::Joints(1)).is_some() {
                return Err(CharacterError::field(
                    format!("{field}.attributes.JOINTS_1"),
                    "is present, expected at most 4 weights a vertex",
                ));
            }
            let positions: Vec<Vec3> = reader
                .read_positions()
                .ok_or_else(|| CharacterError::field(format!("{field}.attributes.POSITION"), "is missing"))?
                .map(Vec3::from)
                .collect();
            if let Some(v) = positions.iter().position(|p| !p.is_finite()) {
                return Err(CharacterError::field(format!("{field}.attributes.POSITION[{v}]"), "is not finite"));
            }
            num_vertices += positions.len();
            if num_vertices > MAX_VERTICES {
                return Err(CharacterError::field("meshes", format!("have more than {MAX_VERTICES} vertices")));
            }
            check_indices(&reader, positions.len(), &field)?;
            check_weights(&reader, positions.len(), num_joints, &field)?;
            sample_shapes(&primitive, &reader, blob, &targets, &positions, &mut nearest, character, &field)?;
        }
    }
    if num_vertices == 0 {
        return Err(CharacterError::field("meshes", "there is none"));
    }
    Ok(())
}

fn target_names(mesh: &gltf::Mesh<'_>) -> Vec<Option<ArkitShape>> {
    let Some(extras) = mesh.extras() else { return Vec::new() };
    let Ok(extras) = serde_json::from_str::<serde_json::Value>(extras.get()) else { return Vec::new() };
    let Some(names) = extras.get("targetNames").and_then(|names| names.as_array()) else { return Vec::new() };
    names.iter().map(|name| name.as_str().and_then(ArkitShape::from_name)).collect()
}

/// The gltf crate reads accessors without looking where they end; this looks first.
fn check_accessor(accessor: &gltf::Accessor<'_>, blob: &[u8], field: &str) -> Result<()> {
    let check = |view: &gltf::buffer::View<'_>, offset: usize, count: usize, size: usize| {
        let stride = view.stride().unwrap_or(size);
        let needed = count.checked_sub(1).map_or(Some(0), |last| last.checked_mul(stride).and_then(|n| n.checked_add(size)));
        let view_end = view.offset().checked_add(view.length());
        match (needed.and_then(|n| n.checked_add(offset)), view_end) {
            (Some(needed), Some(end)) if needed <= view.length() && end <= blob.len() && stride >= size => Ok(()),
            _ => Err(CharacterError::field(field, "reaches past the end of its buffer view or of the file")),
        }
    };
    if let Some(view) = accessor.view() {
        check(&view, accessor.offset(), accessor.count(), accessor.size())?;
    }
    if let Some(sparse) = accessor.sparse() {
        let (indices, values) = (sparse.indices(), sparse.values());
        check(&indices.view(), indices.offset(), sparse.count(), indices.index_type().size())?;
        check(&values.view(), values.offset(), sparse.count(), accessor.size())?;
    } else if accessor.view().is_none() && accessor.count() > MAX_VERTICES {
        return Err(CharacterError::field(field, format!("has {} elements, at most {MAX_VERTICES} are allowed", accessor.count())));
    }
    Ok(())
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

fn check_weights<'a, 's, F>(reader: &PrimitiveReader<'a, 's, F>, num_vertices: usize, num_joints: usize, field: &str) -> Result<()>
where
    F: Clone + Fn(gltf::Buffer<'a>) -> Option<&'s [u8]>,
{
    let (Some(joints), Some(weights)) = (reader.read_joints(0), reader.read_weights(0)) else {
        return Err(CharacterError::field(format!("{field}.attributes"), "lack JOINTS_0 or WEIGHTS_0, expected a skinned mesh"));
    };
    let (mut num_read, joints, weights) = (0, joints.into_u16(), weights.into_f32());
    for (v, (joints, weights)) in joints.zip(weights).enumerate() {
        num_read += 1;
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
    if num_read != num_vertices {
        return Err(CharacterError::field(
            format!("{field}.attributes"),
            format!("have {num_read} joints and weights for {num_vertices} vertices"),
        ));
    }
    Ok(())
}

/// Takes each shape's displacement at the mesh vertex nearest to each bone's point.
#[allow(clippy::too_many_arguments, reason = "one primitive's parts, each borrowed apart")]
fn sample_shapes<'a, 's, F>(
    primitive: &gltf::Primitive<'a>,
    reader: &PrimitiveReader<'a, 's, F>,
    blob: &[u8],
    targets: &[Option<ArkitShape>],
    positions: &[Vec3],
    nearest: &mut [f32],
    character: &mut Character,
    field: &str,
) -> Result<()>
where
    F: Clone + Fn(gltf::Buffer<'a>) -> Option<&'s [u8]>,
{
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
            check_accessor(&accessor, blob, &format!("{field}.targets[{t}]"))?;
            if accessor.count() != positions.len() {
                return Err(CharacterError::field(
                    format!("{field}.targets[{t}]"),
                    format!("has {} elements for {} vertices", accessor.count(), positions.len()),
                ));
            }
        }
    }
    // Which bones does this primitive come nearer to than those before it?
    let mut vertex_of: Vec<(usize, usize)> = Vec::new();
    for (i, bone) in character.bones.iter().enumerate() {
        let mut best = None;
        for (v, position) in positions.iter().enumerate() {
            let distance = position.distance_squared(bone.rest);
            if distance < nearest[i] {
                nearest[i] = distance;
                best = Some(v);
            }
        }
        vertex_of.extend(best.map(|v| (i, v)));
    }
    for (t, (displacements, _, _)) in reader.read_morph_targets().enumerate() {
        let Some(shape) = targets.get(t).copied().flatten() else { continue };
        let deltas: Vec<Vec3> = displacements.map(|all| all.map(Vec3::from).collect()).unwrap_or_default();
        let at = match character.shapes.iter().position(|known| known.shape == shape) {
            Some(at) => at,
            None => {
                let deltas = vec![Vec3::ZERO; character.bones.len()];
                character.shapes.push(ShapeDeltas { shape, target: t, deltas });
                character.shapes.len() - 1
            }
        };
        for &(bone, vertex) in &vertex_of {
            let delta = deltas.get(vertex).copied().unwrap_or_default();
            if !delta.is_finite() {
                return Err(CharacterError::field(format!("{field}.targets[{t}].POSITION[{vertex}]"), "is not finite"));
            }
            character.shapes[at].deltas[bone] = delta;
        }
    }
    Ok(())
}
