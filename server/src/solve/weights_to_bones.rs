//! From expression weights to the character's bones, in two layers: linear deltas of the character's own blend shapes at
//! each bone, exact for single shapes; and Gaussian correctives on what authored combinations lack.

use super::lids::gaze_share;
use super::linear::Lu;
use super::lips::Lips;
use super::rotation;
use glam::Vec3;
use rhytid_shared::character::{Drive, LidKind, Side};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, NUM_ARKIT_SHAPES};

/// Worst condition number of the correctives' system before it is regularised.
const WORST_CONDITION: f64 = 1e6;
/// Share of the jaw's widest angle that `jawOpen` gives a character without that shape.
const DEFAULT_JAW_OPEN: f32 = 0.7;

/// How much of a lid's way with the gaze is left to the gaze's weights: what trackers call a blink holds the rest of it.
const FOLLOWS_GAZE: f32 = 0.6;
/// How far the upper lid sinks in a squint, as a share of its way to shut, and how far the lower one rises, in angles that
/// it turns in a blink: there the upper lid does nearly everything. By what a tracker reads of the character.
const SQUINT_SINKS: f32 = 0.10;
const SQUINT_RISES: f32 = 4.0;

/// Expression weights in the order of [`ARKIT_NAMES`].
pub(super) type Weights = [f32; NUM_ARKIT_SHAPES];

/// One shape's effect at weight 1: a motion for each bone.
#[derive(Debug, Clone)]
pub(super) struct Response {
    pub(super) shape: usize,
    pub(super) motions: Vec<Vec3>,
}

/// The map from weights to one character's bones.
#[derive(Debug, Clone)]
pub(super) struct WeightRig {
    responses: Vec<Response>,
    correctives: Option<Correctives>,
    limits: Vec<Limit>,
    /// Squint and blink of each eye.
    lid_shapes: [[usize; 2]; 2],
    lips: Lips,
    /// What lifts the lower lip against the upper one.
    lip_lifts: [usize; 2],
}

/// Range of a bone's motion.
#[derive(Debug, Clone, Copy)]
enum Limit {
    Free,
    /// Least and most pitch, most yaw, radians.
    Angles([f32; 2], f32),
}

impl WeightRig {
    pub(super) fn new(character: &Character) -> Self {
        let motions_of = |deltas: &[Vec3]| -> Vec<Vec3> {
            character.bones.iter().zip(deltas).map(|(bone, delta)| motion_of(&bone.drive, bone.rest, *delta)).collect()
        };
        let mut responses: Vec<Response> = ARKIT_NAMES
            .iter()
            .enumerate()
            .map(|(shape, _)| {
                let own = character.shapes.iter().find(|deltas| deltas.shape.index() == shape);
                Response { shape, motions: own.map_or_else(|| vec![Vec3::ZERO; character.num_bones()], |own| motions_of(&own.deltas)) }
            })
            .collect();
        for (i, bone) in character.bones.iter().enumerate() {
            author_turns(&bone.drive, &mut responses, i);
        }
        responses.retain(|response| response.motions.iter().any(|motion| *motion != Vec3::ZERO));
        let limits = character.bones.iter().map(|bone| limit_of(&bone.drive)).collect();
        let index = |name: &str| ARKIT_NAMES.iter().position(|known| *known == name).unwrap_or(0);
        let lid_shapes = [["eyeSquintLeft", "eyeBlinkLeft"], ["eyeSquintRight", "eyeBlinkRight"]].map(|pair| pair.map(index));
        let lip_lifts = ["mouthRollLower", "mouthShrugLower"].map(index);
        let lips = Lips::new(character, &responses);
        let mut rig = Self { responses, correctives: None, limits, lid_shapes, lips, lip_lifts };
        rig.correctives = Correctives::new(character, &rig);
        rig
    }

    /// Writes each bone's motion: a displacement in metres, or pitch and yaw in radians for bones that turn.
    pub(super) fn solve(&self, weights: &Weights, motions: &mut [Vec3]) {
        let mut weights = *weights;
        // Lids that shut meet where they always do, squinting or not.
        for [squint, blink] in self.lid_shapes {
            weights[squint] *= 1.0 - weights[blink].clamp(0.0, 1.0);
        }
        // Rolling in and shrugging lift the same lip: what both lift beyond one of them counts half, or it would cover the upper one.
        let lift: f32 = self.lip_lifts.iter().map(|&shape| weights[shape]).sum();
        if lift > 1.0 {
            self.lip_lifts.iter().for_each(|&shape| weights[shape] *= 0.5 + 0.5 / lift);
        }
        self.add_linear(&weights, motions);
        if let Some(correctives) = &self.correctives {
            correctives.add(&weights, motions);
        }
        self.lips.add(&weights, motions);
        for (motion, limit) in motions.iter_mut().zip(&self.limits) {
            if let Limit::Angles(pitch, yaw) = limit {
                *motion = Vec3::new(motion.x.clamp(pitch[0], pitch[1]), motion.y.clamp(-yaw, *yaw), 0.0);
            }
        }
    }

    fn add_linear(&self, weights: &Weights, motions: &mut [Vec3]) {
        motions.fill(Vec3::ZERO);
        for response in &self.responses {
            let weight = weights[response.shape];
            if weight != 0.0 {
                for (motion, unit) in motions.iter_mut().zip(&response.motions) {
                    *motion += *unit * weight;
                }
            }
        }
    }
}

/// The motion that carries a bone's point by `delta`.
fn motion_of(drive: &Drive, rest: Vec3, delta: Vec3) -> Vec3 {
    match drive {
        Drive::Skin { .. } => delta,
        Drive::Still => Vec3::ZERO,
        Drive::Jaw { pivot, .. } | Drive::Lid { pivot, .. } | Drive::Eye { pivot, .. } => {
            let arm = (rest - *pivot).as_dvec3();
            let (pitch, yaw) = rotation::pitch_yaw_between(arm, arm + delta.as_dvec3());
            Vec3::new(pitch as f32, yaw as f32, 0.0)
        }
    }
}

/// Sets what a character states for its turning bones itself: a blink of 1 shuts the lids fully, a look of 1 is the
/// eye's full range, lids follow the gaze.
fn author_turns(drive: &Drive, responses: &mut [Response], bone: usize) {
    let mut set = |name: &str, motion: Vec3| {
        // The names below stand in ARKIT_NAMES; a slip of the pen would show as a lid that never moves in the tests.
        if let Some(shape) = ArkitShape::from_name(name) {
            responses[shape.index()].motions[bone] = motion;
        }
    };
    let pitch = |angle: f32| Vec3::new(angle, 0.0, 0.0);
    let yaw = |angle: f32| Vec3::new(0.0, angle, 0.0);
    match *drive {
        Drive::Lid { eye, lid, shut_angle, wide_angle, .. } => {
            let side = name_of(eye);
            set(&format!("eyeBlink{side}"), pitch(shut_angle));
            set(&format!("eyeWide{side}"), pitch(wide_angle));
            set(&format!("eyeSquint{side}"), pitch(shut_angle * if lid == LidKind::Upper { SQUINT_SINKS } else { SQUINT_RISES }));
            // A lid's own travel is about the eye's up and down range.
            let follow = FOLLOWS_GAZE * shut_angle.abs().max(0.2) * gaze_share(lid) as f32;
            set(&format!("eyeLookDown{side}"), pitch(follow));
            set(&format!("eyeLookUp{side}"), pitch(if lid == LidKind::Upper { -0.5 * follow } else { -follow }));
        }
        Drive::Eye { eye, range, .. } => {
            let side = name_of(eye);
            // Out is away from the nose: towards +X for the left eye.
            let out = if eye == Side::Left { range[0] } else { -range[0] };
            set(&format!("eyeLookOut{side}"), yaw(out));
            set(&format!("eyeLookIn{side}"), yaw(-out));
            set(&format!("eyeLookDown{side}"), pitch(range[1]));
            set(&format!("eyeLookUp{side}"), pitch(-range[1]));
            for name in ["eyeBlink", "eyeWide", "eyeSquint"] {
                set(&format!("{name}{side}"), Vec3::ZERO);
            }
        }
        Drive::Jaw { max_angle, .. } => {
            let is_still = ArkitShape::from_name("jawOpen").is_some_and(|shape| responses[shape.index()].motions[bone] == Vec3::ZERO);
            if is_still && let Some(shape) = ArkitShape::from_name("jawOpen") {
                responses[shape.index()].motions[bone] = pitch(DEFAULT_JAW_OPEN * max_angle);
            }
        }
        Drive::Skin { .. } | Drive::Still => {}
    }
}

fn name_of(side: Side) -> &'static str {
    match side {
        Side::Left => "Left",
        Side::Right => "Right",
    }
}

fn limit_of(drive: &Drive) -> Limit {
    match *drive {
        Drive::Skin { .. } | Drive::Still => Limit::Free,
        Drive::Jaw { max_angle, .. } => Limit::Angles([-0.1, max_angle], 0.0873),
        Drive::Lid { lid, shut_angle, wide_angle, .. } => {
            let furthest = shut_angle * if lid == LidKind::Upper { 1.0 } else { SQUINT_RISES };
            Limit::Angles([furthest.min(wide_angle), furthest.max(wide_angle)], 0.0)
        }
        Drive::Eye { range, .. } => Limit::Angles([-range[1], range[1]], range[0]),
    }
}

/// Gaussian correctives: `motion += sum_m A_m exp(-|w - w_m|^2 / (2 sigma^2))` over the shapes the examples name, solved
/// so that each example is met exactly. Not normalised: far from all examples the linear layer is left as it is.
#[derive(Debug, Clone)]
struct Correctives {
    /// Shapes that any example names: the others are irrelevant to the distance.
    shapes: Vec<usize>,
    /// `m * shapes.len()` weights.
    centres: Vec<f32>,
    /// `-1 / (2 sigma^2)`.
    falloff: f64,
    /// `jawOpen` and `mouthClose` where no example says what the two do together: then a jaw parts the lips by what it exceeds the
    /// mouth's closing alone.
    closing: Option<[usize; 2]>,
    /// Each bell's value at neutral.
    at_neutral: Vec<f64>,
    /// `(bone, m amplitudes)`.
    amplitudes: Vec<(usize, Vec<Vec3>)>,
}

impl Correctives {
    fn new(character: &Character, rig: &WeightRig) -> Option<Self> {
        let mut shapes: Vec<usize> =
            character.correctives.iter().flat_map(|example| example.weights.iter().map(|(shape, _)| shape.index())).collect();
        shapes.sort_unstable();
        shapes.dedup();
        if shapes.is_empty() {
            return None;
        }
        // Examples, then what must stay linear: neutral and every single shape the examples are made of.
        let mut centres: Vec<Vec<f32>> = Vec::new();
        let mut residuals: Vec<Vec<Vec3>> = Vec::new();
        let mut linear = vec![Vec3::ZERO; character.num_bones()];
        for example in &character.correctives {
            let mut weights: Weights = [0.0; NUM_ARKIT_SHAPES];
            for &(shape, weight) in &example.weights {
                weights[shape.index()] = weight;
            }
            rig.add_linear(&weights, &mut linear);
            let mut residual = vec![Vec3::ZERO; character.num_bones()];
            for &(bone, delta) in &example.bones {
                let bone_of = &character.bones[bone];
                residual[bone] = motion_of(&bone_of.drive, bone_of.rest, delta) - linear[bone];
            }
            let centre: Vec<f32> = shapes.iter().map(|&shape| weights[shape]).collect();
            if !centres.contains(&centre) {
                centres.push(centre);
                residuals.push(residual);
            }
        }
        let num_examples = centres.len();
        for at in 0..num_examples {
            let zero = vec![0.0; shapes.len()];
            let singles = (0..shapes.len()).filter(|&s| centres[at][s] != 0.0).map(|s| {
                let mut single = zero.clone();
                single[s] = centres[at][s];
                single
            });
            for linear_one in singles.chain([zero.clone()]).collect::<Vec<_>>() {
                if !centres.contains(&linear_one) {
                    centres.push(linear_one);
                    residuals.push(vec![Vec3::ZERO; character.num_bones()]);
                }
            }
        }
        let (falloff, solution) = solve_gaussians(&centres)?;
        let amplitudes = (0..character.num_bones())
            .filter(|&bone| residuals.iter().any(|residual| residual[bone] != Vec3::ZERO))
            .map(|bone| {
                let axes = [0, 1, 2].map(|axis| {
                    let right: Vec<f64> = residuals.iter().map(|residual| f64::from(residual[bone][axis])).collect();
                    solution.solve(&right)
                });
                let at = |m: usize| Vec3::new(axes[0][m] as f32, axes[1][m] as f32, axes[2][m] as f32);
                (bone, (0..centres.len()).map(at).collect())
            })
            .collect();
        let at_neutral = centres
            .iter()
            .map(|centre| libm::exp(centre.iter().map(|&at| f64::from(0.0 - at) * f64::from(0.0 - at)).sum::<f64>() * falloff))
            .collect();
        let [jaw_open, mouth_close] = ["jawOpen", "mouthClose"].map(|name| ArkitShape::from_name(name).map(ArkitShape::index));
        let closing = jaw_open.zip(mouth_close.filter(|close| !shapes.contains(close))).map(<[usize; 2]>::from);
        Some(Self { shapes, centres: centres.concat(), falloff, closing, at_neutral, amplitudes })
    }

    fn add(&self, weights: &Weights, motions: &mut [Vec3]) {
        let mut weights = *weights;
        if let Some([jaw_open, mouth_close]) = self.closing {
            weights[jaw_open] = (weights[jaw_open] - weights[mouth_close]).max(0.0);
        }
        for (m, centre) in self.centres.chunks_exact(self.shapes.len()).enumerate() {
            let mut square = 0.0;
            for (&shape, &at) in self.shapes.iter().zip(centre) {
                let d = f64::from(weights[shape] - at);
                square += d * d;
            }
            // What it gives at neutral, zero but for rounding and the ridge, is taken off: neutral is exact.
            let bell = (libm::exp(square * self.falloff) - self.at_neutral[m]) as f32;
            for (bone, amplitudes) in &self.amplitudes {
                motions[*bone] += amplitudes[m] * bell;
            }
        }
    }
}

/// The exponent's factor and the factored matrix of the Gaussians at `centres`, regularised until it is well-conditioned.
/// The Gaussian is positive definite, so its ridge is added.
fn solve_gaussians(centres: &[Vec<f32>]) -> Option<(f64, Lu)> {
    let num = centres.len();
    let nearest = |m: usize| (0..num).filter(|&e| e != m).map(|e| square(&centres[m], &centres[e]).sqrt()).fold(f64::INFINITY, f64::min);
    let sigma = (0..num).map(nearest).sum::<f64>() / num as f64;
    if !(sigma > 0.0 && sigma.is_finite()) {
        return None;
    }
    let falloff = -0.5 / (sigma * sigma);
    let mut ridge = 0.0;
    loop {
        match factor_gaussians(centres, falloff, ridge) {
            Some((lu, condition)) if condition < WORST_CONDITION => return Some((falloff, lu)),
            _ if ridge > 1.0 => return None,
            _ => ridge = if ridge == 0.0 { 1e-6 } else { ridge * 10.0 },
        }
    }
}

/// The Gaussians at `centres` with `ridge` on the diagonal, factored, and the condition number of that (by 1-norms).
fn factor_gaussians(centres: &[Vec<f32>], falloff: f64, ridge: f64) -> Option<(Lu, f64)> {
    let num = centres.len();
    let mut matrix = vec![0.0; num * num];
    for e in 0..num {
        for m in 0..num {
            matrix[e * num + m] = libm::exp(square(&centres[e], &centres[m]) * falloff);
        }
        matrix[e * num + e] += ridge;
    }
    let norm = (0..num).map(|m| (0..num).map(|e| matrix[e * num + m]).sum::<f64>()).fold(0.0, f64::max);
    let lu = Lu::factor(matrix, num)?;
    let condition = norm * lu.inverse_norm();
    Some((lu, condition))
}

/// Squared distance.
fn square(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b) * f64::from(a - b)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussian_weights_interpolate_and_decay_to_the_linear_rig() {
        // Two channels of linear deltas (6, -4) on one bone; the example at (1, 1) wants 0.5 and everything else is linear.
        let centres: Vec<Vec<f32>> = vec![vec![0.0, 0.0], vec![1.0, 0.0], vec![0.0, 1.0], vec![1.0, 1.0]];
        let square = |a: &[f32], b: [f64; 2]| {
            let (x, y) = (f64::from(a[0]) - b[0], f64::from(a[1]) - b[1]);
            x * x + y * y
        };
        // With sigma = 0.6 in place of the mean distance of 1: distances scaled by 1 / 0.6.
        let scaled: Vec<Vec<f32>> = centres.clone();
        let (falloff, lu) = solve_gaussians(&scaled).expect("well-conditioned");
        assert!((falloff + 0.5).abs() < 1e-12, "sigma is the mean distance to the nearest example");
        let amplitudes = lu.solve(&[0.0, 0.0, 0.0, 0.5 - 2.0]);
        let corrected = |w: [f64; 2]| {
            let bells = centres.iter().zip(&amplitudes).map(|(c, a)| a * libm::exp(falloff * square(c, w))).sum::<f64>();
            6.0 * w[0] - 4.0 * w[1] + bells
        };
        for (w, want) in [([0.0, 0.0], 0.0), ([1.0, 0.0], 6.0), ([0.0, 1.0], -4.0), ([1.0, 1.0], 0.5)] {
            assert!((corrected(w) - want).abs() < 1e-9, "{w:?}: {}", corrected(w));
        }
        assert!((corrected([6.0, 6.0]) - 12.0).abs() < 1e-3, "far away the linear rig is left");
    }

    #[test]
    fn gaussians_of_a_given_width_agree_with_the_worked_example() {
        let centres: Vec<Vec<f32>> = vec![vec![0.0, 0.0], vec![1.0, 0.0], vec![0.0, 1.0], vec![1.0, 1.0]];
        let falloff = -0.5 / (0.6 * 0.6);
        let (lu, condition) = factor_gaussians(&centres, falloff, 0.0).expect("regular");
        assert!((condition - 2.7701).abs() < 1e-4, "{condition}");
        let weights = lu.solve(&[0.0, 6.0, -4.0, 0.5]);
        for (got, want) in weights.iter().zip([-0.53167631, 6.39742519, -4.26556231, 0.00147307]) {
            assert!((got - want).abs() < 1e-8, "{weights:?}");
        }
        let bells = |weights: &[f64], at: [f32; 2]| -> f64 {
            centres.iter().zip(weights).map(|(centre, weight)| weight * libm::exp(falloff * square(centre, &at))).sum()
        };
        assert!((bells(&weights, [0.5, 0.0]) - 3.39367045).abs() < 1e-8);
        // On what the linear layer (6, -4) lacks.
        let residual = lu.solve(&[0.0, 0.0, 0.0, 0.5 - 2.0]);
        for (at, want) in [([0.5, 0.0], 3.0), ([0.5, 0.5], 0.52012504)] {
            let got = 6.0 * f64::from(at[0]) - 4.0 * f64::from(at[1]) + bells(&residual, at);
            assert!((got - want).abs() < 1e-8, "{at:?}: {got}");
        }
    }

    #[test]
    fn nearly_equal_examples_are_regularised() {
        let centres = vec![vec![0.0], vec![0.5], vec![0.5001], vec![1.0], vec![1.5]];
        let (_, lu) = solve_gaussians(&centres).expect("regularised");
        assert!(lu.solve(&[0.0, 1.0, -1.0, 0.0, 0.0]).iter().all(|amplitude| amplitude.abs() < 1e6));
    }
}
