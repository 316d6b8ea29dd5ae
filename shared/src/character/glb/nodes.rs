//! Where the nodes stand, and that the mesh is modelled where its joints hold it.

use super::super::checked::CharacterError;
use super::super::schema::Face;
use super::{Result, accessors, accessors::Layout};
use crate::limits::MAX_JOINTS;
use glam::{Mat4, Vec3};
use std::collections::BTreeMap;

/// How far the skin may move the mesh at rest, metres: a tenth of a millimetre is not seen.
const REST_OFFSET_TOLERANCE: f32 = 1e-4;
/// How far the skin may turn or scale the mesh at rest: over a head it stays below the offset's tolerance three times over.
const REST_TURN_TOLERANCE: f32 = 1e-3;

/// Joint names and their origins in the scene's frame.
pub(super) fn check_skin(document: &gltf::Document, blob: &[u8], face: &Face) -> Result<BTreeMap<String, Vec3>> {
    let mut skins = document.skins();
    let skin = skins.next().ok_or_else(|| CharacterError::field("skins", "there is none, expected one skin with the face's joints"))?;
    if skins.next().is_some() {
        return Err(CharacterError::field("skins", "there are several, expected one"));
    }
    let num_joints = skin.joints().count();
    if num_joints == 0 || num_joints > MAX_JOINTS {
        return Err(CharacterError::field("skins[0].joints", format!("has {num_joints} joints, expected 1 to {MAX_JOINTS}")));
    }
    let world_from_node = place_all(document)?;
    check_mesh_nodes(document, &world_from_node)?;

    let mut rest_of = BTreeMap::new();
    let node_from_rest = inverse_bind_matrices(&skin, num_joints, blob)?;
    for (j, joint) in skin.joints().enumerate() {
        let field = shown(&joint);
        let world_from_joint =
            world_from_node[joint.index()].ok_or_else(|| CharacterError::field(&field, "is a joint but stands in no scene"))?;
        check_rest(world_from_joint * node_from_rest.get(j).copied().unwrap_or(Mat4::IDENTITY), &field)?;
        let name = joint.name().ok_or_else(|| CharacterError::field(&field, "has no name, expected joints to be named"))?;
        if rest_of.insert(name.to_owned(), world_from_joint.w_axis.truncate()).is_some() {
            return Err(CharacterError::field(field, "has the name of another joint, expected unique names"));
        }
    }
    if !rest_of.contains_key(&face.head) {
        return Err(CharacterError::field("RHYTID_face.head", format!("{:?} is not a joint of the skin", face.head)));
    }
    Ok(rest_of)
}

/// A node for people: index and name.
fn shown(node: &gltf::Node<'_>) -> String {
    match node.name() {
        Some(name) => format!("nodes[{}] ({:?})", node.index(), name.chars().take(64).collect::<String>()),
        None => format!("nodes[{}]", node.index()),
    }
}

/// Where each node stands in the scene's frame; none for nodes in no scene.
fn place_all(document: &gltf::Document) -> Result<Vec<Option<Mat4>>> {
    let mut parent_of = vec![None; document.nodes().count()];
    for node in document.nodes() {
        for child in node.children() {
            // Two parents would mean one walk a path, and the number of paths may double with each level.
            if let Some(other) = parent_of[child.index()].replace(node.index()) {
                return Err(placed_twice(&child, &format!("a child of nodes[{other}] and of nodes[{}]", node.index())));
            }
        }
    }
    let mut world_from_node = vec![None; parent_of.len()];
    for scene in document.scenes() {
        for root in scene.nodes() {
            if let Some(parent) = parent_of[root.index()] {
                return Err(placed_twice(&root, &format!("at the root of a scene and a child of nodes[{parent}]")));
            }
            // Several scenes may show the same root.
            if world_from_node[root.index()].is_none() {
                place(&root, Mat4::IDENTITY, &mut world_from_node, 0)?;
            }
        }
    }
    Ok(world_from_node)
}

fn placed_twice(node: &gltf::Node<'_>, places: &str) -> CharacterError {
    CharacterError::field(shown(node), format!("is placed twice: {places}"))
}

fn place(node: &gltf::Node<'_>, world_from_parent: Mat4, world_from_node: &mut [Option<Mat4>], depth: usize) -> Result<()> {
    // Deeper than any rig; the walk is a recursion.
    const MAX_DEPTH: usize = 256;
    if depth > MAX_DEPTH {
        return Err(CharacterError::field("nodes", format!("are nested deeper than {MAX_DEPTH}")));
    }
    let world = world_from_parent * Mat4::from_cols_array_2d(&node.transform().matrix());
    world_from_node[node.index()] = Some(world);
    node.children().try_for_each(|child| place(&child, world, world_from_node, depth + 1))
}

/// Every mesh hangs on the skin. Where it does, glTF has a viewer ignore the transform of the mesh's own node.
fn check_mesh_nodes(document: &gltf::Document, world_from_node: &[Option<Mat4>]) -> Result<()> {
    let mut is_shown = vec![false; document.meshes().count()];
    for node in document.nodes().filter(|node| world_from_node[node.index()].is_some()) {
        let Some(mesh) = node.mesh() else { continue };
        if node.skin().is_none() {
            return Err(CharacterError::field(shown(&node), "has a mesh but no skin, expected every mesh to move with the skin's joints"));
        }
        is_shown[mesh.index()] = true;
    }
    match is_shown.iter().position(|is_shown| !is_shown) {
        Some(mesh) => Err(CharacterError::field(format!("meshes[{mesh}]"), "stands in no scene, expected a node that shows it")),
        None => Ok(()),
    }
}

/// One a joint; empty where the file has none, which stands for identities.
fn inverse_bind_matrices(skin: &gltf::Skin<'_>, num_joints: usize, blob: &[u8]) -> Result<Vec<Mat4>> {
    let field = "skins[0].inverseBindMatrices";
    let Some(accessor) = skin.inverse_bind_matrices() else { return Ok(Vec::new()) };
    accessors::check(&accessor, Layout::MATRIX, MAX_JOINTS, blob, field)?;
    let matrices: Vec<Mat4> = skin
        .reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob))
        .read_inverse_bind_matrices()
        .map(|all| all.map(|matrix| Mat4::from_cols_array_2d(&matrix)).collect())
        .unwrap_or_default();
    if matrices.len() < num_joints {
        return Err(CharacterError::field(field, format!("has {} matrices for {num_joints} joints", matrices.len())));
    }
    Ok(matrices)
}

/// The joint leaves the mesh where it is modelled: poses are displacements from there.
fn check_rest(world_from_rest: Mat4, field: &str) -> Result<()> {
    let offset = world_from_rest.w_axis.truncate();
    let turn = [0, 1, 2].map(|axis| (world_from_rest.col(axis) - Mat4::IDENTITY.col(axis)).abs().max_element());
    // Written so that what is no number fails.
    let is_near = offset.length() <= REST_OFFSET_TOLERANCE && turn.iter().all(|&turn| turn <= REST_TURN_TOLERANCE);
    if is_near {
        return Ok(());
    }
    Err(CharacterError::field(
        field,
        format!(
            "moves the mesh at rest by {:.1} mm and turns or scales it by {:.3} (joint times inverse bind matrix), expected not at all: \
             apply the pose and the scale of the rig before exporting",
            offset.length() * 1e3,
            turn.into_iter().fold(0.0, f32::max)
        ),
    ))
}
