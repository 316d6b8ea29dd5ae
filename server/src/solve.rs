//! The solve: what a tracker saw in, a solved face out. Pure functions of their input: no clock, no I/O, and the same
//! bits on every machine (sums in a fixed order, no fused multiply-add, `libm` for transcendental functions).
//!
//! One direction: landmarks → head pose removed → smoothed → regression (or expression weights → linear deltas and
//! correctives, or an animator's own bones) → each bone's motion → eased over lost faces and new neutrals → evaluated
//! points, rotations and influences → wrinkle zones (expressions given or read from weights, else the influences).

#![deny(clippy::disallowed_methods)]

mod calibration;
mod config;
mod depth;
mod easing;
mod error;
mod estimate;
mod evaluate;
mod expressions;
mod filter;
mod fit;
mod gaze;
mod head_pose;
mod ingest;
mod landmark_session;
mod landmarks_to_bones;
mod lids;
mod linear;
mod lips;
mod lower_face;
pub mod mix;
mod points;
mod ranges;
mod rbf;
mod rotation;
mod settings;
mod skeleton;
mod weight_session;
mod weights_to_bones;
mod zones;

/// The stages by themselves: for benchmarks, and for whoever builds another pipeline of them.
pub mod stages {
    pub use super::estimate::{ExpressionMap, FitReport, ShapeFit};
    pub use super::evaluate::Evaluator;
    pub use super::filter::OneEuroBank;
    pub use super::head_pose::{Fit, Pose, lift, refine};
    pub use super::rbf::{FitError, Regression};
}

pub use config::{CalibrationConfig, ConfigError, FilterConfig, LostConfig, OneEuroConfig, SolveConfig};
pub use error::SolveError;
pub use fit::{FitError, FitReport, StepReport};
pub use rhytid_shared::Calibration;

use easing::{Easing, FaceState};
use evaluate::Evaluator;
use fit::{Fit, Sample};
use landmark_session::LandmarkSession;
use ranges::{RangeRig, stretched};
use rhytid_shared::limits::{MAX_EXPRESSIONS, MAX_SECONDS};
use rhytid_shared::{Character, FaceFrame, HeadPose, ProfileChoice, PublishHello, Ranges, Settings, TrackingData, TrackingFrame};
use serde::Serialize;
use settings::Amplifier;
use skeleton::Skeleton;
use std::sync::Arc;
use weight_session::{SentHead, WeightSession};
use zones::ZoneRig;

/// Largest amount of an expression: as of a weight, some overshoot on strong faces.
const LARGEST_AMOUNT: f32 = 1.2;

/// Frames nearer to each other than a packet's clock can tell, seconds, are one.
const SHORTEST_STEP: f64 = 1e-6;

/// What a publisher is told when a neutral has been reached.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CalibrationReport {
    /// Sender's time at which it was reached, seconds.
    pub t: f64,
    /// Frames it is the median of.
    pub num_frames: usize,
    /// Root-mean-square landmark speed over those frames, interocular distances a second; 0 for senders of weights.
    pub speed: f64,
    /// True where the publisher asked for it.
    pub requested: bool,
}

/// Delay the smoothing adds, seconds, by group: the lag behind a steady motion at the present cut-off.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct DelayReport {
    /// Brows and forehead.
    pub brows: f64,
    /// Eyelids and irises.
    pub eyelids: f64,
    /// Mouth, nose, cheeks and jaw.
    pub mouth: f64,
    /// Head rotation and position.
    pub head: f64,
}

/// Makes what the sessions of a character share, which takes tens of milliseconds: a service does so before its first session
/// comes, else that one does. The same character (by its `Arc`) is prepared once.
pub fn prepare(character: &Arc<Character>, config: &SolveConfig) {
    if config.estimate_weights {
        estimate::ExpressionMap::shared(character);
    }
}

/// Turns one publisher's tracking frames into face frames.
pub struct Solver {
    hello: PublishHello,
    settings: Settings,
    amplifier: Amplifier,
    ranges: Ranges,
    range_rig: RangeRig,
    fit: Fit,
    /// The newest face as it was seen, while it is measured.
    sample: Option<Sample>,
    character: Arc<Character>,
    config: SolveConfig,
    landmarks: Option<LandmarkSession>,
    weights: WeightSession,
    sent_head: SentHead,
    skeleton: Skeleton,
    evaluator: Evaluator,
    zones: Option<ZoneRig>,
    easing: Easing,
    /// The face as this frame alone would have it.
    target: FaceState,
    last_t: Option<f64>,
    last_source: Option<Source>,
    /// A neutral of weights, or one the publisher gave.
    sent_calibration: Option<Calibration>,
    /// The publisher asked for a neutral before there was a frame to take it from.
    is_wanted: bool,
    /// The next face is blended in: its neutral is another.
    blend: Option<f64>,
    report: Option<CalibrationReport>,
    seq: u32,
}

/// What a frame's bones came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Source {
    Landmarks,
    Weights,
    Bones,
}

impl Solver {
    /// Starts a session. Fails where the settings, the layout or the camera make no sense.
    pub fn new(character: Arc<Character>, config: &SolveConfig, hello: &PublishHello) -> Result<Self, SolveError> {
        config.validate()?;
        let landmarks = match &hello.layout {
            Some(layout) => Some(LandmarkSession::new(&character, config, layout, hello)?),
            None => None,
        };
        let weights = WeightSession::new(&character, config);
        let mut solver = Self {
            hello: hello.clone(),
            settings: Settings::default(),
            amplifier: Amplifier::new(&character),
            ranges: Ranges::ONE,
            range_rig: RangeRig::new(&character, weights.rig()),
            fit: Fit::default(),
            sample: None,
            landmarks,
            weights,
            sent_head: SentHead::new(config.mirror),
            skeleton: Skeleton::new(&character),
            evaluator: Evaluator::new(&character),
            zones: ZoneRig::new(&character),
            easing: Easing::new(&config.lost, character.num_bones()),
            target: FaceState::at_rest(character.num_bones()),
            last_t: None,
            last_source: None,
            sent_calibration: None,
            is_wanted: false,
            blend: None,
            report: None,
            seq: 0,
            config: config.clone(),
            character,
        };
        if let Some(ProfileChoice::Given(profile)) = &hello.profile {
            solver.use_profile(profile)?;
        }
        solver.set(&hello.settings)?;
        Ok(solver)
    }

    /// As [`Self::new`], with a neutral from an earlier session in place of the search for one.
    pub fn with_calibration(
        character: Arc<Character>,
        config: &SolveConfig,
        hello: &PublishHello,
        calibration: Calibration,
    ) -> Result<Self, SolveError> {
        let mut solver = Self::new(character, config, hello)?;
        let num_points = solver.landmarks.as_ref().map_or(0, LandmarkSession::num_points);
        if let Some(problem) = calibration::problem(&calibration, num_points, solver.character.head_pivot.as_dvec3()) {
            return Err(SolveError::BadCalibration { problem });
        }
        match &mut solver.landmarks {
            Some(landmarks) => landmarks.restore(&solver.character, calibration)?,
            None => {
                solver.sent_head.restore(&calibration);
                solver.weights.restore(calibration.weights.as_deref().unwrap_or(&[]));
                solver.sent_calibration = Some(calibration);
            }
        }
        Ok(solver)
    }

    /// Takes the neutral now: the face of the last moments or, before any face, of the first ones to come, whatever they come
    /// as.
    pub fn calibrate(&mut self) {
        self.is_wanted = true;
        match (self.last_t, self.last_source) {
            (Some(t), Some(Source::Weights | Source::Bones)) => self.calibrate_sent(t),
            _ => {
                if let Some(landmarks) = &mut self.landmarks
                    && landmarks.calibrate(&self.character, self.last_t)
                {
                    self.blend = Some(self.config.calibration.blend);
                    self.report = landmarks.calibration().map(report_of);
                    self.is_wanted = false;
                }
            }
        }
    }

    /// Takes the last weights and head as neutral.
    fn calibrate_sent(&mut self, t: f64) {
        let (rotation, position) = self.sent_head.calibrate();
        let weights = if self.last_source == Some(Source::Weights) { self.weights.calibrate() } else { None };
        let calibration = calibration::of_weights(t, weights, rotation, position);
        self.report = Some(report_of(&calibration));
        self.sent_calibration = Some(calibration);
        self.blend = Some(self.config.calibration.blend);
        self.is_wanted = false;
        if let Some(landmarks) = &mut self.landmarks {
            landmarks.withdraw();
        }
    }

    /// Solves one frame into `out`, whose buffers are reused; `session` is left to the caller, `seq` counts solved frames.
    /// On an error `out` and the session are as before: the frame counts for nothing.
    pub fn solve(&mut self, frame: &TrackingFrame, out: &mut FaceFrame) -> Result<(), SolveError> {
        let t = frame.t;
        if !(0.0..=MAX_SECONDS).contains(&t) {
            return Err(SolveError::TimeRange { got: t });
        }
        if let Some(previous) = self.last_t.filter(|previous| t - previous < SHORTEST_STEP) {
            return Err(SolveError::Time { got: t, previous });
        }
        let source = self.aim(frame)?;
        self.last_t = Some(t);
        out.face = source.is_some();
        match source {
            Some(source) => {
                if self.last_source.is_some_and(|last| last != source) {
                    // Another source sees another face: as with a new neutral, there is a way from one to the other.
                    self.blend = Some(self.config.calibration.blend);
                }
                if self.easing.shown().is_placed != self.target.is_placed {
                    self.easing.convert(|shown| self.skeleton.convert(shown, self.target.is_placed));
                }
                self.last_source = Some(source);
                self.easing.show(t, &self.target, self.blend.take());
                if self.is_wanted && source != Source::Landmarks {
                    self.calibrate_sent(t);
                }
            }
            None => {
                if let Some(landmarks) = &mut self.landmarks {
                    landmarks.interrupt();
                }
                self.easing.show_none(t);
            }
        }
        let sample = self.sample.take();
        if self.fit.is_running() && self.fit.observe(t, sample).is_some() {
            self.end_fit_step();
        }
        out.seq = self.seq;
        self.seq = self.seq.wrapping_add(1);
        out.captured_at_micros = libm::round(t * 1e6) as u64;
        self.write(out);
        Ok(())
    }

    /// Computes the target of one frame; nothing where there is no face.
    fn aim(&mut self, frame: &TrackingFrame) -> Result<Option<Source>, SolveError> {
        for (index, &got) in frame.expressions.iter().flatten().enumerate() {
            if !(0.0..=LARGEST_AMOUNT).contains(&got) {
                return Err(SolveError::Value { field: "expressions", index, got, expected: "0 to 1.2" });
            }
        }
        let source = self.aim_bones(frame.t, &frame.data)?;
        if self.fit.is_running() {
            self.sample = match source {
                Some(Source::Weights) => Some(Sample::of_weights(self.weights.seen())),
                Some(Source::Landmarks) => {
                    Some(Sample::of_landmarks(self.range_rig.amounts(&self.target.motions), frame, self.hello.image))
                }
                Some(Source::Bones) | None => None,
            };
        }
        if source == Some(Source::Landmarks) {
            self.stretch_landmarks();
        }
        // An animator's own bones are where they shall be.
        if matches!(source, Some(Source::Landmarks | Source::Weights)) {
            self.amplifier.amplify(&mut self.target);
        }
        // What the publisher says of expressions counts before what weights say. Weights that are estimated lack what landmarks
        // hardly show: the bones' influences, which the same landmarks drive, say more.
        let known = match (&frame.expressions, &self.target.weights, &self.zones) {
            (Some(amounts), _, _) => Some(ZoneRig::given(amounts)),
            (None, Some(weights), Some(zones)) if source == Some(Source::Weights) => zones.read(weights),
            _ => None,
        };
        self.target.bridge = if known.is_none() { 1.0 } else { 0.0 };
        self.target.expressions = known.unwrap_or([[0.0; 2]; MAX_EXPRESSIONS]);
        Ok(source)
    }

    /// Stretches what landmarks gave to the performer's ranges; weights have been stretched before they moved bones.
    fn stretch_landmarks(&mut self) {
        if self.range_rig.is_one() {
            return;
        }
        self.range_rig.stretch(&mut self.target.motions);
        self.amplifier.limit(&mut self.target.motions);
        if let Some(weights) = &mut self.target.weights {
            for (weight, factor) in weights.iter_mut().zip(self.range_rig.of_shapes()) {
                *weight = stretched(*weight, factor, 1.0);
            }
        }
    }

    /// Computes the bones of one frame; nothing where there is no face.
    fn aim_bones(&mut self, t: f64, data: &TrackingData) -> Result<Option<Source>, SolveError> {
        match data {
            TrackingData::NoFace => Ok(None),
            TrackingData::Landmarks { points, confidence } => {
                let landmarks = self.landmarks.as_mut().ok_or(SolveError::NoLayout)?;
                let solved = landmarks.solve(&self.character, t, points, confidence, &mut self.target)?;
                if solved.is_new_neutral {
                    self.blend = Some(self.config.calibration.blend);
                }
                if solved.is_to_report {
                    self.report = landmarks.calibration().map(report_of);
                    self.is_wanted &= !self.report.is_some_and(|report| report.requested);
                }
                Ok(Some(Source::Landmarks))
            }
            TrackingData::Weights { weights, head } => {
                SentHead::check(head.as_ref())?;
                self.weights.solve(t, weights, &mut self.target)?;
                self.sent_head.write(head.as_ref(), &mut self.target);
                Ok(Some(Source::Weights))
            }
            TrackingData::Bones { points, head } => {
                SentHead::check(head.as_ref())?;
                self.skeleton.check_placed(points)?;
                self.skeleton.read_placed(points, &mut self.target);
                self.sent_head.write(head.as_ref(), &mut self.target);
                Ok(Some(Source::Bones))
            }
        }
    }

    /// Writes what is shown.
    fn write(&self, out: &mut FaceFrame) {
        let shown = self.easing.shown();
        let num_bones = self.character.num_bones();
        out.points.resize(num_bones, glam::Vec3::ZERO);
        out.rotations.resize(num_bones, glam::Quat::IDENTITY);
        out.influences.resize(self.character.num_poses() * num_bones, 0.0);
        self.skeleton.pose(shown, &mut out.points, &mut out.rotations);
        self.evaluator.evaluate(&out.points, &mut out.influences);
        out.zones.resize(self.character.num_zones(), 0.0);
        out.stretched.resize(self.character.num_zones(), 0.0);
        if let Some(zones) = &self.zones {
            zones.write(&shown.expressions, shown.bridge, &out.influences, &mut out.zones, &mut out.stretched);
        }
        out.shapes = shown.weights;
        let [x, y, z, right, up, front] = shown.head;
        out.head = HeadPose {
            rotation: rotation::to_f32(rotation::from_vector(glam::DVec3::new(x, y, z))),
            position: glam::DVec3::new(right, up, front).as_vec3(),
        };
    }

    /// The neutral in use, once one has been reached.
    pub fn calibration(&self) -> Option<&Calibration> {
        let of_landmarks = self.landmarks.as_ref().and_then(LandmarkSession::calibration);
        match self.last_source {
            Some(Source::Weights | Source::Bones) => self.sent_calibration.as_ref(),
            Some(Source::Landmarks) => of_landmarks,
            None => of_landmarks.or(self.sent_calibration.as_ref()),
        }
    }

    /// A calibration reached since the last call. Later refinements of the same search are not told.
    pub fn take_calibrated(&mut self) -> Option<CalibrationReport> {
        self.report.take()
    }

    /// Delay the smoothing adds at present; weights share one filter, and a sender's own head and bones pass as they are.
    pub fn added_delay(&self) -> DelayReport {
        match (&self.landmarks, self.last_source) {
            (Some(landmarks), Some(Source::Landmarks) | None) => landmarks.added_delay(),
            (_, Some(Source::Weights)) => {
                let [brows, eyelids, mouth] = self.weights.added_delays();
                DelayReport { brows, eyelids, mouth, head: 0.0 }
            }
            _ => DelayReport::default(),
        }
    }
}

fn report_of(calibration: &Calibration) -> CalibrationReport {
    let Calibration { t, num_frames, speed, requested, .. } = *calibration;
    CalibrationReport { t, num_frames, speed, requested }
}
