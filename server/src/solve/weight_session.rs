//! One sender's expression weights through a session: mirroring, neutral, smoothing, bones.

use super::config::{OneEuroConfig, SolveConfig};
use super::easing::FaceState;
use super::error::SolveError;
use super::filter::OneEuroBank;
use super::mix::group_of_shape;
use super::ranges::stretched;
use super::rotation;
use super::weights_to_bones::{WeightRig, Weights};
use glam::{DQuat, DVec3};
use rhytid_shared::limits::MAX_HEAD_TRAVEL;
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Calibration, ChannelGroup, Character, HeadPose, NUM_ARKIT_SHAPES};

/// Largest weight a tracker may give: some overshoot on strong faces.
const LARGEST_WEIGHT: f32 = 1.2;
/// Largest weight a neutral may claim: what is neutral shall still be reachable from both sides.
const LARGEST_NEUTRAL: f32 = 0.5;

pub(super) struct WeightSession {
    rig: WeightRig,
    /// Brows, eyes and the rest, each with its shapes.
    banks: [(OneEuroBank, Vec<usize>); 3],
    samples: Vec<f64>,
    /// The shape each shape is read from: itself, or its partner on the other side.
    source_of: Option<Box<[usize; NUM_ARKIT_SHAPES]>>,
    neutral: Box<Weights>,
    last_t: Option<f64>,
    /// As the sender gave them last.
    last: Option<Box<Weights>>,
    /// Smoothed, about the neutral, before they are stretched.
    seen: Box<Weights>,
    /// What each weight is stretched by.
    factors: Box<Weights>,
}

impl WeightSession {
    pub(super) fn new(character: &Character, config: &SolveConfig) -> Self {
        Self {
            rig: WeightRig::new(character),
            banks: [&[ChannelGroup::Brows][..], &[ChannelGroup::Lids, ChannelGroup::Gaze], &[ChannelGroup::Mouth, ChannelGroup::Head]].map(
                |groups| {
                    let shapes: Vec<usize> = (0..NUM_ARKIT_SHAPES).filter(|&i| groups.contains(&group_of_shape(ARKIT_NAMES[i]))).collect();
                    (OneEuroBank::new(config.filter.weights, shapes.len(), 1.0), shapes)
                },
            ),
            samples: Vec::with_capacity(NUM_ARKIT_SHAPES),
            source_of: config.mirror.then(|| Box::new(std::array::from_fn(other_side))),
            neutral: Box::new([0.0; NUM_ARKIT_SHAPES]),
            last_t: None,
            last: None,
            seen: Box::new([0.0; NUM_ARKIT_SHAPES]),
            factors: Box::new([1.0; NUM_ARKIT_SHAPES]),
        }
    }

    /// What moves the bones.
    pub(super) fn rig(&self) -> &WeightRig {
        &self.rig
    }

    /// Stretches each weight from the next frame on.
    pub(super) fn set_factors(&mut self, factors: &Weights) {
        *self.factors = *factors;
    }

    /// The last frame's weights, smoothed, about the neutral, before they are stretched.
    pub(super) fn seen(&self) -> &Weights {
        &self.seen
    }

    pub(super) fn restore(&mut self, neutral: &[f32]) {
        for (to, from) in self.neutral.iter_mut().zip(neutral) {
            *to = from.clamp(0.0, LARGEST_NEUTRAL);
        }
    }

    /// Takes the last weights as neutral, if there are any, and gives them.
    pub(super) fn calibrate(&mut self) -> Option<&Weights> {
        let last = self.last.as_deref()?;
        for (to, from) in self.neutral.iter_mut().zip(last) {
            *to = from.clamp(0.0, LARGEST_NEUTRAL);
        }
        Some(&self.neutral)
    }

    /// Delays that the smoothing adds at present, seconds: brows, eyes, the rest.
    pub(super) fn added_delays(&self) -> [f64; 3] {
        [0, 1, 2].map(|group| self.banks[group].0.delay())
    }

    /// Smooths brows, eyes and the rest with other parameters from the next frame on.
    pub(super) fn set_filters(&mut self, filters: [OneEuroConfig; 3]) {
        for ((bank, _), filter) in self.banks.iter_mut().zip(filters) {
            bank.set_config(filter);
        }
    }

    /// Swaps the sides of the shapes that trackers disagree about, and of all where `mirror` says so.
    pub(super) fn set_sides(&mut self, mirror: bool, swap_jaw: bool, swap_mouth: bool) {
        let source = |shape: usize| {
            let is_swapped = match ARKIT_NAMES[shape] {
                "jawLeft" | "jawRight" => mirror != swap_jaw,
                "mouthLeft" | "mouthRight" => mirror != swap_mouth,
                _ => mirror,
            };
            if is_swapped { other_side(shape) } else { shape }
        };
        self.source_of = (mirror || swap_jaw || swap_mouth).then(|| Box::new(std::array::from_fn(source)));
    }

    pub(super) fn solve(&mut self, t: f64, weights: &Weights, state: &mut FaceState) -> Result<(), SolveError> {
        if let Some(index) = weights.iter().position(|weight| !weight.is_finite()) {
            return Err(SolveError::Value { field: "weights", index, got: weights[index], expected: "0 to 1.2" });
        }
        let seen: Weights = std::array::from_fn(|shape| {
            let source = self.source_of.as_ref().map_or(shape, |table| table[shape]);
            weights[source].clamp(0.0, LARGEST_WEIGHT)
        });
        let dt = self.last_t.map_or(f64::INFINITY, |last| t - last);
        let mut smoothed: Weights = [0.0; NUM_ARKIT_SHAPES];
        for (bank, shapes) in &mut self.banks {
            self.samples.clear();
            self.samples.extend(shapes.iter().map(|&shape| {
                let neutral = self.neutral[shape];
                f64::from(((seen[shape] - neutral) / (1.0 - neutral)).max(0.0))
            }));
            for (&shape, value) in shapes.iter().zip(bank.update(&self.samples, dt)) {
                smoothed[shape] = *value as f32;
            }
        }
        match &mut self.last {
            Some(last) => **last = seen,
            None => self.last = Some(Box::new(seen)),
        }
        self.last_t = Some(t);
        *self.seen = smoothed;
        for (weight, factor) in smoothed.iter_mut().zip(self.factors.iter()) {
            *weight = stretched(*weight, *factor, 1.0);
        }
        self.rig.solve(&smoothed, &mut state.motions);
        state.weights = Some(smoothed.map(|weight| weight.clamp(0.0, 1.0)));
        state.is_placed = false;
        Ok(())
    }
}

/// The shape of the same name on the other side.
fn other_side(shape: usize) -> usize {
    let name = ARKIT_NAMES[shape];
    let other = match (name.strip_suffix("Left"), name.strip_suffix("Right")) {
        (Some(stem), _) => format!("{stem}Right"),
        (_, Some(stem)) => format!("{stem}Left"),
        _ => return shape,
    };
    ArkitShape::from_name(&other).map_or(shape, ArkitShape::index)
}

/// The head as its sender gives it, against the neutral that was asked for.
#[derive(Debug, Clone)]
pub(super) struct SentHead {
    mirror: bool,
    neutral_rotation: DQuat,
    neutral_position: DVec3,
    last: Option<(DQuat, DVec3)>,
    /// The next head looks straight ahead.
    is_centre_wanted: bool,
}

impl SentHead {
    pub(super) fn new(mirror: bool) -> Self {
        Self { mirror, neutral_rotation: DQuat::IDENTITY, neutral_position: DVec3::ZERO, last: None, is_centre_wanted: false }
    }

    pub(super) fn restore(&mut self, calibration: &Calibration) {
        self.neutral_rotation = DQuat::from_array(calibration.head_rotation).normalize();
        self.neutral_position = DVec3::from(calibration.head_position);
    }

    /// Takes the last head as neutral and gives it.
    pub(super) fn calibrate(&mut self) -> (DQuat, DVec3) {
        if let Some((rotation, position)) = self.last {
            (self.neutral_rotation, self.neutral_position) = (rotation, position);
        }
        (self.neutral_rotation, self.neutral_position)
    }

    /// Takes the next head as neutral.
    pub(super) fn recentre_next(&mut self) {
        self.is_centre_wanted = true;
    }

    /// Checks a head before anything is changed by its frame.
    pub(super) fn check(head: Option<&HeadPose>) -> Result<(), SolveError> {
        let Some(head) = head else { return Ok(()) };
        let norm = head.rotation.as_dquat().length();
        if norm.is_nan() || (norm - 1.0).abs() > 0.1 {
            return Err(SolveError::Value { field: "head.rotation", index: 0, got: norm as f32, expected: "of length 1" });
        }
        match head.position.to_array().into_iter().enumerate().find(|(_, value)| !(-100.0..=100.0).contains(value)) {
            Some((index, got)) => Err(SolveError::Value { field: "head.position", index, got, expected: "within ±100 m" }),
            None => Ok(()),
        }
    }

    pub(super) fn write(&mut self, head: Option<&HeadPose>, state: &mut FaceState) {
        let Some(head) = head else {
            state.head = [0.0; 6];
            return;
        };
        let (mut q, mut p) = (head.rotation.as_dquat().normalize(), head.position.as_dvec3());
        if self.mirror {
            q = DQuat::from_xyzw(q.x, -q.y, -q.z, q.w);
            p.x = -p.x;
        }
        self.last = Some((q, p));
        if std::mem::take(&mut self.is_centre_wanted) {
            self.calibrate();
        }
        let back = self.neutral_rotation.inverse();
        let turn = rotation::to_vector(back * q);
        let shift = rotation::rotate(back, p - self.neutral_position);
        let farthest = f64::from(MAX_HEAD_TRAVEL);
        for axis in 0..3 {
            state.head[axis] = turn[axis];
            state.head[3 + axis] = shift[axis].clamp(-farthest, farthest);
        }
    }
}
