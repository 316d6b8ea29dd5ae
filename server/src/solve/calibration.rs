//! The search for a performer's neutral face.
//!
//! No frame waits for it: the first face serves as a provisional neutral. Once enough calm frames have been seen (or,
//! for people who are never calm, after a while the calmest half of them) their per-coordinate median is the neutral.
//! What begins with a smile is mended by looking again at all calm frames twice within the first ten seconds.

use super::config::CalibrationConfig;
use super::head_pose::Pose;
use super::rotation;
use glam::{DQuat, DVec2, DVec3};
use rhytid_shared::NUM_ARKIT_SHAPES;
use serde::{Deserialize, Serialize};

/// Samples are kept no denser than this, seconds: a 240 Hz tracker adds nothing a 30 Hz one does not.
const SPACING: f64 = 0.025;
/// Samples kept: ten seconds and a little at the densest.
const CAPACITY: usize = 420;
/// The automatic neutral is looked at again this long after the first face, seconds.
const SECOND_LOOKS: [f64; 2] = [5.0, 10.0];

/// A neutral face as it was calibrated: kept with a session so that a replay is exact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Sender's time at which it was reached, seconds.
    pub t: f64,
    /// Frames it is the median of.
    pub num_frames: usize,
    /// Root-mean-square landmark speed over those frames, interocular distances a second.
    pub speed: f64,
    /// True where the publisher asked for it.
    pub requested: bool,
    /// The performer's neutral points (68 for iBUG and what maps onto it, with two irises after them where the layout
    /// has them; the sender's own otherwise), x and y in head space, metres at the character's scale. Empty for senders
    /// of weights.
    pub points: Vec<[f64; 2]>,
    /// Head rotation at neutral, `camera_from_head` as a quaternion (x, y, z, w).
    pub head_rotation: [f64; 4],
    /// Where the character's head pivot was at neutral, metres in the camera's frame.
    pub head_position: [f64; 3],
    /// Expression weights at neutral, for senders of weights that asked to be calibrated.
    pub weights: Option<Vec<f32>>,
}

impl Calibration {
    /// The provisional neutral of the first frame.
    pub(super) fn provisional(t: f64, points: &[DVec2], pose: &Pose, pivot: DVec3) -> Self {
        let sample = Sample { t, speed: 0.0, rotation: pose.rotation, position: rotation::rotate(pose.rotation, pivot) + pose.translation };
        let mut neutral = median_of(&[sample], |_| points, &[0], t);
        neutral.num_frames = 0;
        neutral
    }

    /// The neutral of a sender of weights (or of bones, which need none).
    pub(super) fn of_weights(t: f64, weights: Option<&[f32; NUM_ARKIT_SHAPES]>, head_rotation: DQuat, head_position: DVec3) -> Self {
        Self {
            t,
            num_frames: 1,
            speed: 0.0,
            requested: true,
            points: Vec::new(),
            head_rotation: head_rotation.to_array(),
            head_position: head_position.to_array(),
            weights: weights.map(|weights| weights.to_vec()),
        }
    }

    /// Why this cannot be the calibration of a session with `num_points` points, if so.
    pub(super) fn problem(&self, num_points: usize) -> Option<String> {
        if !self.points.is_empty() && self.points.len() != num_points {
            return Some(format!("has {} points, expected {num_points}", self.points.len()));
        }
        if self.weights.as_ref().is_some_and(|weights| weights.len() != NUM_ARKIT_SHAPES) {
            return Some(format!("has other than {NUM_ARKIT_SHAPES} weights"));
        }
        let numbers = self.points.iter().flatten().chain(&self.head_rotation).chain(&self.head_position);
        let are_finite = numbers.copied().all(f64::is_finite) && self.weights.iter().flatten().all(|weight| weight.is_finite());
        let norm = DQuat::from_array(self.head_rotation).length();
        (!are_finite || (norm - 1.0).abs() > 1e-3).then(|| "holds values that are not finite or a rotation that is none".to_owned())
    }
}

/// What is kept of a frame besides its points.
#[derive(Debug, Clone, Copy)]
struct Sample {
    t: f64,
    /// Root mean square over the points, interocular distances a second.
    speed: f64,
    rotation: DQuat,
    position: DVec3,
}

/// How far a face is from what neutral faces look like, in interocular distances; `None` where the layout cannot tell.
pub(super) type Strain = fn(&[DVec2]) -> f64;

/// Collects frames and gives neutrals.
pub(super) struct Calibrator {
    config: CalibrationConfig,
    num_points: usize,
    strain: Option<Strain>,
    /// Interocular distance, metres.
    unit: f64,
    /// A ring of samples and, at the same places, `num_points` points each.
    samples: Vec<Sample>,
    points: Vec<DVec2>,
    next: usize,
    previous: Vec<DVec2>,
    previous_t: Option<f64>,
    started_at: Option<f64>,
    /// Automatic neutrals reached; one more than the second looks taken.
    num_reached: usize,
    is_automatic: bool,
    wanted_since: Option<f64>,
}

impl Calibrator {
    pub(super) fn new(config: &CalibrationConfig, num_points: usize, unit: f64, strain: Option<Strain>) -> Self {
        Self {
            config: config.clone(),
            num_points,
            strain,
            unit,
            samples: Vec::with_capacity(CAPACITY),
            points: Vec::with_capacity(CAPACITY * num_points),
            next: 0,
            previous: vec![DVec2::ZERO; num_points],
            previous_t: None,
            started_at: None,
            num_reached: 0,
            is_automatic: true,
            wanted_since: None,
        }
    }

    /// No automatic search: a neutral has been given.
    pub(super) fn stop(&mut self) {
        self.is_automatic = false;
    }

    /// Takes one frame's points in head space. `pivot` is the character's head pivot.
    pub(super) fn observe(&mut self, t: f64, points: &[DVec2], pose: &Pose, pivot: DVec3) {
        self.started_at.get_or_insert(t);
        let speed = self.previous_t.map(|previous| {
            let sum: f64 = points.iter().zip(&self.previous).map(|(now, before)| (*now - *before).length_squared()).sum();
            (sum / points.len() as f64).sqrt() / ((t - previous) * self.unit)
        });
        self.previous.copy_from_slice(points);
        self.previous_t = Some(t);
        if self.newest().is_some_and(|newest| t - newest.t < SPACING) {
            return;
        }
        let sample = Sample {
            t,
            // The first frame's speed is unknown: last to be chosen.
            speed: speed.unwrap_or(f64::MAX),
            rotation: pose.rotation,
            position: rotation::rotate(pose.rotation, pivot) + pose.translation,
        };
        if self.samples.len() < CAPACITY {
            self.samples.push(sample);
            self.points.extend_from_slice(points);
        } else {
            self.samples[self.next] = sample;
            let at = self.next * self.num_points;
            self.points[at..at + self.num_points].copy_from_slice(points);
        }
        self.next = (self.next + 1) % CAPACITY;
    }

    /// The face was lost: speeds across the gap mean nothing.
    pub(super) fn interrupt(&mut self) {
        self.previous_t = None;
    }

    fn newest(&self) -> Option<&Sample> {
        self.samples.get((self.next + CAPACITY - 1) % CAPACITY)
    }

    /// The publisher asks for the neutral now. Given at once where frames of the last moments are there, else as soon as
    /// they are.
    pub(super) fn request(&mut self, t: f64) -> Option<Calibration> {
        let found = self.look_back(t);
        if found.is_none() {
            self.wanted_since = Some(t);
        }
        found
    }

    fn look_back(&mut self, t: f64) -> Option<Calibration> {
        let since = t - self.config.look_back;
        let recent: Vec<usize> = (0..self.samples.len()).filter(|&i| self.samples[i].t >= since).collect();
        if recent.is_empty() {
            return None;
        }
        let chosen = self.calmest_half(recent);
        self.is_automatic = false;
        self.wanted_since = None;
        let mut calibration = median_of(&self.samples, |i| self.points_at(i), &chosen, t);
        calibration.requested = true;
        Some(calibration)
    }

    /// A neutral that has just been reached. Call once a frame, after [`Self::observe`].
    pub(super) fn poll(&mut self, t: f64) -> Option<Calibration> {
        if let Some(since) = self.wanted_since
            && t - since >= self.config.look_back
        {
            return self.look_back(t);
        }
        if !self.is_automatic {
            return None;
        }
        let elapsed = t - self.started_at?;
        let is_due = match self.num_reached {
            0 => {
                elapsed >= self.config.patience
                    || self.samples.iter().filter(|s| s.speed < self.config.calm_speed).count() >= self.config.min_frames
            }
            reached => elapsed >= SECOND_LOOKS[reached - 1],
        };
        if !is_due {
            return None;
        }
        self.num_reached += 1;
        self.is_automatic = self.num_reached <= SECOND_LOOKS.len();
        let calm: Vec<usize> = (0..self.samples.len()).filter(|&i| self.samples[i].speed < self.config.calm_speed).collect();
        let calm = if calm.len() >= self.config.min_frames { calm } else { self.calmest_half((0..self.samples.len()).collect()) };
        let chosen = self.least_strained_half(calm);
        (!chosen.is_empty()).then(|| median_of(&self.samples, |i| self.points_at(i), &chosen, t))
    }

    /// True for the first neutral of the session's own search; later ones only refine it.
    pub(super) fn is_first(&self) -> bool {
        self.num_reached <= 1
    }

    fn points_at(&self, i: usize) -> &[DVec2] {
        &self.points[i * self.num_points..(i + 1) * self.num_points]
    }

    fn calmest_half(&self, mut of: Vec<usize>) -> Vec<usize> {
        of.sort_by(|&a, &b| self.samples[a].speed.total_cmp(&self.samples[b].speed).then(a.cmp(&b)));
        of.truncate(of.len().div_ceil(2));
        of
    }

    fn least_strained_half(&self, of: Vec<usize>) -> Vec<usize> {
        let Some(strain) = self.strain else { return of };
        let mut strained: Vec<(f64, usize)> = of.into_iter().map(|i| (strain(self.points_at(i)), i)).collect();
        strained.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        strained.truncate(strained.len().div_ceil(2));
        strained.into_iter().map(|(_, i)| i).collect()
    }
}

/// Per-coordinate median of the chosen samples.
fn median_of<'a>(samples: &[Sample], points_at: impl Fn(usize) -> &'a [DVec2], chosen: &[usize], t: f64) -> Calibration {
    let mut values = Vec::with_capacity(chosen.len());
    let mut median = |value_at: &dyn Fn(usize) -> f64| {
        values.clear();
        values.extend(chosen.iter().map(|&i| value_at(i)));
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        if values.len() % 2 == 1 { values[middle] } else { 0.5 * (values[middle - 1] + values[middle]) }
    };
    let points = (0..points_at(chosen[0]).len()).map(|p| [median(&|i| points_at(i)[p].x), median(&|i| points_at(i)[p].y)]).collect();
    let first = samples[chosen[0]].rotation;
    let turn = [0, 1, 2].map(|axis| median(&|i| rotation::to_vector(first.inverse() * samples[i].rotation)[axis]));
    let position = [0, 1, 2].map(|axis| median(&|i| samples[i].position[axis]));
    let known: Vec<f64> = chosen.iter().map(|&i| samples[i].speed).filter(|speed| *speed < f64::MAX).collect();
    let square: f64 = known.iter().map(|speed| speed * speed).sum();
    Calibration {
        t,
        num_frames: chosen.len(),
        speed: (square / known.len().max(1) as f64).sqrt(),
        requested: false,
        points,
        head_rotation: (first * rotation::from_vector(DVec3::from(turn))).normalize().to_array(),
        head_position: position,
        weights: None,
    }
}

/// Strain of iBUG's 68 points: open lips, corners pulled out, up or down, shut eyes. The proportions are those of
/// neutral faces in general (outer eye corners one apart: lips closed, mouth 0.56 wide, corners about level with the line of the lips, which differs most between people).
pub(super) fn ibug_strain(points: &[DVec2]) -> f64 {
    let unit = points[36].distance(points[45]);
    let gap = (points[62].y - points[66].y).abs();
    let width = points[48].distance(points[54]);
    let corner_height = 0.5 * (points[48].y + points[54].y) - 0.5 * (points[51].y + points[57].y);
    let opening = |upper: usize, lower: usize| points[upper].y - points[lower].y;
    let eye_width = points[36].distance(points[39]) + points[42].distance(points[45]);
    let openness = (opening(37, 41) + opening(38, 40) + opening(43, 47) + opening(44, 46)) / (2.0 * eye_width);
    let shut = (0.2 - openness).max(0.0);
    (gap + (width - 0.56 * unit).abs() + 0.5 * corner_height.abs()) / unit + shut
}
