//! A `.glb` taken apart so that a test can break one thing, and a character of four vertices that is quick to read.

use serde_json::{Value, json};

/// The two chunks of a `.glb`.
#[derive(Debug, Clone)]
pub struct Glb {
    pub json: Value,
    pub bin: Vec<u8>,
}

impl Glb {
    /// Two brows under a head, a square of skin with a colour and a sparse morph target, one pose with a wrinkle map.
    pub fn small_character() -> Self {
        let mut bin = Bin::default();
        let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let positions = bin.accessor(
            &floats(&[-0.05, 0.0, 0.09, 0.05, 0.0, 0.09, 0.05, 0.1, 0.09, -0.05, 0.1, 0.09]),
            json!({"componentType": 5126, "type": "VEC3", "count": 4, "min": [-0.05, 0.0, 0.09], "max": [0.05, 0.1, 0.09]}),
        );
        let normals = bin.accessor(&floats(&[0.0, 0.0, 1.0].repeat(4)), json!({"componentType": 5126, "type": "VEC3", "count": 4}));
        let tangents = bin.accessor(&floats(&[1.0, 0.0, 0.0, 1.0].repeat(4)), json!({"componentType": 5126, "type": "VEC4", "count": 4}));
        let uvs =
            bin.accessor(&floats(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), json!({"componentType": 5126, "type": "VEC2", "count": 4}));
        let joints = bin.accessor(&[1, 2, 0, 0].repeat(4), json!({"componentType": 5121, "type": "VEC4", "count": 4}));
        let weights = bin.accessor(
            &[[200, 55, 0, 0], [55, 200, 0, 0]].concat().repeat(2),
            json!({"componentType": 5121, "type": "VEC4", "count": 4, "normalized": true}),
        );
        let indices = bin.accessor(
            &[0_u16, 1, 2, 0, 2, 3].iter().flat_map(|index| index.to_le_bytes()).collect::<Vec<u8>>(),
            json!({"componentType": 5123, "type": "SCALAR", "count": 6}),
        );
        let (moved, by) = (bin.view(&[3, 0, 0, 0]), bin.view(&floats(&[0.0, 0.004, 0.001])));
        bin.accessors.push(json!({"componentType": 5126, "type": "VEC3", "count": 4, "sparse": {
            "count": 1, "indices": {"bufferView": moved, "componentType": 5121}, "values": {"bufferView": by}}}));
        let target = bin.accessors.len() - 1;
        let places = [[0.0, 0.0, 0.0], [0.03, 0.05, 0.09], [-0.03, 0.05, 0.09]];
        let inverse_bind: Vec<f32> = places
            .iter()
            .flat_map(|&[x, y, z]: &[f32; 3]| [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -x, -y, -z, 1.0])
            .collect();
        let inverse_bind = bin.accessor(&floats(&inverse_bind), json!({"componentType": 5126, "type": "MAT4", "count": 3}));
        let png = bin.view(&png(4, 4));

        let mut landmarks = vec![[0.0_f32, 0.0, 0.09]; 68];
        (landmarks[36], landmarks[45]) = ([-0.04, 0.03, 0.08], [0.04, 0.03, 0.08]);
        let bone = |name: &str, at: [f32; 3]| json!({"name": name, "point": at, "drive": {"type": "skin", "landmarks": [[19, 1.0]]}});
        let json = json!({
            "asset": {"version": "2.0"},
            "extensionsUsed": ["RHYTID_face"],
            "extensions": {"RHYTID_face": {
                "version": 1, "name": "small", "head": "head", "landmarks": {"ibug68": landmarks},
                "bones": [bone("brow_l", places[1]), bone("brow_r", places[2])],
                "groups": [["brow_l", "brow_r"]],
                "poses": [{"name": "up", "bones": {"brow_l": [0.03, 0.055, 0.09]}, "map": {"texture": 0, "scale": 0.5}}],
            }},
            "scene": 0,
            "scenes": [{"nodes": [0, 3]}],
            "nodes": [
                {"name": "head", "children": [1, 2]},
                {"name": "brow_l", "translation": places[1]},
                {"name": "brow_r", "translation": places[2]},
                {"name": "face", "mesh": 0, "skin": 0},
            ],
            "skins": [{"joints": [0, 1, 2], "inverseBindMatrices": inverse_bind}],
            "meshes": [{"extras": {"targetNames": ["browInnerUp"]}, "primitives": [{
                "attributes": {"POSITION": positions, "NORMAL": normals, "TANGENT": tangents, "TEXCOORD_0": uvs,
                    "JOINTS_0": joints, "WEIGHTS_0": weights},
                "indices": indices, "material": 0, "targets": [{"POSITION": target}],
            }]}],
            "materials": [{"name": "skin", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            "textures": [{"source": 0}],
            "images": [{"bufferView": png, "mimeType": "image/png"}],
            "buffers": [{"byteLength": bin.bytes.len()}],
            "bufferViews": bin.views,
            "accessors": bin.accessors,
        });
        Self { json, bin: bin.bytes }
    }

    /// Two zones, one on each half, with a mask of 4 x 4 texels and a map of as many; `up` at `brow_l` drives the left one.
    #[allow(dead_code, reason = "not every test binary looks at zones")]
    pub fn with_zones(mut self) -> Self {
        let mask = self.texture(&png_of(image::RgbaImage::from_pixel(4, 4, image::Rgba([100, 155, 255, 255]))));
        let map = self.texture(&png(4, 4));
        self.json["extensions"]["RHYTID_face"]["zones"] = json!({
            "list": [{"name": "red", "side": "left"}, {"name": "green", "side": "right"}],
            "masks": [mask],
            "map": {"texture": map, "scale": 0.5},
            "expressions": [{"name": "surprise", "weights": [0.8, 0.8]}, {"name": "anger", "weights": [-0.6, -0.6]}],
            "bridge": [{"pose": "up", "bone": "brow_l", "zone": "red", "gain": 0.5}],
        });
        self
    }

    /// Adds an image; gives the index of its texture.
    #[allow(dead_code, reason = "not every test binary adds images")]
    pub fn texture(&mut self, png: &[u8]) -> usize {
        let push = |list: &mut Value, value: Value| {
            let list = list.as_array_mut().unwrap();
            list.push(value);
            list.len() - 1
        };
        let view = push(&mut self.json["bufferViews"], json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": png.len()}));
        self.bin.extend(png);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.json["buffers"][0]["byteLength"] = json!(self.bin.len());
        let image = push(&mut self.json["images"], json!({"bufferView": view, "mimeType": "image/png"}));
        push(&mut self.json["textures"], json!({"source": image}))
    }

    pub fn to_bytes(&self) -> Vec<u8> {
        self.with_json(&serde_json::to_vec(&self.json).unwrap())
    }

    /// The file with other bytes where its JSON stands.
    pub fn with_json(&self, json: &[u8]) -> Vec<u8> {
        let mut json = json.to_vec();
        json.resize(json.len().next_multiple_of(4), b' ');
        let mut bytes = b"glTF".to_vec();
        let total = 12 + 8 + json.len() + 8 + self.bin.len();
        for word in [2, total, json.len(), 0x4E4F_534A] {
            bytes.extend((word as u32).to_le_bytes());
        }
        bytes.extend(&json);
        for word in [self.bin.len(), 0x004E_4942] {
            bytes.extend((word as u32).to_le_bytes());
        }
        bytes.extend(&self.bin);
        bytes
    }
}

/// A white PNG.
pub fn png(width: u32, height: u32) -> Vec<u8> {
    png_of(image::GrayImage::from_pixel(width, height, image::Luma([255])))
}

/// A picture as PNG.
pub fn png_of(picture: impl Into<image::DynamicImage>) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.into().write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

#[derive(Default)]
struct Bin {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Bin {
    fn view(&mut self, bytes: &[u8]) -> usize {
        self.views.push(json!({"buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len()}));
        self.bytes.extend(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.len() - 1
    }

    fn accessor(&mut self, bytes: &[u8], mut accessor: Value) -> usize {
        accessor["bufferView"] = json!(self.view(bytes));
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }
}
