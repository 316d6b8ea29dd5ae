//! One sender's expression weights through a session: mirroring, neutral, smoothing, bones.

use super::calibration::Calibration;
use super::config::SolveConfig;
use super::easing::FaceState;
use super::error::SolveError;
use super::filter::OneEuroBank;
use super::rotation;
use super::weights_to_bones::{WeightRig, Weights};
use glam::{DQuat, DVec3};
use rhytid_shared::limits::MAX_HEAD_TRAVEL;
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, HeadPose, NUM_ARKIT_SHAPES};

/// Largest weight a tracker may give: some overshoot on strong faces.
const LARGEST_WEIGHT: f32 = 1.2;
/// Largest weight a neutral may claim: what is neutral shall still be reachable from both sides.
const LARGEST_NEUTRAL: f32 = 0.5;

pub(super) struct WeightSession {
    rig: WeightRig,
    bank: OneEuroBank,
    samples: Box<[f64; NUM_ARKIT_SHAPES]>,
    /// The shape each shape is read from: itself, or its partner on the other side.
    source_of: Option<Box<[usize; NUM_ARKIT_SHAPES]>>,
    neutral: Box<Weights>,
    last_t: Option<f64>,
    /// As the sender gave them last.
    last: Option<Box<Weights>>,
}

impl WeightSession {
    pub(super) fn new(character: &Character, config: &SolveConfig) -> Self {
        Self {
            rig: WeightRig::new(character),
            bank: OneEuroBank::new(config.filter.weights, NUM_ARKIT_SHAPES, 1.0),
            samples: Box::new([0.0; NUM_ARKIT_SHAPES]),
            source_of: config.mirror.then(|| Box::new(std::array::from_fn(other_side))),
            neutral: Box::new([0.0; NUM_ARKIT_SHAPES]),
            last_t: None,
            last: None,
        }
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

    /// Delay that the smoothing adds at present, seconds.
    pub(super) fn added_delay(&self) -> f64 {
        self.bank.delay()
    }

    pub(super) fn solve(&mut self, t: f64, weights: &Weights, state: &mut FaceState) -> Result<(), SolveError> {
        if let Some(index) = weights.iter().position(|weight| !weight.is_finite()) {
            return Err(SolveError::Value { field: "weights", index, got: weights[index], expected: "0 to 1.2" });
        }
        let seen: Weights = std::array::from_fn(|shape| {
            let source = self.source_of.as_ref().map_or(shape, |table| table[shape]);
            weights[source].clamp(0.0, LARGEST_WEIGHT)
        });
        for shape in 0..NUM_ARKIT_SHAPES {
            let neutral = self.neutral[shape];
            self.samples[shape] = f64::from(((seen[shape] - neutral) / (1.0 - neutral)).max(0.0));
        }
        let dt = self.last_t.map_or(f64::INFINITY, |last| t - last);
        let smoothed = self.bank.update(&self.samples[..], dt);
        let smoothed: Weights = std::array::from_fn(|shape| smoothed[shape] as f32);
        match &mut self.last {
            Some(last) => **last = seen,
            None => self.last = Some(Box::new(seen)),
        }
        self.last_t = Some(t);
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
}

impl SentHead {
    pub(super) fn new(mirror: bool) -> Self {
        Self { mirror, neutral_rotation: DQuat::IDENTITY, neutral_position: DVec3::ZERO, last: None }
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
