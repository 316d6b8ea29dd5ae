//! Writes the `.glb`: one mesh, one skin, sparse morph targets, textures inside.

use super::bust::{BloodMaps, Encoded, Painted};
use super::part::{Material, Part};
use super::rig::Rig;
use super::zones;
use glam::Vec3;
use rhytid_shared::ARKIT_NAMES;
use rhytid_shared::character::schema::{self, EXTENSION, Face, ZoneMap};
use serde_json::{Value, json};

const FLOAT: u32 = 5126;
const U8: u32 = 5121;
const U16: u32 = 5123;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Everything that goes into the file.
pub struct Contents<'a> {
    /// Primitives of the one mesh.
    pub parts: &'a [Part],
    /// Joints.
    pub rig: &'a Rig,
    /// The extension; its maps' texture indices and its zones are set here.
    pub face: Face,
    /// Textures.
    pub painted: &'a Painted,
    /// `asset.copyright`.
    pub copyright: &'a str,
}

#[derive(Default)]
struct Writer {
    blob: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    images: Vec<Value>,
}

impl Writer {
    fn view(&mut self, bytes: &[u8], target: Option<u32>) -> usize {
        while !self.blob.len().is_multiple_of(4) {
            self.blob.push(0);
        }
        let mut view = json!({ "buffer": 0, "byteOffset": self.blob.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.blob.extend_from_slice(bytes);
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats<const N: usize>(&mut self, values: impl Iterator<Item = [f32; N]>, kind: &str) -> usize {
        let bytes: Vec<u8> = values.flatten().flat_map(f32::to_le_bytes).collect();
        let count = bytes.len() / (4 * N);
        let view = self.view(&bytes, Some(ARRAY_BUFFER));
        self.accessor(json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": kind }))
    }

    fn positions(&mut self, positions: &[Vec3]) -> usize {
        let accessor = self.floats(positions.iter().map(Vec3::to_array), "VEC3");
        let (low, high) = bounds(positions.iter().copied());
        self.accessors[accessor]["min"] = json!(low.to_array());
        self.accessors[accessor]["max"] = json!(high.to_array());
        accessor
    }

    fn bytes4(&mut self, values: impl Iterator<Item = [u8; 4]>, is_normalized: bool) -> usize {
        let bytes: Vec<u8> = values.flatten().collect();
        let view = self.view(&bytes, Some(ARRAY_BUFFER));
        let mut accessor = json!({ "bufferView": view, "componentType": U8, "count": bytes.len() / 4, "type": "VEC4" });
        if is_normalized {
            accessor["normalized"] = true.into();
        }
        self.accessor(accessor)
    }

    fn indices(&mut self, triangles: &[[u32; 3]]) -> usize {
        let bytes: Vec<u8> = triangles.iter().flatten().flat_map(|&index| short(index).to_le_bytes()).collect();
        let view = self.view(&bytes, Some(ELEMENT_ARRAY_BUFFER));
        self.accessor(json!({ "bufferView": view, "componentType": U16, "count": triangles.len() * 3, "type": "SCALAR" }))
    }

    /// A morph target's displacements. An empty one gets one zero entry: readers differ on accessors without any data.
    fn sparse(&mut self, deltas: &[(u32, Vec3)], num_vertices: usize) -> usize {
        let zero = [(0, Vec3::ZERO)];
        let deltas = if deltas.is_empty() { &zero } else { deltas };
        let indices: Vec<u8> = deltas.iter().flat_map(|&(v, _)| short(v).to_le_bytes()).collect();
        let values: Vec<u8> = deltas.iter().flat_map(|(_, delta)| delta.to_array()).flat_map(f32::to_le_bytes).collect();
        let (indices, values) = (self.view(&indices, None), self.view(&values, None));
        let rest = (deltas.len() < num_vertices).then_some(Vec3::ZERO);
        let (low, high) = bounds(deltas.iter().map(|&(_, delta)| delta).chain(rest));
        self.accessor(json!({
            "componentType": FLOAT, "count": num_vertices, "type": "VEC3",
            "min": low.to_array(), "max": high.to_array(),
            "sparse": {
                "count": deltas.len(),
                "indices": { "bufferView": indices, "componentType": U16 },
                "values": { "bufferView": values },
            },
        }))
    }

    /// Adds an image and its texture, which have the same index.
    fn texture(&mut self, image: &Encoded, name: &str) -> usize {
        let view = self.view(&image.bytes, None);
        self.images.push(json!({ "bufferView": view, "mimeType": image.mime, "name": name }));
        self.images.len() - 1
    }
}

/// The file's bytes.
pub fn write(contents: Contents<'_>) -> Vec<u8> {
    let Contents { parts, rig, mut face, painted, copyright } = contents;
    let mut writer = Writer::default();
    let primitives: Vec<Value> = parts.iter().map(|part| primitive(&mut writer, part)).collect();
    let materials = materials(&mut writer, painted);
    for (pose, map) in face.poses.iter_mut().zip(&painted.wrinkles) {
        let texture = writer.texture(&map.image, &format!("wrinkles_{}", pose.name));
        pose.map = Some(schema::WrinkleMap { texture, scale: map.scale, contains_neutral: false });
    }
    let [first, second] = &painted.zones.masks;
    let masks = [writer.texture(first, "zone_mask_0"), writer.texture(second, "zone_mask_1")];
    let [map, stretch] = [(&painted.zones.map, "zone_wrinkles"), (&painted.zones.stretch, "zone_stretch")]
        .map(|(map, name)| ZoneMap { texture: writer.texture(&map.image, name), scale: map.scale });
    let difference = writer.texture(&painted.zones.difference, "zone_difference");
    face.zones = Some(zones::describe(masks, map, stretch, difference));

    face.colour = Some(colour(&mut writer, &painted.blood));

    // Joints come first, so that joint and node indices are the same; the mesh's node is the last.
    let mut nodes: Vec<Value> = rig
        .joints
        .iter()
        .map(|joint| {
            let parent = joint.parent.map_or(Vec3::ZERO, |parent| rig.joints[usize::from(parent)].position);
            json!({ "name": joint.name, "translation": (joint.position - parent).to_array() })
        })
        .collect();
    for j in 0..rig.joints.len() {
        let children: Vec<usize> = (0..rig.joints.len()).filter(|&c| rig.joints[c].parent == Some(j as u8)).collect();
        if !children.is_empty() {
            nodes[j]["children"] = json!(children);
        }
    }
    let inverse_binds = rig.joints.iter().map(|joint| glam::Mat4::from_translation(-joint.position).to_cols_array());
    let inverse_binds = writer.floats(inverse_binds, "MAT4");
    if let Some(target) = writer.views[writer.accessors[inverse_binds]["bufferView"].as_u64().unwrap_or_default() as usize].as_object_mut()
    {
        target.remove("target");
    }
    nodes.push(json!({ "name": "face", "mesh": 0, "skin": 0 }));
    let num_joints = rig.joints.len();

    let document = json!({
        "asset": { "version": "2.0", "generator": "Rhytid, cargo xtask bake", "copyright": copyright },
        "extensionsUsed": [EXTENSION],
        "extensions": { EXTENSION: face },
        "scene": 0,
        "scenes": [{ "nodes": [0, num_joints] }],
        "nodes": nodes,
        "skins": [{ "joints": (0..num_joints).collect::<Vec<_>>(), "skeleton": 0, "inverseBindMatrices": inverse_binds }],
        "meshes": [{ "name": "face", "primitives": primitives, "weights": vec![0.0; ARKIT_NAMES.len()], "extras": { "targetNames": ARKIT_NAMES.as_slice() } }],
        "materials": materials,
        "textures": (0..writer.images.len()).map(|source| json!({ "source": source, "sampler": 0 })).collect::<Vec<_>>(),
        "samplers": [{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }],
        "images": writer.images,
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{ "byteLength": writer.blob.len().next_multiple_of(4) }],
    });
    container(document.to_string().into_bytes(), writer.blob)
}

/// The maps of blood and what says how to read them.
fn colour(writer: &mut Writer, blood: &BloodMaps) -> schema::Colour {
    let base = writer.texture(&blood.base, "blood");
    let changes = blood.changes.iter().map(|map| schema::ColourChange {
        pose: Some(map.pose.to_owned()),
        zone: None,
        texture: writer.texture(&map.image, &format!("blood_{}", map.pose)),
        spread: map.spread,
        shift: map.shift,
    });
    schema::Colour { base, most: blood.most, changes: changes.collect(), strength: 1.0 }
}

fn primitive(writer: &mut Writer, part: &Part) -> Value {
    let mut attributes = json!({
        "POSITION": writer.positions(&part.positions),
        "NORMAL": writer.floats(part.normals.iter().map(Vec3::to_array), "VEC3"),
        "TEXCOORD_0": writer.floats(part.uvs.iter().map(glam::Vec2::to_array), "VEC2"),
        "JOINTS_0": writer.bytes4(part.bindings.iter().map(|binding| binding.joints), false),
        "WEIGHTS_0": writer.bytes4(part.bindings.iter().map(|binding| binding.weights), true),
    });
    if let Some(tangents) = &part.tangents {
        attributes["TANGENT"] = writer.floats(tangents.iter().map(glam::Vec4::to_array), "VEC4").into();
    }
    let targets: Vec<Value> = part.morphs.iter().map(|deltas| json!({ "POSITION": writer.sparse(deltas, part.positions.len()) })).collect();
    let material = Material::ALL.iter().position(|&material| material == part.material);
    json!({ "attributes": attributes, "indices": writer.indices(&part.triangles), "material": material, "targets": targets })
}

/// In the order of [`Material::ALL`].
fn materials(writer: &mut Writer, painted: &Painted) -> Vec<Value> {
    let albedo = writer.texture(&painted.skin_albedo, "skin_albedo");
    let slopes = writer.texture(&painted.skin_slopes.image, "skin_slopes");
    let surface = writer.texture(&painted.skin_surface, "skin_surface");
    let eye = writer.texture(&painted.eye_albedo, "eye_albedo");
    let teeth = writer.texture(&painted.teeth_albedo, "teeth_albedo");
    let plain = |name: &str, color: [f32; 4], roughness: f32| json!({ "name": name, "pbrMetallicRoughness": { "baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": roughness } });
    Material::ALL
        .iter()
        .map(|material| {
            let name = material.name();
            match material {
                Material::Skin => json!({
                    "name": name,
                    "pbrMetallicRoughness": {
                        "baseColorTexture": { "index": albedo },
                        "metallicRoughnessTexture": { "index": surface }, "metallicFactor": 0.0, "roughnessFactor": 1.0,
                    },
                    "normalTexture": { "index": slopes, "scale": painted.skin_slopes.scale },
                    "occlusionTexture": { "index": surface },
                    "extras": { "rhytid_intensity_in_blue": true },
                }),
                Material::Eye => json!({
                    "name": name,
                    "pbrMetallicRoughness": { "baseColorTexture": { "index": eye }, "metallicFactor": 0.0, "roughnessFactor": 0.08 },
                }),
                Material::Teeth => json!({
                    "name": name,
                    "pbrMetallicRoughness": { "baseColorTexture": { "index": teeth }, "metallicFactor": 0.0, "roughnessFactor": 0.25 },
                }),
                Material::Tongue => plain(name, [0.46, 0.16, 0.15, 1.0], 0.4),
                Material::Brow => two_sided(plain(name, [0.080, 0.054, 0.038, 1.0], 0.65)),
                Material::Tear => plain(name, [1.0, 1.0, 1.0, 1.0], 0.08),
                Material::Lash => two_sided(plain(name, [0.020, 0.015, 0.012, 1.0], 0.5)),
            }
        })
        .collect()
}

fn two_sided(mut material: Value) -> Value {
    material["doubleSided"] = true.into();
    material
}

/// Indices are 16 bit: every part is checked to have fewer vertices before it is written.
fn short(index: u32) -> u16 {
    u16::try_from(index).expect("parts have less than 65,536 vertices, as the bake checks")
}

fn bounds(points: impl Iterator<Item = Vec3>) -> (Vec3, Vec3) {
    points.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

fn container(mut json: Vec<u8>, mut blob: Vec<u8>) -> Vec<u8> {
    json.resize(json.len().next_multiple_of(4), b' ');
    blob.resize(blob.len().next_multiple_of(4), 0);
    let total = 12 + 8 + json.len() + 8 + blob.len();
    let mut file = Vec::with_capacity(total);
    file.extend_from_slice(b"glTF");
    file.extend_from_slice(&2_u32.to_le_bytes());
    file.extend_from_slice(&(total as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", json), (b"BIN\0", blob)] {
        file.extend_from_slice(&(chunk.len() as u32).to_le_bytes());
        file.extend_from_slice(kind);
        file.extend_from_slice(&chunk);
    }
    file
}
