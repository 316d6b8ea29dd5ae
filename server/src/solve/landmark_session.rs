//! One performer's landmarks through a session: head pose, neutral, smoothing, retargeting.

use super::DelayReport;
use super::calibration::{self, Calibrator, Found, ibug_strain};
use super::config::{FilterConfig, SolveConfig};
use super::depth::Shape;
use super::easing::FaceState;
use super::error::SolveError;
use super::estimate::Estimator;
use super::filter::{LONGEST_GAP, OneEuroBank};
use super::head_pose::{self, Fit, Pose};
use super::ingest::{Camera, Observation};
use super::landmarks_to_bones::Retarget;
use super::lower_face::LowerFace;
use super::points::{Group, LEFT_EYE, PointSet, RIGHT_EYE};
use super::rotation;
use glam::{DQuat, DVec2, DVec3};
use rhytid_shared::layout::Layout;
use rhytid_shared::limits::MAX_HEAD_TRAVEL;
use rhytid_shared::{Calibration, Character, PublishHello};
use std::sync::Arc;

/// A head pose that fits badly is refused for this long, seconds; what lasts longer is no outlier.
const LONGEST_REFUSAL: f64 = 0.5;
/// How far, in radians, the head must have turned for half of a found depth to be believed: of points that hardly move, and
/// of mouth and jaw, whose motion hides it.
const STILL_SPREAD: f64 = 0.03;
const MOVING_SPREAD: f64 = 0.12;
/// Metres that weigh as much as a radian in the head's filter: the radius of a head.
const HEAD_RADIUS: f64 = 0.1;

/// Points that share a filter's parameters.
struct GroupFilter {
    points: Vec<usize>,
    samples: Vec<f64>,
    bank: OneEuroBank,
}

pub(super) struct LandmarkSession {
    layout: Layout,
    camera: Camera,
    points: PointSet,
    config: SolveConfig,
    /// The character's head pivot and interocular distance, metres.
    pivot: DVec3,
    unit: f64,
    observation: Observation,
    /// The performer's neutral head; irises after the points. Depths are the character's until they are known better.
    model: Vec<DVec3>,
    /// The character's depths, and how far a head must turn for others to be believed.
    prior: Vec<f64>,
    believed_spread: Vec<f64>,
    /// Each iris and the corners of its eye.
    irises: Vec<(usize, (usize, usize))>,
    /// Points that place the head in this frame.
    placing: Vec<(usize, f64)>,
    pose: Option<Pose>,
    last_t: Option<f64>,
    refused_since: Option<f64>,
    /// In head space: as lifted, with mouth and chin settled, and smoothed. What is not believed stays where it was.
    lifted: Vec<DVec2>,
    settled: Vec<DVec2>,
    smoothed: Vec<DVec2>,
    lower_face: LowerFace,
    brows: GroupFilter,
    eyelids: GroupFilter,
    mouth: GroupFilter,
    head: OneEuroBank,
    calibrator: Calibrator,
    calibration: Option<Calibration>,
    retarget: Option<Retarget>,
    /// Head rotation and place that count as straight ahead, where the publisher has said so since the neutral.
    centre: Option<(DQuat, DVec3)>,
    /// The next face looks straight ahead.
    is_centre_wanted: bool,
    /// Where weights are wanted and can be told.
    estimator: Option<Estimator>,
}

/// What a frame did besides its face.
pub(super) struct Solved {
    /// A neutral came into use with this frame; the face is to be blended over.
    pub(super) is_new_neutral: bool,
    /// That neutral is one the publisher waits for.
    pub(super) is_to_report: bool,
}

impl LandmarkSession {
    pub(super) fn new(character: &Arc<Character>, config: &SolveConfig, layout: &Layout, hello: &PublishHello) -> Result<Self, SolveError> {
        let camera = Camera::new(hello, config.mirror)?;
        let points = PointSet::new(character, layout, config.mirror)?;
        let unit = f64::from(character.interocular());
        let mut model = points.model.clone();
        let mut groups = points.groups.clone();
        let mut irises = Vec::new();
        if points.irises.is_some() {
            for eye in [RIGHT_EYE, LEFT_EYE] {
                irises.push((model.len(), eye.corners));
                model.push((points.model[eye.corners.0] + points.model[eye.corners.1]) * 0.5);
                groups.push(Group::Eyelids);
            }
        }
        if !points.has_perspective {
            // A similarity sees a flat face: with depths of its own the lifted points would not fit themselves.
            let mean = model.iter().map(|point| point.z).sum::<f64>() / model.len() as f64;
            model.iter_mut().for_each(|point| point.z = mean);
        }
        let num = model.len();
        let group_filter = |group, one_euro| {
            let points: Vec<usize> = (0..num).filter(|&i| groups[i] == group).collect();
            let len = 2 * points.len();
            GroupFilter { points, samples: vec![0.0; len], bank: OneEuroBank::new(one_euro, len, unit) }
        };
        Ok(Self {
            layout: layout.clone(),
            camera,
            config: config.clone(),
            pivot: character.head_pivot.as_dvec3(),
            unit,
            observation: Observation { rays: Vec::with_capacity(num), is_sure: Vec::with_capacity(num) },
            irises,
            placing: Vec::with_capacity(points.len()),
            pose: None,
            last_t: None,
            refused_since: None,
            // Until a point has been believed it is where the character has it.
            lifted: model.iter().map(|point| point.truncate()).collect(),
            settled: model.iter().map(|point| point.truncate()).collect(),
            lower_face: LowerFace::new(points.lower.clone()),
            smoothed: vec![DVec2::ZERO; num],
            brows: group_filter(Group::Brows, config.filter.brows),
            eyelids: group_filter(Group::Eyelids, config.filter.eyelids),
            mouth: group_filter(Group::Mouth, config.filter.mouth),
            head: OneEuroBank::new(config.filter.head, 6, 1.0),
            calibrator: Calibrator::new(&config.calibration, num, points.is_ibug.then_some(ibug_strain)),
            calibration: None,
            retarget: None,
            centre: None,
            is_centre_wanted: false,
            estimator: if config.estimate_weights { Estimator::new(character, &points) } else { None },
            prior: model.iter().map(|point| point.z).collect(),
            believed_spread: (0..num)
                .map(|i| if groups[i] == Group::Mouth && !points.is_stable(i) { MOVING_SPREAD } else { STILL_SPREAD })
                .collect(),
            model,
            points,
        })
    }

    /// Uses a neutral from elsewhere and searches for none.
    pub(super) fn restore(&mut self, character: &Character, calibration: Calibration) -> Result<(), SolveError> {
        if calibration.points.is_empty() {
            return Err(SolveError::BadCalibration { problem: "has no points, expected a neutral of landmarks".to_owned() });
        }
        self.calibrator.stop();
        self.adopt(character, calibration)?;
        for (lifted, model) in self.lifted.iter_mut().zip(&self.model) {
            *lifted = model.truncate();
        }
        self.settled.copy_from_slice(&self.lifted);
        Ok(())
    }

    pub(super) fn num_points(&self) -> usize {
        self.model.len()
    }

    pub(super) fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref().filter(|calibration| calibration.num_frames > 0)
    }

    /// Asks for the neutral now; true where it is in use already. Else it comes with one of the next frames.
    pub(super) fn calibrate(&mut self, character: &Character, t: Option<f64>) -> bool {
        let t = t.unwrap_or(f64::NEG_INFINITY);
        let (calibrator, mut shape) = self.parts();
        let found = calibrator.request(t, &mut shape);
        found.is_some_and(|found| self.try_neutral(character, t, found))
    }

    /// Nobody waits for a neutral any more.
    pub(super) fn withdraw(&mut self) {
        self.calibrator.withdraw();
    }

    /// Puts a neutral to use; false where it spans no plane: the one in use stays, and the search goes on.
    fn try_neutral(&mut self, character: &Character, t: f64, found: Found) -> bool {
        // What refines a neutral that was asked for is asked for by nobody.
        let is_requested = found.is_awaited && found.calibration.requested;
        let is_adopted = self.adopt(character, found.calibration).is_ok();
        if is_adopted {
            if is_requested {
                (self.centre, self.is_centre_wanted) = (None, false);
            }
            self.calibrator.accepted(is_requested);
        } else {
            self.calibrator.refused(t, is_requested);
        }
        is_adopted
    }

    fn poll(&mut self, t: f64) -> Option<Found> {
        let current = self.calibration.take()?;
        let (calibrator, mut shape) = self.parts();
        let found = calibrator.poll(t, &mut shape, &current);
        self.calibration = Some(current);
        found
    }

    /// The search and what it works on.
    fn parts(&mut self) -> (&mut Calibrator, Shape<'_>) {
        let shape = Shape {
            model: &mut self.model,
            prior: &self.prior,
            believed_spread: &self.believed_spread,
            mirror: &self.points.mirror,
            irises: &self.irises,
            stable: &self.points.stable,
            has_perspective: self.points.has_perspective,
            unit: self.unit,
            pivot: self.pivot,
        };
        (&mut self.calibrator, shape)
    }

    /// The tracker lost the face.
    pub(super) fn interrupt(&mut self) {
        self.calibrator.interrupt();
    }

    /// Smooths with other parameters from the next frame on.
    pub(super) fn set_filter(&mut self, filter: &FilterConfig) {
        self.brows.bank.set_config(filter.brows);
        self.eyelids.bank.set_config(filter.eyelids);
        self.mouth.bank.set_config(filter.mouth);
        self.head.set_config(filter.head);
    }

    /// The head's present pose is straight ahead, until a neutral is asked for; false where no face has been seen.
    pub(super) fn recentre(&mut self) -> bool {
        let Some(pose) = self.pose else { return false };
        self.centre = Some((pose.rotation, calibration::pivot_of(&pose, self.pivot)));
        self.head.reset();
        true
    }

    /// As [`Self::recentre`], with the next face.
    pub(super) fn recentre_next(&mut self) {
        self.is_centre_wanted = true;
    }

    pub(super) fn added_delay(&self) -> DelayReport {
        DelayReport {
            brows: self.brows.bank.delay(),
            eyelids: self.eyelids.bank.delay(),
            mouth: self.mouth.bank.delay(),
            head: self.head.delay(),
        }
    }

    /// Solves one frame into `state`. An error leaves the session as it was.
    pub(super) fn solve(
        &mut self,
        character: &Character,
        t: f64,
        landmarks: &[[f32; 3]],
        confidence: &[f32],
        state: &mut FaceState,
    ) -> Result<Solved, SolveError> {
        self.camera.observe(&self.layout, &self.points, landmarks, confidence, &mut self.observation)?;
        let fit = self.place(t)?;
        let (pose, refused_since) = self.judge(t, fit);
        let is_refused = refused_since.is_some_and(|since| t - since < LONGEST_REFUSAL);
        if !is_refused {
            // Rays that the pose does not belong to would scatter all over the face.
            self.lift(&pose);
        }
        if self.retarget.is_none() {
            let provisional = calibration::provisional(t, &self.lifted, &self.model, &pose, self.pivot);
            self.adopt(character, provisional)?;
        }
        let dt = self.last_t.map_or(f64::INFINITY, |last| t - last);
        (self.pose, self.refused_since, self.last_t) = (Some(pose), refused_since, Some(t));
        let mut solved = Solved { is_new_neutral: false, is_to_report: false };
        if !is_refused {
            self.calibrator.observe(t, &self.observation.rays, &pose, &self.lifted, self.unit);
            if let Some(found) = self.poll(t) {
                let is_awaited = found.is_awaited;
                solved.is_new_neutral = self.try_neutral(character, t, found);
                solved.is_to_report = is_awaited && solved.is_new_neutral;
                // The performer's head has another shape now: look at the frame again.
                if let Ok(fit) = self.place(t) {
                    self.pose = Some(fit.pose);
                    self.lift(&fit.pose);
                }
            }
            self.settle();
        }
        if self.is_centre_wanted && !is_refused {
            self.is_centre_wanted = false;
            self.recentre();
        }
        self.smooth(dt);
        if let Some(retarget) = &mut self.retarget {
            retarget.solve(&self.smoothed, &mut state.motions);
        }
        self.write_head(dt, state);
        let motions = &state.motions;
        state.weights = self.estimator.as_mut().map(|estimator| estimator.estimate(&self.smoothed, motions));
        state.is_placed = false;
        Ok(solved)
    }

    /// The pose of the frame before, unless it is long ago.
    fn recent_pose(&self, t: f64) -> Option<Pose> {
        self.pose.filter(|_| self.last_t.is_some_and(|last| t - last <= LONGEST_GAP))
    }

    /// The head pose that fits this frame best.
    fn place(&mut self, t: f64) -> Result<Fit, SolveError> {
        let rays = &self.observation.rays;
        self.placing.clear();
        self.placing.extend(self.points.stable.iter().filter(|(i, _)| self.observation.is_sure[*i]));
        // All of them do, or the layout would have no perspective.
        if self.placing.len() < self.points.stable.len() && !head_pose::spans(&self.model, &self.placing, self.unit) {
            self.placing.clear();
            self.placing.extend_from_slice(&self.points.stable);
        }
        let spread = head_pose::spread(rays, &self.placing);
        if spread.is_nan() || spread < self.camera.least_spread() {
            return Err(head_pose::ONE_PLACE);
        }
        if !self.points.has_perspective {
            let pose = head_pose::frontal_pose(&self.model, rays, &self.placing)?;
            return Ok(Fit { pose, error: 0.0 });
        }
        let guess = self.recent_pose(t);
        let fit = head_pose::refine(guess, &self.model, rays, &self.placing, self.unit)?;
        if guess.is_some() && fit.error > self.config.max_reprojection {
            // The last pose may have led into a blind alley.
            let afresh = head_pose::refine(None, &self.model, rays, &self.placing, self.unit)?;
            return Ok(if afresh.error < fit.error { afresh } else { fit });
        }
        Ok(fit)
    }

    /// Refuses a pose that fits badly in favour of the last one, for a while. Gives the pose to use and since when the
    /// tracker's have been refused.
    fn judge(&self, t: f64, fit: Fit) -> (Pose, Option<f64>) {
        match self.recent_pose(t) {
            Some(last) if fit.error > self.config.max_reprojection => {
                let since = self.refused_since.unwrap_or(t);
                if t - since < LONGEST_REFUSAL { (last, Some(since)) } else { (fit.pose, Some(since)) }
            }
            _ => (fit.pose, None),
        }
    }

    fn lift(&mut self, pose: &Pose) {
        let matrix = pose.matrix();
        for (i, lifted) in self.lifted.iter_mut().enumerate() {
            if self.observation.is_sure[i] {
                let point = head_pose::lift(&matrix, pose.translation, self.observation.rays[i], self.model[i].z);
                *lifted = DVec2::new(point.x, point.y);
            } else {
                // What is not believed shall not come back through a neutral either.
                self.observation.rays[i] = head_pose::project(&matrix, pose.translation, lifted.extend(self.model[i].z));
            }
        }
    }

    /// Lets mouth and chin lie at the depth that explains how they slid together; the rest of the face stays as lifted.
    fn settle(&mut self) {
        for (i, settled) in self.settled.iter_mut().enumerate() {
            if self.observation.is_sure[i] {
                *settled = self.lifted[i];
            }
        }
        if let Some(pose) = &self.pose {
            let Observation { rays, is_sure } = &self.observation;
            self.lower_face.settle(pose, rays, is_sure, &mut self.settled);
        }
    }

    /// Puts a neutral to use.
    fn adopt(&mut self, character: &Character, calibration: Calibration) -> Result<(), SolveError> {
        let neutral: Vec<DVec2> = calibration.points.iter().map(|p| DVec2::new(p[0], p[1])).collect();
        self.retarget = Some(Retarget::new(character, &self.points, &neutral, self.config.ridge)?);
        if let Some(estimator) = &mut self.estimator {
            estimator.adopt(&neutral);
        }
        for (model, neutral) in self.model.iter_mut().zip(&calibration.points) {
            *model = DVec3::from(*neutral);
        }
        let rotation = DQuat::from_array(calibration.head_rotation);
        let translation = DVec3::from(calibration.head_position) - rotation::rotate(rotation, self.pivot);
        self.lower_face.adopt(&self.model, &Pose { rotation, translation });
        self.calibration = Some(calibration);
        for filter in [&mut self.brows, &mut self.eyelids, &mut self.mouth] {
            filter.bank.reset();
        }
        self.head.reset();
        Ok(())
    }

    fn smooth(&mut self, dt: f64) {
        for filter in [&mut self.brows, &mut self.eyelids, &mut self.mouth] {
            for (pair, &i) in filter.samples.chunks_exact_mut(2).zip(&filter.points) {
                pair[0] = self.settled[i].x;
                pair[1] = self.settled[i].y;
            }
            let smoothed = filter.bank.update(&filter.samples, dt);
            for (pair, &i) in smoothed.chunks_exact(2).zip(&filter.points) {
                self.smoothed[i] = DVec2::new(pair[0], pair[1]);
            }
        }
    }

    /// Head rotation and the pivot's way since neutral, smoothed.
    fn write_head(&mut self, dt: f64, state: &mut FaceState) {
        let (Some(pose), Some(calibration)) = (self.pose, &self.calibration) else { return };
        let at_neutral = (DQuat::from_array(calibration.head_rotation), DVec3::from(calibration.head_position));
        let (rotation, position) = self.centre.unwrap_or(at_neutral);
        let neutral_from_camera = rotation.inverse();
        let turn = rotation::to_vector((neutral_from_camera * pose.rotation).normalize());
        let pivot = calibration::pivot_of(&pose, self.pivot);
        let shift = rotation::rotate(neutral_from_camera, pivot - position) / HEAD_RADIUS;
        let smoothed = self.head.update(&[turn.x, turn.y, turn.z, shift.x, shift.y, shift.z], dt);
        let farthest = f64::from(MAX_HEAD_TRAVEL);
        for axis in 0..3 {
            state.head[axis] = smoothed[axis];
            state.head[3 + axis] = (smoothed[3 + axis] * HEAD_RADIUS).clamp(-farthest, farthest);
        }
    }
}
