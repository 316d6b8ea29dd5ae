//! The search for a performer's neutral face.
//!
//! No frame waits for it: the first face serves as a provisional neutral. Once enough calm frames have been seen (or,
//! for people who are never calm, after a while the calmest half of them) their per-coordinate median is the neutral.
//! What begins with a smile is mended by looking again, at growing intervals, at the calm frames of the whole session;
//! the same looks refine the depth of the performer's face.

use super::config::CalibrationConfig;
use super::depth::{self, Shape};
use super::head_pose::{self, Pose};
use super::rotation;
use glam::{DQuat, DVec2, DVec3};
use rhytid_shared::{Calibration, NUM_ARKIT_SHAPES};

/// Frames are kept no denser than this, seconds, at first: a 240 Hz tracker adds nothing a 30 Hz one does not.
const SPACING: f64 = 0.025;
/// Frames kept of the whole session; when they are full, every other one goes and the spacing doubles.
const HISTORY: usize = 256;
/// The last frames, for a neutral that is asked for.
const RECENT: usize = 16;
/// Frames a look works on: with these it takes 2 ms.
const MOST_WORKED: usize = 96;
/// A neutral that is asked for is taken from at least this many frames; it waits for them.
const FEWEST_ASKED: usize = 3;
/// A face has no point farther than this from the origin of head space, metres.
const FARTHEST: f64 = 1.0;
/// When the session is looked at again, seconds of a face seen.
const LOOKS: [f64; 5] = [5.0, 10.0, 20.0, 40.0, 80.0];

/// The neutral of a sender of weights (or of bones, which need none).
pub(super) fn of_weights(t: f64, weights: Option<&[f32; NUM_ARKIT_SHAPES]>, head_rotation: DQuat, head_position: DVec3) -> Calibration {
    Calibration {
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

/// Why `calibration` cannot be that of a session with `num_points` points, if so. `pivot` is the character's head's.
pub(super) fn problem(calibration: &Calibration, num_points: usize, pivot: DVec3) -> Option<String> {
    if !calibration.points.is_empty() && calibration.points.len() != num_points {
        return Some(format!("has {} points, expected {num_points}", calibration.points.len()));
    }
    if calibration.weights.as_ref().is_some_and(|weights| weights.len() != NUM_ARKIT_SHAPES) {
        return Some(format!("has other than {NUM_ARKIT_SHAPES} weights"));
    }
    let numbers = calibration.points.iter().flatten().chain(&calibration.head_rotation).chain(&calibration.head_position);
    let are_finite = numbers.copied().all(f64::is_finite) && calibration.weights.iter().flatten().all(|weight| weight.is_finite());
    let rotation = DQuat::from_array(calibration.head_rotation);
    if !are_finite || (rotation.length() - 1.0).abs() > 1e-3 {
        return Some("holds values that are not finite or a rotation that is none".to_owned());
    }
    if let Some(i) = calibration.points.iter().position(|point| point.iter().any(|value| value.abs() > FARTHEST)) {
        return Some(format!("has points[{i}] at {:?}, expected within ±{FARTHEST} m of the origin of head space", calibration.points[i]));
    }
    let pose = Pose { rotation, translation: DVec3::from(calibration.head_position) - rotation::rotate(rotation, pivot) };
    let matrix = pose.matrix();
    let is_before = |point: &[f64; 3]| (matrix * DVec3::from(*point) + pose.translation).z > 0.0;
    (!calibration.points.iter().all(is_before))
        .then(|| format!("has the head at {:?}, expected all of it before the camera", calibration.head_position))
}

/// What is kept of a frame besides its rays.
#[derive(Debug, Clone, Copy)]
struct Sample {
    t: f64,
    /// Root mean square over the points, interocular distances a second.
    speed: f64,
    strain: f64,
    pose: Pose,
}

/// Frames with the rays of all their points.
struct Frames {
    num_points: usize,
    samples: Vec<Sample>,
    /// `num_points` for each sample.
    rays: Vec<DVec2>,
}

impl Frames {
    fn new(capacity: usize, num_points: usize) -> Self {
        Self { num_points, samples: Vec::with_capacity(capacity), rays: Vec::with_capacity(capacity * num_points) }
    }

    fn push(&mut self, sample: Sample, rays: &[DVec2]) {
        self.samples.push(sample);
        self.rays.extend_from_slice(rays);
    }

    fn rays_of(&self, i: usize) -> &[DVec2] {
        &self.rays[i * self.num_points..(i + 1) * self.num_points]
    }

    fn replace(&mut self, at: usize, sample: Sample, rays: &[DVec2]) {
        self.samples[at] = sample;
        self.rays[at * self.num_points..(at + 1) * self.num_points].copy_from_slice(rays);
    }

    /// Drops every other one.
    fn thin_out(&mut self) {
        let kept = self.samples.len().div_ceil(2);
        for i in 1..kept {
            self.samples[i] = self.samples[2 * i];
            self.rays.copy_within(2 * i * self.num_points..(2 * i + 1) * self.num_points, i * self.num_points);
        }
        self.samples.truncate(kept);
        self.rays.truncate(kept * self.num_points);
    }
}

/// How far a face is from what neutral faces look like, in interocular distances.
pub(super) type Strain = fn(&[DVec2]) -> f64;

/// Collects frames and gives neutrals.
pub(super) struct Calibrator {
    config: CalibrationConfig,
    strain: Option<Strain>,
    history: Frames,
    spacing: f64,
    /// A ring; `oldest` is the place to be written next once it is full.
    recent: Frames,
    oldest: usize,
    recent_t: f64,
    previous: Vec<DVec2>,
    previous_t: Option<f64>,
    started_at: Option<f64>,
    /// Seconds without a face since then.
    lost_for: f64,
    /// Time of the last face.
    seen_t: Option<f64>,
    num_calm: usize,
    num_looks: usize,
    /// Automatic: the neutral is searched for. Otherwise it has been given and only its depth is refined.
    is_automatic: bool,
    has_neutral: bool,
    wanted: Option<Wanted>,
    /// Not before this time is looked again: the frames at hand gave no neutral.
    next_try: f64,
}

/// A neutral that the publisher waits for.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    /// Time of the first face after it was asked for.
    since: Option<f64>,
}

/// A neutral that has been reached.
#[derive(Debug, Clone)]
pub(super) struct Found {
    pub(super) calibration: Calibration,
    /// It is one to tell the publisher of: the first, or one that was asked for. The others refine it.
    pub(super) is_awaited: bool,
}

impl Calibrator {
    pub(super) fn new(config: &CalibrationConfig, num_points: usize, strain: Option<Strain>) -> Self {
        Self {
            config: config.clone(),
            strain,
            history: Frames::new(HISTORY, num_points),
            spacing: SPACING,
            recent: Frames::new(RECENT, num_points),
            oldest: 0,
            recent_t: f64::NEG_INFINITY,
            previous: vec![DVec2::ZERO; num_points],
            previous_t: None,
            started_at: None,
            lost_for: 0.0,
            seen_t: None,
            num_calm: 0,
            num_looks: 0,
            is_automatic: true,
            has_neutral: false,
            wanted: None,
            next_try: f64::NEG_INFINITY,
        }
    }

    /// No search of its own: a neutral has been given.
    pub(super) fn stop(&mut self) {
        (self.is_automatic, self.has_neutral) = (false, true);
        self.num_looks = LOOKS.len();
    }

    /// Takes one frame: its rays, the pose they were placed with and the points they became in head space.
    pub(super) fn observe(&mut self, t: f64, rays: &[DVec2], pose: &Pose, points: &[DVec2], unit: f64) {
        self.started_at.get_or_insert(t);
        if self.previous_t.is_none() {
            self.lost_for += self.seen_t.map_or(0.0, |seen| t - seen);
        }
        self.seen_t = Some(t);
        if let Some(wanted) = &mut self.wanted {
            wanted.since.get_or_insert(t);
        }
        let speed = self.previous_t.map(|previous| {
            let sum: f64 = points.iter().zip(&self.previous).map(|(now, before)| (*now - *before).length_squared()).sum();
            (sum / points.len() as f64).sqrt() / ((t - previous) * unit)
        });
        self.previous.copy_from_slice(points);
        self.previous_t = Some(t);
        if t - self.recent_t < SPACING {
            return;
        }
        let is_history_due = self.num_looks < LOOKS.len() && self.history.samples.last().is_none_or(|newest| t - newest.t >= self.spacing);
        let sample = Sample {
            t,
            // The first frame's speed is unknown: last to be chosen.
            speed: speed.unwrap_or(f64::MAX),
            strain: self.strain.map_or(0.0, |strain| strain(points)),
            pose: *pose,
        };
        if self.recent.samples.len() < RECENT {
            self.recent.push(sample, rays);
        } else {
            self.recent.replace(self.oldest, sample, rays);
            self.oldest = (self.oldest + 1) % RECENT;
        }
        self.recent_t = t;
        if is_history_due {
            if self.history.samples.len() == HISTORY {
                self.history.thin_out();
                self.spacing *= 2.0;
            }
            self.num_calm += usize::from(sample.speed < self.config.calm_speed);
            self.history.push(sample, rays);
        }
    }

    /// The face was lost: speeds across the gap mean nothing.
    pub(super) fn interrupt(&mut self) {
        self.previous_t = None;
    }

    /// The publisher asks for the neutral now. Given at once where frames of the last moments are there, else as soon as
    /// they are: it is owed until [`Self::accepted`].
    pub(super) fn request(&mut self, t: f64, shape: &mut Shape<'_>) -> Option<Found> {
        self.wanted = Some(Wanted { since: None });
        self.look_back(t, FEWEST_ASKED, shape)
    }

    /// Nobody waits for a neutral any more.
    pub(super) fn withdraw(&mut self) {
        self.wanted = None;
    }

    /// The neutral that was given is in use.
    pub(super) fn accepted(&mut self, is_requested: bool) {
        self.has_neutral = true;
        if is_requested {
            self.is_automatic = false;
            self.wanted = None;
        }
    }

    /// The neutral that was given at `t` was none: another is looked for among the frames to come.
    pub(super) fn refused(&mut self, t: f64, is_requested: bool) {
        self.next_try = t + self.config.look_back;
        if is_requested {
            self.wanted = Some(Wanted { since: None });
        }
    }

    fn look_back(&self, t: f64, fewest: usize, shape: &mut Shape<'_>) -> Option<Found> {
        let since = t - self.config.look_back;
        let samples = &self.recent.samples;
        let recent: Vec<usize> = (0..samples.len()).filter(|&i| samples[i].t >= since).collect();
        if recent.len() < fewest {
            return None;
        }
        let mut calibration = median_of(&self.recent, &calmest_half(samples, recent), shape, t)?;
        calibration.requested = true;
        Some(Found { calibration, is_awaited: true })
    }

    /// A neutral that has just been reached, to be answered by [`Self::accepted`] or [`Self::refused`]. Call once a frame,
    /// after [`Self::observe`]. `current` is the neutral in use.
    pub(super) fn poll(&mut self, t: f64, shape: &mut Shape<'_>, current: &Calibration) -> Option<Found> {
        if let Some(Wanted { since: Some(since) }) = self.wanted
            && t - since >= self.config.look_back
        {
            // A slow tracker has no more frames than these.
            let found = self.look_back(t, 1, shape);
            if found.is_none() {
                self.refused(t, true);
            }
            return found;
        }
        let elapsed = t - self.started_at? - self.lost_for;
        let is_due = if self.has_neutral {
            LOOKS.get(self.num_looks).is_some_and(|look| elapsed >= *look)
        } else {
            elapsed >= self.config.patience || self.num_calm >= self.config.min_frames
        };
        if !is_due || t < self.next_try {
            return None;
        }
        let is_awaited = !self.has_neutral;
        self.num_looks += usize::from(self.has_neutral);
        // Strong expressions would pass for depth.
        let relaxed = least_strained_half(&self.history.samples, (0..self.history.samples.len()).collect());
        let stride = relaxed.len().div_ceil(MOST_WORKED).max(1);
        let worked = relaxed.iter().step_by(stride).map(|&i| (self.history.samples[i].pose, self.history.rays_of(i)));
        depth::refine(shape, worked);
        if !self.is_automatic {
            return Some(Found { calibration: with_depth(current, shape, t), is_awaited });
        }
        let samples = &self.history.samples;
        let calm: Vec<usize> = (0..samples.len()).filter(|&i| samples[i].speed < self.config.calm_speed).collect();
        let calm = if calm.len() >= self.config.min_frames { calm } else { calmest_half(samples, (0..samples.len()).collect()) };
        let chosen = if self.strain.is_some() { least_strained_half(samples, calm) } else { calm };
        let found = median_of(&self.history, &chosen, shape, t).map(|calibration| Found { calibration, is_awaited });
        if found.is_none() {
            self.refused(t, false);
        }
        found
    }
}

fn calmest_half(samples: &[Sample], mut of: Vec<usize>) -> Vec<usize> {
    of.sort_by(|&a, &b| samples[a].speed.total_cmp(&samples[b].speed).then(a.cmp(&b)));
    of.truncate(of.len().div_ceil(2));
    of
}

fn least_strained_half(samples: &[Sample], mut of: Vec<usize>) -> Vec<usize> {
    of.sort_by(|&a, &b| samples[a].strain.total_cmp(&samples[b].strain).then(a.cmp(&b)));
    of.truncate(of.len().div_ceil(2));
    of
}

/// Per-coordinate median of the chosen frames, placed and lifted with the shape as it is now.
fn median_of(frames: &Frames, chosen: &[usize], shape: &Shape<'_>, t: f64) -> Option<Calibration> {
    let stride = chosen.len().div_ceil(MOST_WORKED).max(1);
    let num_points = frames.num_points;
    let mut lifted = Vec::with_capacity(MOST_WORKED * num_points);
    let (mut poses, mut squares, mut num_known) = (Vec::with_capacity(MOST_WORKED), 0.0, 0_usize);
    for &i in chosen.iter().step_by(stride) {
        let (sample, rays) = (&frames.samples[i], frames.rays_of(i));
        let pose = if shape.has_perspective {
            let Ok(fit) = head_pose::refine(Some(sample.pose), shape.model, rays, shape.stable, shape.unit) else { continue };
            fit.pose
        } else {
            sample.pose
        };
        let matrix = pose.matrix();
        for p in 0..num_points {
            let point = head_pose::lift(&matrix, pose.translation, rays[p], shape.model[p].z);
            lifted.push(DVec2::new(point.x, point.y));
        }
        poses.push(pose);
        if sample.speed < f64::MAX {
            squares += sample.speed * sample.speed;
            num_known += 1;
        }
    }
    let first = poses.first()?.rotation;
    let mut values = Vec::with_capacity(poses.len());
    let mut median = |value_at: &dyn Fn(usize) -> f64| {
        values.clear();
        values.extend((0..poses.len()).map(value_at));
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        if values.len() % 2 == 1 { values[middle] } else { 0.5 * (values[middle - 1] + values[middle]) }
    };
    let points = (0..num_points)
        .map(|p| [median(&|i| lifted[i * num_points + p].x), median(&|i| lifted[i * num_points + p].y), shape.model[p].z])
        .collect();
    let turn = [0, 1, 2].map(|axis| median(&|i| rotation::to_vector(first.inverse() * poses[i].rotation)[axis]));
    let position = [0, 1, 2].map(|axis| median(&|i| pivot_of(&poses[i], shape.pivot)[axis]));
    Some(Calibration {
        t,
        num_frames: poses.len(),
        speed: (squares / num_known.max(1) as f64).sqrt(),
        requested: false,
        points,
        head_rotation: (first * rotation::from_vector(DVec3::from(turn))).normalize().to_array(),
        head_position: position,
        weights: None,
    })
}

/// The neutral in use with other depths: x and y go along the ray each point had at neutral.
fn with_depth(current: &Calibration, shape: &Shape<'_>, t: f64) -> Calibration {
    let mut calibration = Calibration { t, ..current.clone() };
    let neutral_pose = DQuat::from_array(current.head_rotation);
    let head_from_camera = rotation::to_matrix(neutral_pose.inverse());
    let camera = head_from_camera * DVec3::from(current.head_position);
    for (point, model) in calibration.points.iter_mut().zip(shape.model.iter()) {
        // The head's position is its pivot's; the camera lies at minus that, seen from the pivot.
        let direction = DVec3::from(*point) - shape.pivot + camera;
        let share = (model.z - point[2]) / direction.z;
        point[0] += direction.x * share;
        point[1] += direction.y * share;
        point[2] = model.z;
    }
    calibration
}

/// The provisional neutral of the first frame.
pub(super) fn provisional(t: f64, points: &[DVec2], model: &[DVec3], pose: &Pose, pivot: DVec3) -> Calibration {
    Calibration {
        t,
        num_frames: 0,
        speed: 0.0,
        requested: false,
        points: points.iter().zip(model).map(|(p, model)| [p.x, p.y, model.z]).collect(),
        head_rotation: pose.rotation.to_array(),
        head_position: pivot_of(pose, pivot).to_array(),
        weights: None,
    }
}

/// Where a pose puts the character's head pivot, metres in the camera's frame.
pub(super) fn pivot_of(pose: &Pose, pivot: DVec3) -> DVec3 {
    rotation::rotate(pose.rotation, pivot) + pose.translation
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

#[cfg(test)]
mod tests {
    use super::*;

    const NUM_POINTS: usize = 6;
    const UNIT: f64 = 0.09;

    /// A face that is never calm: all of it goes to and fro, quickly in its first `num_quick` frames at 30 a second. Gives when a
    /// neutral was found and what it is.
    fn find(num_quick: usize, accepts: bool) -> (Vec<f64>, Option<Calibration>) {
        let mut model: Vec<DVec3> = (0..NUM_POINTS).map(|i| DVec3::new(0.02 * i as f64, 0.01 * (i % 3) as f64, 0.0)).collect();
        let prior = [0.0; NUM_POINTS];
        let spread = [0.1; NUM_POINTS];
        let mirror: Vec<usize> = (0..NUM_POINTS).collect();
        let mut calibrator = Calibrator::new(&CalibrationConfig::default(), NUM_POINTS, None);
        let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), translation: DVec3::new(0.0, 0.0, 0.6) };
        let current = provisional(0.0, &[DVec2::ZERO; NUM_POINTS], &model, &pose, DVec3::ZERO);
        let (mut times, mut found) = (Vec::new(), None);
        for frame in 0..90 {
            let t = f64::from(frame) / 30.0;
            // 0.5 or 0.15 interocular distances a second; the quick ones are somewhere else, too.
            let is_quick = (frame as usize) < num_quick;
            let (swing, place) = if is_quick { (0.5 / 30.0 * UNIT, 0.01) } else { (0.15 / 30.0 * UNIT, 0.0) };
            let off = DVec2::new(place + if frame % 2 == 0 { 0.5 } else { -0.5 } * swing, 0.0);
            let points: Vec<DVec2> = model.iter().map(|point| point.truncate() + off).collect();
            let rays: Vec<DVec2> = points.iter().map(|p| head_pose::project(&pose.matrix(), pose.translation, p.extend(0.0))).collect();
            calibrator.observe(t, &rays, &pose, &points, UNIT);
            let mut shape = Shape {
                model: &mut model,
                prior: &prior,
                believed_spread: &spread,
                mirror: &mirror,
                irises: &[],
                stable: &[],
                has_perspective: false,
                unit: UNIT,
                pivot: DVec3::ZERO,
            };
            if let Some(Found { calibration, is_awaited }) = calibrator.poll(t, &mut shape, &current) {
                assert!(is_awaited);
                times.push(t);
                found = Some(calibration);
                if accepts {
                    calibrator.accepted(false);
                } else {
                    calibrator.refused(t, false);
                }
            }
        }
        (times, found)
    }

    #[test]
    fn who_is_never_calm_is_taken_at_their_calmest_after_two_seconds() {
        let (times, found) = find(25, true);
        assert_eq!(times, [2.0]);
        let found = found.expect("a neutral");
        // Half of the 61 frames so far, all of them from the slower ones.
        assert_eq!(found.num_frames, 31);
        assert!((found.speed - 0.15).abs() < 0.01, "{}", found.speed);
        assert!(found.points[0][0].abs() < 3e-4, "{:?}", found.points[0]);
    }

    #[test]
    fn a_neutral_that_cannot_be_used_is_looked_for_again() {
        let (times, _) = find(25, false);
        assert!(times.len() >= 3, "{times:?}");
        assert!(
            times.windows(2).all(|pair| pair[1] - pair[0] > 0.999 * CalibrationConfig::default().look_back),
            "not with every frame: {times:?}"
        );
    }
}
