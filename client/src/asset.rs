//! A character as the renderer needs it, decoded from its `.glb` on the CPU: triangles with skinning and weight
//! gradients, joints, materials, wrinkle maps. No GPU here.

mod blood;
mod gradients;
mod joints;
mod load;
mod mips;
mod morphs;

pub use blood::{BloodChange, BloodMaps, BloodTexel};
pub use gradients::{triangle_gradient, weight_gradients};
pub use joints::{JointMotion, Palette};
pub use mips::{MipChain, Texels};
pub use morphs::{ENTRIES_PER_ROW, MAX_ENTRIES, MorphEntry, Morphs, TEXELS_PER_ENTRY};

use glam::Vec3;
use rhytid_shared::{Character, CharacterError};
use std::sync::Arc;

/// Why a character cannot be drawn.
#[derive(Debug, thiserror::Error)]
pub enum AssetError {
    /// The file or its description is wrong.
    #[error(transparent)]
    Character(#[from] CharacterError),
    /// An image inside the file cannot be decoded.
    #[error("character file images[{index}]: {source}")]
    Image {
        /// Index into glTF `images`.
        index: usize,
        /// What the decoder said.
        source: image::ImageError,
    },
    /// A morph target moves a vertex to nowhere.
    #[error("character file part {part:?}: target {shape} moves vertex {vertex} by {got}, expected finite metres within ±10")]
    Delta {
        /// Name of the part's material.
        part: String,
        /// ARKit's name of the target.
        shape: &'static str,
        /// Index of the vertex.
        vertex: usize,
        /// The displacement.
        got: Vec3,
    },
    /// The targets do not fit into one texture.
    #[error("the morph targets move vertices in more than {most} places, counted once for each vertex and shape")]
    TooManyDeltas {
        /// How many fit.
        most: usize,
    },
}

/// A character ready to be uploaded.
#[derive(Debug, PartialEq)]
pub struct CharacterAsset {
    /// Its checked description.
    pub character: Arc<Character>,
    /// Parts, each with one material, in the file's order.
    pub primitives: Vec<PrimitiveAsset>,
    /// How each joint of the palette moves; entry `i` below the number of bones is bone `i`'s joint.
    pub palette: Palette,
    /// What expression shapes do to the vertices.
    pub morphs: Morphs,
    /// The wrinkle maps, if any pose has one.
    pub wrinkles: Option<WrinkleMaps>,
    /// Maps of the wrinkle zones, where the character has them.
    pub zones: Option<ZoneMaps>,
    /// Colour that follows the face, where the character's does.
    pub blood: Option<BloodMaps>,
}

impl CharacterAsset {
    /// Decodes and checks a whole `.glb`.
    pub fn from_glb(bytes: &[u8]) -> Result<Self, AssetError> {
        load::load(bytes, load::Maps::Decoded)
    }

    /// Decodes and checks all of a `.glb` but its pictures, each of which one grey texel stands for: what a device needs to get
    /// ready to draw it, while [`CharacterAsset::fill`] decodes the rest.
    pub fn outline(bytes: &[u8]) -> Result<Self, AssetError> {
        load::load(bytes, load::Maps::Blank)
    }

    /// Decodes the pictures of an outline; `bytes` are those it was made of.
    pub fn fill(&mut self, bytes: &[u8]) -> Result<(), AssetError> {
        load::fill(self, bytes)
    }

    /// Vertices of all parts.
    pub fn num_vertices(&self) -> usize {
        self.primitives.iter().map(|primitive| primitive.vertices.len()).sum()
    }
}

/// One part of the character.
#[derive(Debug, PartialEq)]
pub struct PrimitiveAsset {
    /// The material's name in the file.
    pub name: String,
    /// What it is made of.
    pub surface: Surface,
    /// Vertices, indices below point into them.
    pub vertices: Vec<Vertex>,
    /// Triangles, counter-clockwise from outside.
    pub indices: Vec<u32>,
    /// Colours and maps.
    pub material: MaterialAsset,
}

/// What a part is made of; decides how it is shaded. Read from the material's name (see [`Surface::from_material_name`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Surface {
    /// Skin: wrinkles, soft terminator, two-lobe highlight.
    Skin,
    /// Eyeball with its iris: wet and sharp.
    Eye,
    /// A clear shell over the eye or a line of tears: highlights only.
    Wet,
    /// Teeth, gums, tongue, the mouth's lining: moist, darker the deeper they lie.
    Mouth,
    /// Brows, lashes, hair of the head.
    Hair,
    /// Clothes and everything else.
    Cloth,
}

impl Surface {
    /// The surface a material's name stands for: the first of these words among its own, singular or plural, in any case; skin
    /// where none. Words end where letters end or a small letter meets a capital.
    pub fn from_material_name(name: &str) -> Self {
        const WORDS: [(&str, Surface); 28] = [
            ("brow", Surface::Hair),
            ("eyebrow", Surface::Hair),
            ("lash", Surface::Hair),
            ("lashes", Surface::Hair),
            ("eyelash", Surface::Hair),
            ("eyelashes", Surface::Hair),
            ("hair", Surface::Hair),
            ("cornea", Surface::Wet),
            ("tear", Surface::Wet),
            ("tearline", Surface::Wet),
            ("lacrimal", Surface::Wet),
            ("wet", Surface::Wet),
            ("teeth", Surface::Mouth),
            ("tooth", Surface::Mouth),
            ("gum", Surface::Mouth),
            ("tongue", Surface::Mouth),
            ("mouth", Surface::Mouth),
            ("cloth", Surface::Cloth),
            ("clothes", Surface::Cloth),
            ("shirt", Surface::Cloth),
            ("collar", Surface::Cloth),
            ("skin", Surface::Skin),
            ("lid", Surface::Skin),
            ("eyelid", Surface::Skin),
            ("eye", Surface::Eye),
            ("eyeball", Surface::Eye),
            ("sclera", Surface::Eye),
            ("iris", Surface::Eye),
        ];
        let words = words(name);
        let is_named = |word: &str| words.iter().any(|own| own == word || own.strip_suffix('s') == Some(word));
        WORDS.iter().find(|(word, _)| is_named(word)).map_or(Self::Skin, |&(_, surface)| surface)
    }
}

/// The words of a name in small letters: `EyeLash_L.001` has eye, lash and l.
fn words(name: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut was_small = false;
    for letter in name.chars() {
        if !letter.is_alphabetic() || (was_small && letter.is_uppercase()) {
            words.push(String::new());
        }
        if letter.is_alphabetic() {
            words.last_mut().expect("there is one from the start").extend(letter.to_lowercase());
        }
        was_small = letter.is_lowercase();
    }
    words
}

/// A vertex as it is uploaded. Head space at rest, metres.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Vertex {
    /// Position.
    pub position: [f32; 3],
    /// Unit normal.
    pub normal: [f32; 3],
    /// Unit tangent along +U; w is the bitangent's sign.
    pub tangent: [f32; 4],
    /// Texture coordinates, origin top left.
    pub uv: [f32; 2],
    /// Palette entries.
    pub joints: [u8; 4],
    /// Weights of the entries, sum 1.
    pub weights: [f32; 4],
    /// Gradients of weights 1, 2 and 3 in the tangent plane, 1/metre, each along the tangent and along
    /// `cross(normal, tangent)`. Weight 0's gradient is minus their sum.
    pub gradients: [[f32; 2]; 3],
    /// First of its entries in [`Morphs`], and how many it has.
    pub morphs: [u32; 2],
}

/// Colours and maps of a part.
#[derive(Debug, PartialEq)]
pub struct MaterialAsset {
    /// Multiplies the albedo map; linear RGB and alpha.
    pub base_color: [f32; 4],
    /// Albedo, sRGB-encoded RGB and linear alpha.
    pub albedo: Option<MipChain>,
    /// Partial derivatives of the pores and creases at rest: `(code - 128) / 127 * normal_scale` in red and green.
    pub normal: Option<MipChain>,
    /// Largest slope the codes of `normal` reach.
    pub normal_scale: f32,
    /// Ambient occlusion in red, roughness in green, both linear and 1 where a map is missing; in blue, where
    /// `has_intensity`, the strength of highlights: code 128 is 1.
    pub surface_map: Option<MipChain>,
    /// The surface map has a blue channel.
    pub has_intensity: bool,
    /// Multiplies the roughness of the map.
    pub roughness: f32,
    /// How much of the occlusion map is applied, 0 to 1.
    pub occlusion_strength: f32,
    /// What alpha does.
    pub alpha: Alpha,
    /// Both sides are drawn.
    pub is_double_sided: bool,
}

/// What a material's alpha does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Alpha {
    /// Nothing.
    Opaque,
    /// It becomes coverage of the samples of a pixel.
    Coverage,
}

/// Maps of the wrinkle zones (Jimenez et al. 2011).
#[derive(Debug, PartialEq)]
pub struct ZoneMaps {
    /// Two layers; zone `i` is channel `i % 4` of layer `i / 4`.
    pub masks: [MipChain; 2],
    /// Partial derivatives of the wrinkles of all zones, and the largest slope their codes reach.
    pub map: MipChain,
    /// See `map`.
    pub scale: f32,
    /// What takes the creases out of stretched skin; flat where the character has none.
    pub stretch: MipChain,
    /// See `stretch`; 0 where the character has none.
    pub stretch_scale: f32,
    /// The wrinkles as differences of unit normals, where the character has them.
    pub difference: Option<MipChain>,
    /// Metres from one wrinkle to the next.
    pub wavelength: f32,
}

/// All wrinkle maps of a character, one layer a pose.
#[derive(Debug, PartialEq)]
pub struct WrinkleMaps {
    /// `o` layers of red and green codes; poses without a map have a layer of code 128.
    pub layers: Vec<MipChain>,
    /// `o` scales: largest slope the codes of a layer reach; 0 where a pose has no map.
    pub scales: Vec<f32>,
    /// Whether a layer also contains the pores of the neutral map.
    pub contains_neutral: Vec<bool>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    #[test]
    fn outline_is_the_character_without_pictures_and_filled_it_is_whole() {
        let whole = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
        let mut asset = CharacterAsset::outline(DEFAULT_CHARACTER_GLB).unwrap();
        assert_eq!(asset.primitives[0].vertices, whole.primitives[0].vertices);
        assert!(asset.primitives.iter().filter_map(|primitive| primitive.material.albedo.as_ref()).all(|map| map.size == [1, 1]));
        let (outlined, wrinkles) = (asset.wrinkles.as_ref().unwrap(), whole.wrinkles.as_ref().unwrap());
        assert!(outlined.scales == wrinkles.scales && outlined.layers != wrinkles.layers);
        asset.fill(DEFAULT_CHARACTER_GLB).unwrap();
        assert!(asset == whole);
    }

    #[test]
    fn surface_is_read_from_whole_words_of_the_materials_name() {
        for (name, surface) in [
            ("skin", Surface::Skin),
            ("eyelid_skin", Surface::Skin),
            ("Eyelids", Surface::Skin),
            ("EyeLid.001", Surface::Skin),
            ("Gumball machine", Surface::Skin),
            ("", Surface::Skin),
            ("eye", Surface::Eye),
            ("M_EyeLeft", Surface::Eye),
            ("Eyes.L", Surface::Eye),
            ("EyeLash_R", Surface::Hair),
            ("eyebrows", Surface::Hair),
            ("cornea", Surface::Wet),
            ("M_GumsTongue", Surface::Mouth),
            ("TEETH", Surface::Mouth),
            ("shirt_collar", Surface::Cloth),
        ] {
            assert_eq!(Surface::from_material_name(name), surface, "{name}");
        }
    }
}
