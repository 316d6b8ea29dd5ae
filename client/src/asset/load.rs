//! Decodes a checked `.glb`.

use super::blood;
use super::gradients::weight_gradients;
use super::joints::{JointMotion, Palette};
use super::mips::{MipChain, Texels};
use super::morphs::{MorphedMesh, Morphs};
use super::{Alpha, AssetError, BloodMaps, CharacterAsset, MaterialAsset, PrimitiveAsset, Surface, Vertex, WrinkleMaps, ZoneMaps};
use glam::{Vec2, Vec3};
use image::RgbaImage;
use rhytid_shared::{ArkitShape, Character, CharacterError};
use std::collections::BTreeMap;
use std::sync::Arc;

type Result<T> = std::result::Result<T, AssetError>;

/// Code of slope 0 in a map of partial derivatives.
const FLAT_CODE: u8 = 128;

/// Decodes all of a character, or with `Maps::Blank` all but its pictures.
pub(super) fn load(bytes: &[u8], maps: Maps) -> Result<CharacterAsset> {
    // Everything that could make the reading below panic or grow without limit has been refused once this returns.
    let character = Character::from_glb(bytes)?;
    let gltf = gltf::Gltf::from_slice(bytes).map_err(|error| CharacterError::Glb(error.to_string()))?;
    let blob = gltf.blob.as_deref().unwrap_or_default();
    let (palette, entry_of_joint) = build_palette(&gltf.document, &character);
    let mut images = Images { document: &gltf.document, blob, maps, last: None };

    let mut primitives = Vec::new();
    let mut morphs = Morphs::default();
    for mesh in gltf.document.meshes() {
        let targets = shape_of_target(&mesh);
        for primitive in mesh.primitives() {
            let (mut vertices, indices) = read_triangles(&primitive, blob, &entry_of_joint);
            let material = primitive.material();
            let name = material.name().unwrap_or_default().to_owned();
            read_morphs(&primitive, blob, &targets, &name, &mut vertices, &indices, &mut morphs)?;
            primitives.push(PrimitiveAsset {
                surface: Surface::from_material_name(&name),
                name,
                vertices,
                indices,
                material: read_material(&material, &mut images)?,
            });
        }
    }
    let read = read_maps(&character, &mut images)?;
    Ok(CharacterAsset { character: Arc::new(character), primitives, palette, morphs, wrinkles: read.0, zones: read.1, blood: read.2 })
}

/// Reads the pictures that `load` has left blank from the same file.
pub(super) fn fill(asset: &mut CharacterAsset, bytes: &[u8]) -> Result<()> {
    let gltf = gltf::Gltf::from_slice(bytes).map_err(|error| CharacterError::Glb(error.to_string()))?;
    let blob = gltf.blob.as_deref().unwrap_or_default();
    let mut images = Images { document: &gltf.document, blob, maps: Maps::Decoded, last: None };
    let materials = gltf.document.meshes().flat_map(|mesh| mesh.primitives().map(|primitive| primitive.material()).collect::<Vec<_>>());
    for (primitive, material) in asset.primitives.iter_mut().zip(materials) {
        primitive.material = read_material(&material, &mut images)?;
    }
    (asset.wrinkles, asset.zones, asset.blood) = read_maps(&asset.character, &mut images)?;
    Ok(())
}

/// Maps that belong to the character rather than to one of its materials.
fn read_maps(character: &Character, images: &mut Images<'_>) -> Result<(Option<WrinkleMaps>, Option<ZoneMaps>, Option<BloodMaps>)> {
    let wrinkles = read_wrinkles(character, images)?;
    let zones = read_zones(character, images)?;
    let blood = blood::read(character, |texture| images.of_texture(texture).map(|image| image.cloned()))?;
    Ok((wrinkles, zones, blood))
}

/// Names from a joint up to the root.
struct Skeleton<'a> {
    parent_of: BTreeMap<usize, usize>,
    name_of: BTreeMap<usize, &'a str>,
}

impl<'a> Skeleton<'a> {
    fn new(document: &'a gltf::Document) -> Self {
        let parent_of = document.nodes().flat_map(|node| node.children().map(move |child| (child.index(), node.index()))).collect();
        let name_of = document.nodes().filter_map(|node| Some((node.index(), node.name()?))).collect();
        Self { parent_of, name_of }
    }

    fn ancestry(&self, joint: usize) -> impl Iterator<Item = &'a str> {
        std::iter::successors(Some(joint), |node| self.parent_of.get(node).copied()).filter_map(|node| self.name_of.get(&node).copied())
    }

    fn is_below_head(&self, joint: usize, character: &Character) -> bool {
        self.ancestry(joint).any(|name| name == character.head_joint)
    }

    /// A joint that is no bone moves with the nearest bone above it, else with the head if it lies below it.
    fn motion_of(&self, joint: usize, character: &Character) -> JointMotion {
        let follows_head = self.is_below_head(joint, character);
        let bone = self
            .ancestry(joint)
            .take_while(|name| *name != character.head_joint)
            .find_map(|name| character.bones.iter().position(|bone| bone.joint == name));
        match bone {
            Some(bone) => JointMotion::Bone { bone, follows_head },
            None if follows_head => JointMotion::Head,
            None => JointMotion::Still,
        }
    }
}

/// The palette, and for each joint of the skin its entry.
fn build_palette(document: &gltf::Document, character: &Character) -> (Palette, Vec<u16>) {
    let skeleton = Skeleton::new(document);
    let joints: Vec<gltf::Node<'_>> = document.skins().next().map(|skin| skin.joints().collect()).unwrap_or_default();
    let mut motions: Vec<JointMotion> = character
        .bones
        .iter()
        .enumerate()
        .map(|(bone, description)| {
            let joint = joints.iter().find(|joint| joint.name() == Some(&description.joint));
            JointMotion::Bone { bone, follows_head: joint.is_none_or(|joint| skeleton.is_below_head(joint.index(), character)) }
        })
        .collect();
    let mut entry_of_joint = Vec::with_capacity(joints.len());
    for joint in &joints {
        let bone = character.bones.iter().position(|bone| Some(bone.joint.as_str()) == joint.name());
        let entry = bone.unwrap_or_else(|| {
            motions.push(skeleton.motion_of(joint.index(), character));
            motions.len() - 1
        });
        entry_of_joint.push(entry as u16);
    }
    (Palette { motions }, entry_of_joint)
}

fn read_triangles(primitive: &gltf::Primitive<'_>, blob: &[u8], entry_of_joint: &[u16]) -> (Vec<Vertex>, Vec<u32>) {
    let reader = primitive.reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob));
    let positions: Vec<Vec3> = reader.read_positions().map(|all| all.map(Vec3::from).collect()).unwrap_or_default();
    let mut indices: Vec<u32> = match reader.read_indices() {
        Some(indices) => indices.into_u32().collect(),
        None => (0..positions.len() as u32).collect(),
    };
    indices.truncate(indices.len() / 3 * 3);
    let normals: Vec<Vec3> = match reader.read_normals() {
        Some(normals) if normals.len() == positions.len() => normals.map(|normal| Vec3::from(normal).normalize_or(Vec3::Z)).collect(),
        _ => vertex_normals(&positions, &indices),
    };
    let uvs: Vec<Vec2> = match reader.read_tex_coords(0).map(|uvs| uvs.into_f32()) {
        Some(uvs) if uvs.len() == positions.len() => uvs.map(Vec2::from).collect(),
        _ => vec![Vec2::ZERO; positions.len()],
    };
    let tangents: Vec<[f32; 4]> = match reader.read_tangents() {
        Some(tangents) if tangents.len() == positions.len() => tangents.collect(),
        _ => vertex_tangents(&positions, &normals, &uvs, &indices),
    };
    let joints: Vec<[u16; 4]> = reader
        .read_joints(0)
        .map(|all| all.into_u16().map(|joints| joints.map(|joint| entry_of_joint.get(usize::from(joint)).copied().unwrap_or(0))).collect())
        .unwrap_or_default();
    let weights: Vec<[f32; 4]> = reader.read_weights(0).map(|all| all.into_f32().collect()).unwrap_or_default();
    let skinned = weight_gradients(&positions, &indices, &joints, &weights);

    let vertices = (0..positions.len())
        .map(|v| {
            let normal = normals[v];
            let [x, y, z, sign] = tangents[v];
            let tangent = orthogonal_tangent(Vec3::new(x, y, z), normal);
            let bitangent = normal.cross(tangent);
            Vertex {
                position: positions[v].to_array(),
                normal: normal.to_array(),
                tangent: [tangent.x, tangent.y, tangent.z, if sign < 0.0 { -1.0 } else { 1.0 }],
                uv: uvs[v].to_array(),
                // The palette's capacity is below 256.
                joints: skinned[v].joints.map(|joint| joint as u8),
                weights: skinned[v].weights,
                gradients: [1, 2, 3].map(|slot| [skinned[v].gradients[slot].dot(tangent), skinned[v].gradients[slot].dot(bitangent)]),
                morphs: [0; 2],
            }
        })
        .collect();
    (vertices, indices)
}

/// Reads the targets of a part that stand for expression shapes, and tells each vertex which entries are its own.
fn read_morphs(
    primitive: &gltf::Primitive<'_>,
    blob: &[u8],
    targets: &[Option<ArkitShape>],
    name: &str,
    vertices: &mut [Vertex],
    indices: &[u32],
    morphs: &mut Morphs,
) -> Result<()> {
    let reader = primitive.reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob));
    let positions: Vec<Vec3> = vertices.iter().map(|vertex| Vec3::from(vertex.position)).collect();
    let frames: Vec<[Vec3; 2]> = vertices
        .iter()
        .map(|vertex| {
            let [x, y, z, _] = vertex.tangent;
            let tangent = Vec3::new(x, y, z);
            [tangent, Vec3::from(vertex.normal).cross(tangent)]
        })
        .collect();
    let mut by_shape: Vec<(ArkitShape, usize)> = targets.iter().enumerate().filter_map(|(t, shape)| Some(((*shape)?, t))).collect();
    by_shape.sort_unstable();
    let displacements = by_shape.into_iter().filter_map(|(shape, target)| {
        let (displacements, _, _) = reader.read_morph_targets().nth(target)?;
        let deltas: Vec<Vec3> = displacements?.map(Vec3::from).collect();
        Some((shape, deltas)).filter(|(_, deltas)| deltas.len() == positions.len())
    });
    let spans = morphs.add(&MorphedMesh { name, positions: &positions, indices, frames: &frames }, displacements)?;
    for (vertex, span) in vertices.iter_mut().zip(spans) {
        vertex.morphs = span;
    }
    Ok(())
}

/// The expression shape that each target of a mesh stands for, by its name.
fn shape_of_target(mesh: &gltf::Mesh<'_>) -> Vec<Option<ArkitShape>> {
    let extras = mesh.extras().as_ref().and_then(|extras| serde_json::from_str::<serde_json::Value>(extras.get()).ok());
    let names = extras.as_ref().and_then(|extras| extras.get("targetNames")).and_then(|names| names.as_array());
    names.into_iter().flatten().map(|name| name.as_str().and_then(ArkitShape::of_target)).collect()
}

/// `tangent` made unit and orthogonal to `normal`; any such direction where that leaves nothing.
fn orthogonal_tangent(tangent: Vec3, normal: Vec3) -> Vec3 {
    (tangent - normal * tangent.dot(normal)).try_normalize().unwrap_or_else(|| normal.any_orthonormal_vector())
}

fn vertex_normals(positions: &[Vec3], indices: &[u32]) -> Vec<Vec3> {
    let mut sums = vec![Vec3::ZERO; positions.len()];
    for triangle in indices.as_chunks::<3>().0 {
        let [a, b, c] = triangle.map(|index| index as usize);
        let area_vector = (positions[b] - positions[a]).cross(positions[c] - positions[a]);
        for corner in [a, b, c] {
            sums[corner] += area_vector;
        }
    }
    sums.into_iter().map(|sum| sum.normalize_or(Vec3::Z)).collect()
}

/// For files without tangents: along +U, the mean over a vertex's triangles.
fn vertex_tangents(positions: &[Vec3], normals: &[Vec3], uvs: &[Vec2], indices: &[u32]) -> Vec<[f32; 4]> {
    let mut along_u = vec![Vec3::ZERO; positions.len()];
    let mut along_v = vec![Vec3::ZERO; positions.len()];
    for triangle in indices.as_chunks::<3>().0 {
        let [a, b, c] = triangle.map(|index| index as usize);
        let (edge_1, edge_2) = (positions[b] - positions[a], positions[c] - positions[a]);
        let (uv_1, uv_2) = (uvs[b] - uvs[a], uvs[c] - uvs[a]);
        let area = uv_1.perp_dot(uv_2);
        if area == 0.0 {
            continue;
        }
        let (u, v) = ((edge_1 * uv_2.y - edge_2 * uv_1.y) / area, (edge_2 * uv_1.x - edge_1 * uv_2.x) / area);
        for corner in [a, b, c] {
            along_u[corner] += u.normalize_or_zero();
            along_v[corner] += v.normalize_or_zero();
        }
    }
    (0..positions.len())
        .map(|v| {
            let tangent = orthogonal_tangent(along_u[v], normals[v]);
            // glTF's V grows downwards in the picture, its bitangent upwards.
            let sign = if normals[v].cross(tangent).dot(along_v[v]) > 0.0 { -1.0 } else { 1.0 };
            [tangent.x, tangent.y, tangent.z, sign]
        })
        .collect()
}

/// Decodes the file's images one after another. Only the last is kept: all of them together may take a gigabyte, and what
/// uses one twice uses it twice in a row.
struct Images<'a> {
    document: &'a gltf::Document,
    blob: &'a [u8],
    maps: Maps,
    last: Option<(usize, RgbaImage)>,
}

/// What is read of a file's pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Maps {
    /// All.
    Decoded,
    /// Nothing: a grey texel, which is flat where it is read as a slope, stands for each.
    Blank,
}

impl Images<'_> {
    fn of_texture(&mut self, texture: usize) -> Result<Option<&RgbaImage>> {
        let Some(texture) = self.document.textures().nth(texture) else { return Ok(None) };
        let index = texture.source().index();
        if self.last.as_ref().is_none_or(|(last, _)| *last != index) {
            let gltf::image::Source::View { view, .. } = texture.source().source() else { return Ok(None) };
            self.last = None;
            if self.maps == Maps::Blank {
                let blank = RgbaImage::from_pixel(1, 1, image::Rgba([FLAT_CODE; 4]));
                return Ok(Some(&self.last.insert((index, blank)).1));
            }
            let bytes = self.blob.get(view.offset()..view.offset() + view.length()).unwrap_or_default();
            let image = image::load_from_memory(bytes).map_err(|source| AssetError::Image { index, source })?;
            self.last = Some((index, image.into_rgba8()));
        }
        Ok(self.last.as_ref().map(|(_, image)| image))
    }
}

/// Key in a material's `extras`: blue of its metallic-roughness texture is the strength of highlights.
const INTENSITY_IN_BLUE: &str = "rhytid_intensity_in_blue";

fn read_material(material: &gltf::Material<'_>, images: &mut Images<'_>) -> Result<MaterialAsset> {
    let pbr = material.pbr_metallic_roughness();
    let albedo = match pbr.base_color_texture() {
        Some(info) => images.of_texture(info.texture().index())?.map(|image| MipChain::new(image, Texels::AlbedoSrgb)),
        None => None,
    };
    let (normal, normal_scale) = match material.normal_texture() {
        Some(info) => (images.of_texture(info.texture().index())?.map(|image| MipChain::new(image, Texels::Slopes)), info.scale()),
        None => (None, 0.0),
    };
    let roughness_image = match pbr.metallic_roughness_texture() {
        Some(info) => images.of_texture(info.texture().index())?.cloned(),
        None => None,
    };
    let (occlusion_image, occlusion_strength) = match material.occlusion_texture() {
        Some(info) => (images.of_texture(info.texture().index())?.cloned(), info.strength().clamp(0.0, 1.0)),
        None => (None, 0.0),
    };
    // Of skin that is no metal a metallic map says nothing: its blue is free for how strong highlights are.
    let extras = material.extras().as_ref().and_then(|extras| serde_json::from_str::<serde_json::Value>(extras.get()).ok());
    let says_so = extras.and_then(|extras| extras.get(INTENSITY_IN_BLUE)?.as_bool()) == Some(true);
    let has_intensity = says_so && roughness_image.is_some();
    Ok(MaterialAsset {
        base_color: pbr.base_color_factor(),
        albedo,
        normal,
        normal_scale,
        surface_map: surface_map(occlusion_image, roughness_image, has_intensity),
        has_intensity,
        roughness: pbr.roughness_factor(),
        occlusion_strength,
        alpha: match material.alpha_mode() {
            gltf::material::AlphaMode::Opaque => Alpha::Opaque,
            gltf::material::AlphaMode::Mask | gltf::material::AlphaMode::Blend => Alpha::Coverage,
        },
        is_double_sided: material.double_sided(),
    })
}

/// Occlusion (red of its image), roughness and, where it is there, intensity (green and blue of another) in one map of the
/// larger image's size.
fn surface_map(occlusion: Option<RgbaImage>, roughness: Option<RgbaImage>, has_intensity: bool) -> Option<MipChain> {
    let largest = [&occlusion, &roughness].into_iter().flatten().map(|image| image.dimensions()).max()?;
    let scaled = |image: Option<RgbaImage>| match image {
        Some(image) if image.dimensions() == largest => image,
        Some(image) => image::imageops::resize(&image, largest.0, largest.1, image::imageops::FilterType::Triangle),
        None => RgbaImage::from_pixel(largest.0, largest.1, image::Rgba([255; 4])),
    };
    let (occlusion, roughness) = (scaled(occlusion), scaled(roughness));
    let pairs = || occlusion.pixels().zip(roughness.pixels());
    let (kind, texels) = if has_intensity {
        (Texels::Linear4, pairs().flat_map(|(occlusion, roughness)| [occlusion[0], roughness[1], roughness[2], 255]).collect())
    } else {
        (Texels::Linear2, pairs().flat_map(|(occlusion, roughness)| [occlusion[0], roughness[1]]).collect())
    };
    Some(MipChain::from_texels([largest.0, largest.1], kind, texels))
}

fn read_zones(character: &Character, images: &mut Images<'_>) -> Result<Option<ZoneMaps>> {
    let Some(zones) = &character.zones else { return Ok(None) };
    let mut chain = |texture: usize, texels| images.of_texture(texture).map(|image| image.map(|image| MipChain::new(image, texels)));
    let Some(map) = chain(zones.map.texture, Texels::Slopes)? else { return Ok(None) };
    let Some(first) = zones.masks.first().and_then(|mask| chain(*mask, Texels::Linear4).transpose()).transpose()? else { return Ok(None) };
    let second = match zones.masks.get(1) {
        Some(mask) => chain(*mask, Texels::Linear4)?,
        None => None,
    };
    let stretch = match zones.stretch {
        Some(stretch) => chain(stretch.texture, Texels::Slopes)?,
        None => None,
    };
    let difference = match zones.difference {
        Some(difference) => chain(difference, Texels::Linear4)?,
        None => None,
    };
    Ok(Some(ZoneMaps {
        stretch_scale: if stretch.is_some() { zones.stretch.map_or(0.0, |stretch| stretch.scale) } else { 0.0 },
        stretch: stretch.unwrap_or_else(|| MipChain::uniform(map.size, Texels::Slopes, &[FLAT_CODE; 2])),
        masks: {
            let second = second.unwrap_or_else(|| MipChain::uniform(first.size, Texels::Linear4, &[0; 4]));
            [first, second]
        },
        map,
        scale: zones.map.scale,
        difference,
        wavelength: zones.wavelength,
    }))
}

fn read_wrinkles(character: &Character, images: &mut Images<'_>) -> Result<Option<WrinkleMaps>> {
    let mut maps: Vec<Option<MipChain>> = Vec::with_capacity(character.num_poses());
    for pose in &character.poses {
        maps.push(match pose.map {
            Some(map) => images.of_texture(map.texture)?.map(|image| MipChain::new(image, Texels::Slopes)),
            None => None,
        });
    }
    let Some(size) = maps.iter().flatten().map(|map| map.size).next() else { return Ok(None) };
    let scales = character.poses.iter().map(|pose| pose.map.map_or(0.0, |map| map.scale)).collect();
    let contains_neutral = character.poses.iter().map(|pose| pose.map.is_some_and(|map| map.contains_neutral)).collect();
    let layers = maps.into_iter().map(|map| map.unwrap_or_else(|| MipChain::uniform(size, Texels::Slopes, &[FLAT_CODE; 2]))).collect();
    Ok(Some(WrinkleMaps { layers, scales, contains_neutral }))
}
