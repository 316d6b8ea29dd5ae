//! A drawable piece of the character, as it goes into the file.

use glam::{Vec2, Vec3, Vec4};

/// Materials in the order of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Material {
    /// Skin, with the inside of the mouth.
    Skin,
    /// Eyeballs.
    Eye,
    /// Teeth and gums.
    Teeth,
    /// Tongue.
    Tongue,
    /// Eyebrows.
    Brow,
    /// Eyelashes.
    Lash,
    /// Line of tears along the lower lids.
    Tear,
}

impl Material {
    /// All of them.
    pub const ALL: [Self; 7] = [Self::Skin, Self::Eye, Self::Teeth, Self::Tongue, Self::Brow, Self::Lash, Self::Tear];

    /// Name in the file, by which viewers tell them apart.
    pub fn name(self) -> &'static str {
        match self {
            Self::Skin => "skin",
            Self::Eye => "eye",
            Self::Teeth => "teeth",
            Self::Tongue => "tongue",
            Self::Brow => "brow",
            Self::Lash => "lash",
            Self::Tear => "tear",
        }
    }
}

/// Up to four joints and their weights, which sum to 255 exactly.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Binding {
    /// Indices into the skin's joints.
    pub joints: [u8; 4],
    /// Weights times 255.
    pub weights: [u8; 4],
}

impl Binding {
    /// Wholly bound to one joint.
    pub fn rigid(joint: u8) -> Self {
        Self { joints: [joint, 0, 0, 0], weights: [255, 0, 0, 0] }
    }

    /// The four largest of `(joint, weight)`, normalised; the rounding is settled so that codes sum to 255.
    pub fn from_weights(mut weights: Vec<(u8, f32)>) -> Self {
        weights.retain(|&(_, weight)| weight > 0.5 / 255.0);
        weights.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        weights.truncate(4);
        let sum: f32 = weights.iter().map(|&(_, weight)| weight).sum();
        let mut binding = Self { joints: [0; 4], weights: [0; 4] };
        let mut remainders: Vec<(f32, usize)> = Vec::with_capacity(4);
        let mut missing = 255_u8;
        for (slot, &(joint, weight)) in weights.iter().enumerate() {
            let exact = weight / sum * 255.0;
            binding.joints[slot] = joint;
            binding.weights[slot] = exact as u8;
            missing -= exact as u8;
            remainders.push((exact.fract(), slot));
        }
        remainders.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for &(_, slot) in remainders.iter().take(usize::from(missing)) {
            binding.weights[slot] += 1;
        }
        binding
    }
}

/// One primitive. All per-vertex arrays have the same length.
#[derive(Debug, Clone)]
pub struct Part {
    /// What it is made of.
    pub material: Material,
    /// Neutral positions, metres, head space.
    pub positions: Vec<Vec3>,
    /// Unit normals.
    pub normals: Vec<Vec3>,
    /// Tangent and handedness, where the material has a normal map.
    pub tangents: Option<Vec<Vec4>>,
    /// Texture coordinates, origin top-left.
    pub uvs: Vec<Vec2>,
    /// Joints and weights.
    pub bindings: Vec<Binding>,
    /// `morphs[shape]`: displaced vertices, ascending.
    pub morphs: Vec<Vec<(u32, Vec3)>>,
    /// Counter-clockwise triangles.
    pub triangles: Vec<[u32; 3]>,
}

/// Displacements shorter than this are left out, metres: below what a pixel shows.
const LEAST_DELTA: f32 = 1.5e-4;
/// From this length on they are kept whole; between the two they fade, so that no step is left on the skin.
const WHOLE_DELTA: f32 = 3.0e-4;

/// The entries of a dense displacement list worth storing.
pub fn sparse(deltas: impl Iterator<Item = Vec3>) -> Vec<(u32, Vec3)> {
    let fade = |delta: Vec3| {
        let share = ((delta.length() - LEAST_DELTA) / (WHOLE_DELTA - LEAST_DELTA)).clamp(0.0, 1.0);
        delta * share
    };
    deltas.map(fade).enumerate().filter(|(_, delta)| *delta != Vec3::ZERO).map(|(v, delta)| (v as u32, delta)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantised_weights_sum_to_255_whatever_they_were() {
        for i in 1..200 {
            let weights = (0..6).map(|j| (j, libm::fabsf(libm::sinf((i * (j as i32 + 3)) as f32)))).collect();
            let binding = Binding::from_weights(weights);
            assert_eq!(binding.weights.iter().map(|&w| u32::from(w)).sum::<u32>(), 255);
        }
    }

    #[test]
    fn only_the_four_largest_weights_stay() {
        let binding = Binding::from_weights(vec![(0, 0.1), (1, 0.4), (2, 0.05), (3, 0.3), (4, 0.15)]);
        assert_eq!(binding.joints, [1, 3, 4, 0]);
    }
}
