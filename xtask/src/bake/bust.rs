//! The finished neutral skin as the painter of textures sees it.

use glam::{Vec2, Vec3, Vec4};
use rhytid_shared::layout::NUM_IBUG;

/// What a vertex of the skin belongs to; from MakeHuman's masks, finer than the islands of the texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Region {
    /// Front of the head below the hair line.
    Face,
    /// Lips' red.
    Lips,
    /// Both ears.
    Ear,
    /// Lids up to their crease.
    Eyelid,
    /// Inside of the mouth.
    Mouth,
    /// Pocket behind the lids.
    Socket,
    /// Neck, back of the head, shoulders: the rest of the skin.
    Body,
    /// The surface that closes the bust below.
    Cap,
}

/// Neutral skin, split at UV seams. Arrays over vertices have one length.
pub struct Bust {
    /// Metres, head space (+Y up, +Z out of the face, +X to the character's left).
    pub positions: Vec<Vec3>,
    /// Unit normals, continuous over seams.
    pub normals: Vec<Vec3>,
    /// Tangents as the file has them: unit `xyz` along +u, handedness `w`; bitangent = `w * cross(normal, tangent)`.
    pub tangents: Vec<Vec4>,
    /// Texture coordinates as in glTF: origin top-left, seen from the front the face stands upright and is not mirrored.
    pub uvs: Vec<Vec2>,
    /// Region of each vertex.
    pub regions: Vec<Region>,
    /// Corners, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// iBUG landmarks on the neutral.
    pub ibug68: [Vec3; NUM_IBUG],
    /// Eyes, left and right.
    pub eyes: [Eyeball; 2],
    /// Reference poses in the order their wrinkle maps are wanted.
    pub poses: Vec<PoseField>,
}

/// An eyeball.
#[derive(Debug, Clone, Copy)]
pub struct Eyeball {
    /// Centre of the sphere.
    pub centre: Vec3,
    /// Radius of the sphere, metres.
    pub radius: f32,
}

/// How a reference pose moves the skin.
pub struct PoseField {
    /// Name in the file.
    pub name: &'static str,
    /// Sum of the skinning weights of the bones the pose moves, 0 to 1: where wrinkles can show at all.
    pub influence: Vec<f32>,
}

/// An image as it goes into the file.
pub struct Encoded {
    /// `image/png` or `image/jpeg`.
    pub mime: &'static str,
    /// The file's bytes.
    pub bytes: Vec<u8>,
}

/// A map of partial derivatives `p = n.xy / n.z`, coded `(code - 128) / 127 * scale` in red and green, blue 255 (so that
/// the same picture is a valid glTF normal texture with `scale`). +x is +u, +y is towards smaller v, as in glTF.
pub struct SlopeMap {
    /// The picture.
    pub image: Encoded,
    /// Largest slope the codes reach.
    pub scale: f32,
}

/// Masks and maps of the wrinkle zones.
pub struct PaintedZones {
    /// RGBA, linear: four zones each.
    pub masks: [Encoded; 2],
    /// The wrinkles of all zones.
    pub map: SlopeMap,
    /// What takes the resting face's creases out.
    pub stretch: SlopeMap,
    /// The wrinkles as differences of unit normals from the flat one, `(code - 128) / 127` in red, green and blue.
    pub difference: Encoded,
}

/// What the painter gives back.
pub struct Painted {
    /// Skin colour, sRGB.
    pub skin_albedo: Encoded,
    /// Pores and folds of the neutral.
    pub skin_slopes: SlopeMap,
    /// Occlusion in red, roughness in green, metallic (0) in blue, linear.
    pub skin_surface: Encoded,
    /// One for each of [`Bust::poses`], all of one size, a power of two a side.
    pub wrinkles: Vec<SlopeMap>,
    /// Wrinkle zones.
    pub zones: PaintedZones,
    /// Eyeball, sRGB: front pole in the middle, distance from it proportional to the angle from the front pole, the
    /// circle that touches the border being `eyes::TEXTURE_ANGLE`.
    pub eye_albedo: Encoded,
    /// Teeth and gums, sRGB: upper half of the picture (v < 0.5) enamel, v from root to edge; lower half gum.
    pub teeth_albedo: Encoded,
}
