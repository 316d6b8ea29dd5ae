//! The MakeHuman body as one adult individual: macro targets mixed, made slightly asymmetric, relaxed to a neutral
//! expression, and put into head space.

use super::obj::{Obj, parse_target};
use super::source::Source;
use super::weights::{shape, smoothstep};
use anyhow::{Result, ensure};
use glam::Vec3;
use rhytid_shared::ARKIT_NAMES;

/// MakeHuman's unit is the decimetre.
const METRES_PER_UNIT: f32 = 0.1;

/// Who it is: MakeHuman's own macro targets and their weights; ancestry sums to one. Tuned by eye.
const MACROS: [(&str, f32); 8] = [
    ("caucasian-male-young", 0.40),
    ("african-male-young", 0.14),
    ("asian-male-young", 0.16),
    ("caucasian-female-young", 0.18),
    ("african-female-young", 0.06),
    ("asian-female-young", 0.06),
    ("universal-male-young-averagemuscle-averageweight", 0.70),
    ("universal-female-young-averagemuscle-averageweight", 0.30),
];

/// Expression shapes mixed into the neutral. The plain MakeHuman face reads as a frown (a tracker sees browDown 0.44),
/// its lips come apart by half a millimetre when the mesh is subdivided, and its eyes are a little narrow.
const NEUTRAL_SHAPES: [(&str, f32); 11] = [
    ("eyeWideLeft", 0.55),
    ("eyeWideRight", 0.45),
    ("eyeSquintLeft", -0.30),
    ("eyeSquintRight", -0.15),
    ("browDownLeft", -0.50),
    ("browDownRight", -0.50),
    ("browInnerUp", 0.15),
    ("mouthLowerDownLeft", -0.08),
    ("mouthLowerDownRight", -0.08),
    ("mouthUpperUpLeft", -0.06),
    ("mouthUpperUpRight", -0.06),
];

/// MakeHuman's `mouthClose` undoes a wholly open jaw. ARKit's is given by itself too, where that would turn the lower lip
/// over the nose.
const MOUTH_CLOSE_SHARE: f32 = 0.35;

/// What goes along with a shape: `(shape, what is added, share)`. MakeHuman's `tongueOut` moves nothing but the tongue, through
/// the lower lip: mouth and jaw open for it. Its smile lifts the lower lip through the upper one, and a jaw that opens would
/// show nothing. Lips that are pressed together show less of their red.
const COMPANIONS: [(&str, &str, f32); 9] = [
    ("mouthSmileLeft", "mouthLowerDownLeft", 0.28),
    ("mouthSmileRight", "mouthLowerDownRight", 0.28),
    ("tongueOut", "jawOpen", 0.40),
    ("tongueOut", "mouthLowerDownLeft", 0.25),
    ("tongueOut", "mouthLowerDownRight", 0.25),
    ("mouthPressLeft", "mouthRollUpper", 0.25),
    ("mouthPressRight", "mouthRollUpper", 0.25),
    ("mouthPressLeft", "mouthRollLower", 0.12),
    ("mouthPressRight", "mouthRollLower", 0.12),
];

/// By how much a shape is made stronger or weaker than MakeHuman's. Found by a tracker: what it reads of a picture at weight
/// 1 against what it reads of people at their strongest. A press is half a smile at MakeHuman's strength.
const SHAPE_STRENGTHS: [(&str, f32); 12] = [
    ("browInnerUp", 1.4),
    ("browOuterUpLeft", 1.25),
    ("browOuterUpRight", 1.25),
    ("browDownLeft", 1.7),
    ("browDownRight", 1.7),
    ("mouthPressLeft", 0.55),
    ("mouthPressRight", 0.55),
    ("mouthRollLower", 1.6),
    ("mouthRollUpper", 1.4),
    ("mouthShrugLower", 1.35),
    ("mouthUpperUpLeft", 1.6),
    ("mouthUpperUpRight", 1.6),
];

/// MakeHuman's lips are fuller than most: by how much the upper and the lower one are flattened towards the line between them,
/// and how that fades upwards and downwards (metres), so that nose and chin stay. Tuned by eye and by a tracker, which reads
/// no lip that rolls in from a full one.
const SLIMMER_LIPS: [f32; 2] = [0.30, 0.40];
const LIPS_HEIGHT: f32 = 0.016;
/// Half the mouth's width, and where beside it nothing is flattened; how far behind the lips' front, metres.
const LIPS_WIDTH: [f32; 2] = [0.026, 0.040];
const LIPS_DEPTH: [f32; 2] = [0.012, 0.028];
/// Vertices of the inner lips' middle, upper and lower.
const LIPS_MIDDLE: [u32; 2] = [468, 494];

/// Waves of the asymmetry: `(direction and wave number, radians a metre; phase; displacement, metres)`. Long waves, so
/// that halves differ as halves of a face do and no feature is bent. Tuned by eye; the sum stays below 1.1 mm.
const ASYMMETRY: [(Vec3, f32, Vec3); 4] = [
    (Vec3::new(31.0, 12.0, 8.0), 0.6, Vec3::new(0.00018, 0.00024, 0.00014)),
    (Vec3::new(-18.0, 37.0, 11.0), 2.1, Vec3::new(0.00020, 0.00011, 0.00017)),
    (Vec3::new(44.0, -21.0, 15.0), 4.0, Vec3::new(0.00008, 0.00019, 0.00011)),
    (Vec3::new(23.0, 29.0, -33.0), 5.2, Vec3::new(0.00010, 0.00014, 0.00016)),
];

/// The whole base mesh with its helpers. Metres, head space: origin between the ears at the height of the eyes.
pub struct Base {
    /// Topology, UVs and groups (its positions are the raw ones).
    pub obj: Obj,
    /// Neutral position of every vertex of the `.obj`.
    pub positions: Vec<Vec3>,
    /// `morphs[shape]`: displacements of the vertices the shape moves, in [`ARKIT_NAMES`]' order; those of one vertex add up.
    pub morphs: Vec<Vec<(u32, Vec3)>>,
}

impl Base {
    /// Reads and mixes the sources. `ears` are the base vertices between which the origin lies.
    pub fn load(source: &mut Source, ears: [u32; 2]) -> Result<Self> {
        let obj = Obj::parse(&source.read_text("mpfb2/3dobjs/base.obj")?)?;
        let mut positions = obj.positions.clone();
        let mut read = |name: &str| -> Result<Vec<(u32, Vec3)>> {
            let deltas = parse_target(&source.read_text(name)?)?;
            ensure!(deltas.iter().all(|&(v, _)| (v as usize) < obj.positions.len()), "{name} moves a vertex the mesh lacks");
            Ok(deltas)
        };
        for (name, weight) in MACROS {
            for (v, delta) in read(&format!("mpfb2/targets/macrodetails/{name}.target.gz"))? {
                positions[v as usize] += delta * weight;
            }
        }
        let mut morphs: Vec<Vec<(u32, Vec3)>> = Vec::with_capacity(ARKIT_NAMES.len());
        for name in ARKIT_NAMES {
            let deltas = read(&format!("faceunits01/targets/faceunits/{name}.target"))?;
            if let Some(&(_, weight)) = NEUTRAL_SHAPES.iter().find(|(shape, _)| *shape == name) {
                deltas.iter().for_each(|&(v, delta)| positions[v as usize] += delta * weight);
            }
            let stronger = SHAPE_STRENGTHS.iter().find(|(shape, _)| *shape == name).map_or(1.0, |&(_, share)| share);
            let share = if name == "mouthClose" { MOUTH_CLOSE_SHARE } else { stronger };
            morphs.push(deltas.into_iter().map(|(v, delta)| (v, delta * METRES_PER_UNIT * share)).collect());
        }

        for (name, companion, share) in COMPANIONS {
            let added: Vec<(u32, Vec3)> = morphs[shape(companion)].iter().map(|&(v, delta)| (v, delta * share)).collect();
            morphs[shape(name)].extend(added);
        }

        let eyes = mean(&positions, &[obj.vertices_of("helper-l-eye"), obj.vertices_of("helper-r-eye")].concat());
        let ears = mean(&positions, &ears);
        let origin = Vec3::new(0.0, eyes.y, ears.z);
        for position in &mut positions {
            *position = (*position - origin) * METRES_PER_UNIT;
            *position += asymmetry(*position);
        }
        let middle = mean(&positions, &LIPS_MIDDLE);
        positions.iter_mut().for_each(|position| position.y -= flattened(*position - middle));
        Ok(Self { obj, positions, morphs })
    }

    /// Displacement of every vertex by one shape.
    pub fn dense_morph(&self, shape: usize) -> Vec<Vec3> {
        let mut dense = vec![Vec3::ZERO; self.positions.len()];
        self.morphs[shape].iter().for_each(|&(v, delta)| dense[v as usize] += delta);
        dense
    }
}

/// Mean position of the listed vertices.
pub fn mean(positions: &[Vec3], vertices: &[u32]) -> Vec3 {
    vertices.iter().map(|&v| positions[v as usize]).sum::<Vec3>() / vertices.len().max(1) as f32
}

/// How far down a place goes as the lips are made slimmer; `from_middle` is from the middle of the line between them.
fn flattened(from_middle: Vec3) -> f32 {
    let Vec3 { x, y, z } = from_middle;
    let share = SLIMMER_LIPS[usize::from(y < 0.0)] * libm::expf(-(y * y) / (LIPS_HEIGHT * LIPS_HEIGHT));
    let beside = 1.0 - smoothstep(LIPS_WIDTH[0], LIPS_WIDTH[1], x.abs());
    let in_front = 1.0 - smoothstep(LIPS_DEPTH[0], LIPS_DEPTH[1], -z);
    y * share * beside * in_front
}

fn asymmetry(position: Vec3) -> Vec3 {
    ASYMMETRY.iter().map(|&(wave, phase, amplitude)| amplitude * libm::sinf(wave.dot(position) + phase)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn asymmetry_is_small_and_differs_between_the_halves() {
        let mut largest_difference = 0.0_f32;
        for i in 0..1000 {
            let p = Vec3::new(0.08 * ((i % 10) as f32 / 10.0), -0.1 + 0.2 * ((i / 10 % 10) as f32 / 10.0), 0.12 * (i / 100) as f32 / 10.0);
            let (left, right) = (asymmetry(p), asymmetry(p * Vec3::new(-1.0, 1.0, 1.0)));
            assert!(left.length() < 1.1e-3);
            largest_difference = largest_difference.max((left.y - right.y).abs());
        }
        assert!(largest_difference > 2.5e-4, "halves differ by {largest_difference} m only");
    }
}
