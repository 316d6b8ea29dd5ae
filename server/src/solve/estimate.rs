//! Expression weights from landmarks: a ridge regression on examples made from the character's own shapes.
//!
//! Each example is a face of some shapes, seen by a camera from some side with a tracker's unsteady hand, and then treated as
//! a session treats what it sees: head pose found on the stable points, points lifted onto the neutral head, difference to
//! the neutral over the interocular distance. What the regression meets in a session is what it was trained on, with all that
//! the head pose takes away. There is no constant term: the neutral face has no weights, exactly.
//!
//! Landmarks show some shapes badly or not at all (a tongue, puffed cheeks, a jaw pushed forward). The leave-one-out error
//! tells: a shape of which it explains too little stays 0.

use super::head_pose::{self, Pose};
use super::points::{EyePoints, LEFT_EYE, PointSet, RIGHT_EYE};
use super::rotation;
use super::weights_to_bones::Weights;
use glam::{DQuat, DVec2, DVec3, Vec3};
use rhytid_shared::character::{Drive, Side};
use rhytid_shared::layout::NUM_IBUG;
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, NUM_ARKIT_SHAPES};
use serde::Serialize;
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// iBUG's points that are looked at: chin, brows, nose, eyes, mouth. The rest of the jaw line slides along the outline of the
/// face as the head turns.
const FIRST_CHIN: usize = 7;
const LAST_CHIN: usize = 9;
const FIRST_BROW: usize = 17;
const NUM_POINTS: usize = LAST_CHIN - FIRST_CHIN + 1 + NUM_IBUG - FIRST_BROW;
const NUM_FEATURES: usize = 2 * NUM_POINTS;

/// Faces of several shapes at once.
const NUM_COMBINATIONS: usize = 900;
/// Most shapes, or pairs of both sides, in one of these.
const MOST_SHAPES: u64 = 5;
/// How often one of [`FREQUENT`] is picked rather than any shape.
const FREQUENCY: f64 = 0.6;
/// What faces mostly do: what several shapes could explain is put down to these. Twice where more often. Tuned by hand.
const FREQUENT: [&str; 13] = [
    "jawOpen",
    "jawOpen",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthSmileLeft",
    "mouthSmileRight",
    "eyeBlinkLeft",
    "eyeBlinkRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "browDownLeft",
    "browDownRight",
];
/// A weight below this is noise: it is taken off, and what is left stretched to the whole range.
const FAINTEST: f64 = 0.03;
/// How often both sides do the same, as faces mostly do.
const PAIRED: f64 = 0.75;
/// Standard deviation of what a landmark is off by, fraction of the interocular distance: a tracker's noise, and how faces
/// differ. Half of it lets shapes in that landmarks hardly tell, twice of it leaves seven shapes (tried on two recorded
/// sessions).
const UNSTEADY: f64 = 0.005;
/// Largest turn of the head to either side and up or down in the examples, radians.
const MOST_YAW: f64 = 0.35;
const MOST_PITCH: f64 = 0.2;
/// Distance of the camera in the examples, interocular distances: an arm's length.
const CAMERA_DISTANCE: f64 = 7.0;
/// Ridges that are tried; the features are fractions of the interocular distance.
const RIDGES: [f64; 7] = [1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1];
/// A shape is given where the leave-one-out error leaves at least this much of its variance explained, in the mean over both
/// sides.
const LEAST_EXPLAINED: f64 = 0.4;
/// How much wider or narrower than the character's a performer's eyes are believed to be.
const EYE_SCALES: [f64; 2] = [0.5, 2.0];
/// Least opening of an eye that can be scaled, fraction of the interocular distance.
const LEAST_OPENING: f64 = 0.02;

/// How well one shape is told from landmarks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ShapeFit {
    /// ARKit's name.
    pub shape: &'static str,
    /// Root-mean-square leave-one-out error of its weight over all examples.
    pub error: f64,
    /// Share of its variance over the examples that is explained (leave-one-out R²); can be negative.
    pub explained: f64,
    /// Whether it is estimated; 0 where not.
    pub is_used: bool,
}

/// How well a character's shapes are told from landmarks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FitReport {
    /// Faces it was trained on.
    pub num_examples: usize,
    /// The ridge with the least error.
    pub ridge: f64,
    /// Root-mean-square leave-one-out error over all shapes the character has.
    pub error: f64,
    /// The character's shapes in ARKit's order.
    pub shapes: Vec<ShapeFit>,
}

/// The regression, the same for all performers of one character.
#[derive(Debug, Clone)]
pub struct ExpressionMap {
    /// Per used shape its index and [`NUM_FEATURES`] coefficients.
    rows: Vec<(usize, Box<[f64; NUM_FEATURES]>)>,
    report: FitReport,
}

/// The regression with one performer's neutral.
pub(super) struct Estimator {
    map: Arc<ExpressionMap>,
    /// The character's eyes' openings over its interocular distance, right and left.
    openings: [f64; 2],
    neutral: Vec<DVec2>,
    measure: Measure,
    features: Box<[f64; NUM_FEATURES]>,
    /// Eye bones, where irises are tracked.
    eyes: Vec<Eye>,
}

/// What makes features of points.
#[derive(Debug, Clone, Copy)]
struct Measure {
    /// One over the interocular distance, 1/metre.
    per_unit: f64,
    /// Factor of the up and down of the right and the left eye's lids: a lid that shuts has closed its own opening.
    lids: [f64; 2],
}

#[derive(Debug, Clone, Copy)]
struct Eye {
    bone: usize,
    /// Radians to the sides and up or down at weight 1.
    range: [f64; 2],
    /// Indices of look out, in, down, up.
    shapes: [usize; 4],
    /// 1 where out is a positive yaw.
    out: f64,
}

impl Estimator {
    /// `None` for layouts whose points are not iBUG's, and for characters without shapes that landmarks can tell.
    pub(super) fn new(character: &Arc<Character>, points: &PointSet) -> Option<Self> {
        if !points.is_ibug {
            return None;
        }
        let map = ExpressionMap::shared(character).filter(|map| !map.rows.is_empty())?;
        let model: Vec<DVec2> = points.model.iter().map(|point| point.truncate()).collect();
        let eyes = if points.irises.is_some() { eyes_of(character) } else { Vec::new() };
        let openings = openings_of(&model);
        let mut estimator = Self {
            map,
            openings,
            neutral: Vec::new(),
            measure: Measure { per_unit: 1.0, lids: [1.0; 2] },
            features: Box::new([0.0; NUM_FEATURES]),
            eyes,
        };
        estimator.adopt(&model);
        Some(estimator)
    }

    /// Takes a performer's neutral, head space.
    pub(super) fn adopt(&mut self, neutral: &[DVec2]) {
        self.neutral.clear();
        self.neutral.extend_from_slice(neutral);
        let own = openings_of(neutral);
        self.measure = Measure {
            per_unit: 1.0 / interocular(neutral),
            lids: [0, 1].map(|eye: usize| (self.openings[eye] / own[eye].max(LEAST_OPENING)).clamp(EYE_SCALES[0], EYE_SCALES[1])),
        };
    }

    /// Weights of a face in `[0, 1]`. `motions` are its bones', for where the irises look. Allocates nothing.
    pub(super) fn estimate(&mut self, points: &[DVec2], motions: &[Vec3]) -> Weights {
        self.measure.write(&self.neutral, points, &mut self.features);
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        for (shape, coefficients) in &self.map.rows {
            let weight = dot(coefficients, &self.features);
            weights[*shape] = ((weight - FAINTEST) / (1.0 - FAINTEST)).clamp(0.0, 1.0) as f32;
        }
        for eye in &self.eyes {
            let motion = motions[eye.bone].as_dvec3();
            let (down, out) = (motion.x / eye.range[1], eye.out * motion.y / eye.range[0]);
            for (shape, share) in eye.shapes.into_iter().zip([out, -out, down, -down]) {
                weights[shape] = share.clamp(0.0, 1.0) as f32;
            }
        }
        weights
    }
}

/// In a fixed order that leaves a processor's lanes to the compiler.
fn dot(a: &[f64; NUM_FEATURES], b: &[f64; NUM_FEATURES]) -> f64 {
    let mut lanes = [0.0; 4];
    for (a, b) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0) {
        for lane in 0..4 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    (lanes[0] + lanes[2]) + (lanes[1] + lanes[3])
}
const _: () = assert!(NUM_FEATURES.is_multiple_of(4));

fn looked_at() -> impl Iterator<Item = usize> {
    (FIRST_CHIN..=LAST_CHIN).chain(FIRST_BROW..NUM_IBUG)
}

fn interocular(points: &[DVec2]) -> f64 {
    points[RIGHT_EYE.corners.0].distance(points[LEFT_EYE.corners.1]).max(1e-6)
}

/// Right and left, fractions of the interocular distance.
fn openings_of(points: &[DVec2]) -> [f64; 2] {
    let opening = |eye: EyePoints| eye.lids.iter().map(|&(upper, lower)| points[upper].y - points[lower].y).sum::<f64>() * 0.5;
    [RIGHT_EYE, LEFT_EYE].map(|eye| opening(eye) / interocular(points))
}

fn eyes_of(character: &Character) -> Vec<Eye> {
    let index = |name: String| ArkitShape::from_name(&name).map(ArkitShape::index);
    let of_bone = |(bone, drive): (usize, &Drive)| {
        let &Drive::Eye { eye, range, .. } = drive else { return None };
        let (side, out) = if eye == Side::Left { ("Left", 1.0) } else { ("Right", -1.0) };
        let mut shapes = [0; 4];
        for (shape, way) in shapes.iter_mut().zip(["Out", "In", "Down", "Up"]) {
            *shape = index(format!("eyeLook{way}{side}"))?;
        }
        Some(Eye { bone, range: range.map(|angle| f64::from(angle).max(1e-3)), shapes, out })
    };
    character.bones.iter().map(|bone| &bone.drive).enumerate().filter_map(of_bone).collect()
}

impl Measure {
    fn write(&self, neutral: &[DVec2], points: &[DVec2], features: &mut [f64; NUM_FEATURES]) {
        let lids_of = |point: usize| match point {
            37 | 38 | 40 | 41 => self.lids[0],
            43 | 44 | 46 | 47 => self.lids[1],
            _ => 1.0,
        };
        for (pair, point) in features.as_chunks_mut::<2>().0.iter_mut().zip(looked_at()) {
            let moved = (points[point] - neutral[point]) * self.per_unit;
            *pair = [moved.x, moved.y * lids_of(point)];
        }
    }
}

/// One face: its weights and what the session makes of it.
struct Example {
    weights: [f64; NUM_ARKIT_SHAPES],
    features: Box<[f64; NUM_FEATURES]>,
}

impl ExpressionMap {
    /// Trains on the character's shapes; `None` where it has none or its landmarks span no face.
    pub fn fit(character: &Character) -> Option<Self> {
        let examples = examples(character)?;
        let gram = gram(&examples);
        let products = products(&examples);
        let tried = RIDGES.iter().filter_map(|&ridge| {
            let solution = Solution::new(&gram, &products, ridge)?;
            let errors = solution.leave_one_out(&examples);
            Some((ridge, errors.iter().sum::<f64>(), errors, solution))
        });
        let (ridge, _, errors, solution) = tried.fold(None, |best: Option<(f64, f64, _, _)>, one| match best {
            Some(best) if best.1 <= one.1 => Some(best),
            _ => Some(one),
        })?;
        let num = examples.len() as f64;
        let explained: [Option<f64>; NUM_ARKIT_SHAPES] = std::array::from_fn(|shape| {
            let mean = examples.iter().map(|example| example.weights[shape]).sum::<f64>() / num;
            let variance = examples.iter().map(|e| (e.weights[shape] - mean) * (e.weights[shape] - mean)).sum::<f64>();
            (variance > 0.0).then(|| 1.0 - errors[shape] / variance)
        });
        let (mut rows, mut shapes, mut total) = (Vec::new(), Vec::new(), 0.0);
        for shape in 0..NUM_ARKIT_SHAPES {
            let Some(own) = explained[shape] else { continue };
            let other = other_side(shape).and_then(|other| explained[other]).unwrap_or(own);
            let is_used = 0.5 * (own + other) >= LEAST_EXPLAINED;
            shapes.push(ShapeFit { shape: ARKIT_NAMES[shape], error: (errors[shape] / num).sqrt(), explained: own, is_used });
            total += errors[shape];
            if is_used {
                rows.push((shape, Box::new(solution.coefficients[shape])));
            }
        }
        let error = (total / (num * shapes.len().max(1) as f64)).sqrt();
        Some(Self { rows, report: FitReport { num_examples: examples.len(), ridge, error, shapes } })
    }

    /// As [`Self::fit`], which takes tens of milliseconds: sessions of one character share what the first of them made.
    pub(super) fn shared(character: &Arc<Character>) -> Option<Arc<Self>> {
        type Known = Vec<(Weak<Character>, Option<Arc<ExpressionMap>>)>;
        static KNOWN: Mutex<Known> = Mutex::new(Vec::new());
        // What a panic elsewhere left behind is whole: entries are pushed at the end.
        let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
        known.retain(|(of, _)| of.strong_count() > 0);
        if let Some((_, map)) = known.iter().find(|(of, _)| Weak::as_ptr(of) == Arc::as_ptr(character)) {
            return map.clone();
        }
        let map = Self::fit(character).map(Arc::new);
        known.push((Arc::downgrade(character), map.clone()));
        map
    }

    /// How well it does.
    pub fn report(&self) -> &FitReport {
        &self.report
    }
}

/// A fixed sequence of numbers (splitmix64, Steele and others 2014).
struct Sequence(u64);

impl Sequence {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// From 0 to below 1.
    fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Mean 0, standard deviation 1: a sum of twelve.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}

/// Every shape alone at a half and at one, then combinations, each from another side.
fn examples(character: &Character) -> Option<Vec<Example>> {
    let shapes: Vec<(usize, &[Vec3])> = character.shapes.iter().map(|own| (own.shape.index(), own.landmarks.as_slice())).collect();
    if shapes.is_empty() || shapes.iter().any(|(_, landmarks)| landmarks.len() != NUM_IBUG) {
        return None;
    }
    let mut sequence = Sequence(68);
    let stage = Stage::new(character)?;
    let frequent: Vec<usize> = FREQUENT
        .iter()
        .filter_map(|name| ArkitShape::from_name(name).map(ArkitShape::index))
        .filter(|shape| shapes.iter().any(|(own, _)| own == shape))
        .collect();
    let mut all = Vec::with_capacity(2 * shapes.len() + NUM_COMBINATIONS);
    for &(shape, _) in &shapes {
        for weight in [0.5, 1.0] {
            let mut weights = [0.0; NUM_ARKIT_SHAPES];
            weights[shape] = weight;
            all.extend(stage.show(&shapes, weights, &mut sequence));
        }
    }
    for _ in 0..NUM_COMBINATIONS {
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        for _ in 0..=sequence.next() % MOST_SHAPES {
            let shape = pick(&shapes, &frequent, &mut sequence);
            let (weight, is_paired) = (sequence.between(0.1, 1.0), sequence.unit() < PAIRED);
            weights[shape] = weight;
            if let Some(other) = other_side(shape).filter(|other| is_paired && shapes.iter().any(|(own, _)| own == other)) {
                weights[other] = weight;
            }
        }
        all.extend(stage.show(&shapes, weights, &mut sequence));
    }
    (!all.is_empty()).then_some(all)
}

fn pick(shapes: &[(usize, &[Vec3])], frequent: &[usize], sequence: &mut Sequence) -> usize {
    let (is_frequent, at) = (sequence.unit() < FREQUENCY, sequence.next());
    if is_frequent && !frequent.is_empty() {
        return frequent[(at % frequent.len() as u64) as usize];
    }
    shapes[(at % shapes.len() as u64) as usize].0
}

fn other_side(shape: usize) -> Option<usize> {
    let name = ARKIT_NAMES[shape];
    let other = match (name.strip_suffix("Left"), name.strip_suffix("Right")) {
        (Some(stem), _) => format!("{stem}Right"),
        (_, Some(stem)) => format!("{stem}Left"),
        _ => return None,
    };
    ArkitShape::from_name(&other).map(ArkitShape::index)
}

/// The character before a camera.
struct Stage {
    model: Vec<DVec3>,
    neutral: Vec<DVec2>,
    stable: Vec<(usize, f64)>,
    unit: f64,
    measure: Measure,
}

impl Stage {
    fn new(character: &Character) -> Option<Self> {
        let points = PointSet::new(character, &rhytid_shared::layout::Layout::Ibug68, false).ok()?;
        let neutral: Vec<DVec2> = points.model.iter().map(|point| point.truncate()).collect();
        let unit = f64::from(character.interocular());
        let measure = Measure { per_unit: 1.0 / interocular(&neutral), lids: [1.0; 2] };
        Some(Self { model: points.model, neutral, stable: points.stable, unit, measure })
    }

    /// A face of these weights from a random side. Nothing where no head pose fits.
    fn show(&self, shapes: &[(usize, &[Vec3])], weights: [f64; NUM_ARKIT_SHAPES], sequence: &mut Sequence) -> Option<Example> {
        let turn = DVec3::new(sequence.between(-MOST_PITCH, MOST_PITCH), sequence.between(-MOST_YAW, MOST_YAW), 0.0);
        // Half a turn about x takes head space (y up, z near) to the camera's (y down, z away).
        let rotation = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0) * rotation::from_vector(turn);
        let pose = Pose { rotation, translation: DVec3::new(0.0, 0.0, CAMERA_DISTANCE * self.unit) };
        let (matrix, noise) = (pose.matrix(), UNSTEADY / CAMERA_DISTANCE);
        let rays: Vec<DVec2> = (0..NUM_IBUG)
            .map(|i| {
                let moved = shapes.iter().fold(self.model[i], |sum, (shape, landmarks)| sum + landmarks[i].as_dvec3() * weights[*shape]);
                head_pose::project(&matrix, pose.translation, moved) + DVec2::new(sequence.normal(), sequence.normal()) * noise
            })
            .collect();
        let found = head_pose::refine(Some(pose), &self.model, &rays, &self.stable, self.unit).ok()?.pose;
        let matrix = found.matrix();
        let lifted: Vec<DVec2> =
            (0..NUM_IBUG).map(|i| head_pose::lift(&matrix, found.translation, rays[i], self.model[i].z).truncate()).collect();
        let mut features = Box::new([0.0; NUM_FEATURES]);
        self.measure.write(&self.neutral, &lifted, &mut features);
        Some(Example { weights, features })
    }
}

/// Lower triangle of `Xᵀ X`, row-major.
fn gram(examples: &[Example]) -> Vec<f64> {
    let mut gram = vec![0.0; NUM_FEATURES * NUM_FEATURES];
    for example in examples {
        let x = &*example.features;
        for row in 0..NUM_FEATURES {
            for (to, from) in gram[row * NUM_FEATURES..].iter_mut().zip(&x[..=row]) {
                *to += x[row] * from;
            }
        }
    }
    gram
}

/// `Xᵀ y` for each shape.
fn products(examples: &[Example]) -> Vec<[f64; NUM_FEATURES]> {
    let mut products = vec![[0.0; NUM_FEATURES]; NUM_ARKIT_SHAPES];
    for example in examples {
        for (product, weight) in products.iter_mut().zip(&example.weights).filter(|(_, weight)| **weight != 0.0) {
            for (to, x) in product.iter_mut().zip(&*example.features) {
                *to += x * weight;
            }
        }
    }
    products
}

/// `(Xᵀ X + λ) B = Xᵀ Y` by Cholesky factors.
struct Solution {
    /// Lower triangle, row-major.
    factor: Vec<f64>,
    /// For each shape.
    coefficients: Vec<[f64; NUM_FEATURES]>,
}

impl Solution {
    fn new(gram: &[f64], products: &[[f64; NUM_FEATURES]], ridge: f64) -> Option<Self> {
        const N: usize = NUM_FEATURES;
        let mut factor = gram.to_vec();
        for row in 0..N {
            factor[row * N + row] += ridge;
            for column in 0..=row {
                let before: f64 = (0..column).map(|at| factor[row * N + at] * factor[column * N + at]).sum();
                let rest = factor[row * N + column] - before;
                factor[row * N + column] = if row == column {
                    if rest.is_nan() || rest <= 0.0 {
                        return None;
                    }
                    rest.sqrt()
                } else {
                    rest / factor[column * N + column]
                };
            }
        }
        let mut solution = Self { factor, coefficients: products.to_vec() };
        let mut coefficients = std::mem::take(&mut solution.coefficients);
        for x in &mut coefficients {
            solution.forward(x);
            for row in (0..N).rev() {
                let after: f64 = (row + 1..N).map(|at| solution.factor[at * N + row] * x[at]).sum();
                x[row] = (x[row] - after) / solution.factor[row * N + row];
            }
        }
        solution.coefficients = coefficients;
        Some(solution)
    }

    /// `L z = x`, in place.
    fn forward(&self, x: &mut [f64; NUM_FEATURES]) {
        for row in 0..NUM_FEATURES {
            let line = &self.factor[row * NUM_FEATURES..][..row];
            let before: f64 = line.iter().zip(x.iter()).map(|(factor, x)| factor * x).sum();
            x[row] = (x[row] - before) / self.factor[row * NUM_FEATURES + row];
        }
    }

    /// For each shape the sum of squared errors that each example has when it is left out of the training: its residual over
    /// `1 - h`, where `h = xᵀ (Xᵀ X + λ)⁻¹ x` (Allen 1974, the PRESS statistic).
    fn leave_one_out(&self, examples: &[Example]) -> [f64; NUM_ARKIT_SHAPES] {
        let mut sums = [0.0; NUM_ARKIT_SHAPES];
        for example in examples {
            let mut z = *example.features;
            self.forward(&mut z);
            let share = 1.0 - z.iter().map(|z| z * z).sum::<f64>();
            for shape in 0..NUM_ARKIT_SHAPES {
                let error = (example.weights[shape] - dot(&self.coefficients[shape], &example.features)) / share;
                sums[shape] += error * error;
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    #[test]
    fn sessions_of_a_prepared_character_share_what_was_prepared() {
        let character = Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole"));
        crate::solve::prepare(&character, &crate::solve::SolveConfig::default());
        let [first, second] = [0, 1].map(|_| ExpressionMap::shared(&character).expect("it has shapes"));
        assert!(Arc::ptr_eq(&first, &second));
        let other = Arc::new(Character::clone(&character));
        assert!(!Arc::ptr_eq(&first, &ExpressionMap::shared(&other).expect("it has shapes")), "another character is another");
    }
}
