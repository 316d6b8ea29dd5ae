//! The guided fit: a performer makes eight faces, each is measured against the character's own, and a profile comes of it.

use super::landmark_session::LandmarkSession;
use super::ranges::{ChannelAmounts, MOUTH_RIGHT, NUM_CHANNELS, amounts_of_weights, channel_of};
use super::weights_to_bones::Weights;
use super::{CalibrationReport, Settings, Solver, Source};
use rhytid_shared::{
    ArkitShape, Command, FaceKind, FitRequest, FitStep, PROFILE_VERSION, Profile, ProfileChoice, RANGE_FACTORS, Ranges, RoomName,
    TrackingData, TrackingFrame,
};
use serde::Serialize;

/// A face must reach this share of the character's own to be measured: less is a tracker's noise.
const LEAST_AMOUNT: f32 = 0.08;
/// Frames with a face that a step needs.
const FEWEST_FRAMES: usize = 3;
/// Frames kept of one step: ten seconds of the fastest trackers; every other one goes when they are full.
const MOST_FRAMES: usize = 2048;
/// What is not asked for and yet moves by this much in every step has drifted.
const DRIFT: f32 = 0.25;
/// How much stronger the wrong side must be than the one asked for.
const CLEARLY: f32 = 0.1;
/// Share of the landmarks outside the picture that cannot be a face leaving it.
const MOST_OUTSIDE: f32 = 0.25;

/// Why a step of the fit gave nothing.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// The tracker hardly saw a face.
    #[error("{}: the face was seen in {seen} of {frames} frames, expected at least half of them and {FEWEST_FRAMES}", step.name())]
    FaceLost {
        /// The step.
        step: FitStep,
        /// Frames with a face.
        seen: usize,
        /// Frames that came.
        frames: usize,
    },
    /// The face hardly moved.
    #[error(
        "{}: the face moved by {percent} % of the character's range, expected at least {} %: {}, and hold it",
        step.name(), (LEAST_AMOUNT * 100.0) as u32, step.instruction()
    )]
    TooLittle {
        /// The step.
        step: FitStep,
        /// How far it went.
        percent: u32,
    },
    /// The frames spanned no face.
    #[error("neutral: no neutral face came of these frames, expected a face turned to the camera")]
    NoNeutral,
    /// Finished before it began.
    #[error("no step has been measured, expected at least neutral")]
    Nothing,
    /// Bones are placed by hand: there is nobody to fit.
    #[error("the frames place bones, expected landmarks or expression weights of a performer")]
    NoPerformer,
}

impl FitError {
    /// Short and stable, for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::FaceLost { .. } => "fit_face_lost",
            Self::TooLittle { .. } => "fit_too_little",
            Self::NoNeutral => "fit_no_neutral",
            Self::Nothing => "fit_nothing",
            Self::NoPerformer => "fit_no_performer",
        }
    }
}

/// A step that has been measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StepReport {
    /// The step.
    pub step: FitStep,
    /// Frames it was measured from.
    pub frames: usize,
    /// For people.
    pub note: String,
}

/// What has been found out of a performer.
#[derive(Debug, Clone, PartialEq)]
pub struct FitReport {
    /// In use from now on.
    pub profile: Profile,
    /// For people: what looked wrong.
    pub warnings: Vec<String>,
    /// Settings that would put a side right.
    pub offers: Settings,
}

/// One frame as it was seen, before anything is stretched.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    amounts: ChannelAmounts,
    /// Jaw to the left and to the right, of senders of weights.
    jaw: [f32; 2],
    /// Share of the landmarks outside the picture.
    outside: f32,
}

impl Sample {
    pub(super) fn of_weights(weights: &Weights) -> Self {
        let jaw = ["jawLeft", "jawRight"].map(|name| ArkitShape::from_name(name).map_or(0.0, |shape| weights[shape.index()]));
        Self { amounts: amounts_of_weights(weights), jaw, outside: 0.0 }
    }

    pub(super) fn of_landmarks(amounts: ChannelAmounts, frame: &TrackingFrame, image: Option<[f32; 2]>) -> Self {
        let outside = match (&frame.data, image) {
            (TrackingData::Landmarks { points, .. }, Some([width, height])) if !points.is_empty() => {
                let is_outside = |point: &&[f32; 3]| !(0.0..=width).contains(&point[0]) || !(0.0..=height).contains(&point[1]);
                points.iter().filter(is_outside).count() as f32 / points.len() as f32
            }
            _ => 0.0,
        };
        Self { amounts, jaw: [0.0; 2], outside }
    }
}

/// A step being measured.
struct Running {
    step: FitStep,
    seconds: f64,
    since: Option<f64>,
    num_frames: usize,
    num_seen: usize,
    samples: Vec<Sample>,
    /// Every so many frames with a face one is kept.
    stride: usize,
}

/// What a step showed: medians over its strongest half.
#[derive(Debug, Clone, Copy)]
struct Measured {
    step: FitStep,
    sample: Sample,
}

/// The fit of one session.
#[derive(Default)]
pub(super) struct Fit {
    running: Option<Running>,
    /// In the order they were last measured, one a step.
    measured: Vec<Measured>,
    outcome: Option<Result<StepReport, FitError>>,
}

impl Fit {
    /// Samples are wanted.
    pub(super) fn is_running(&self) -> bool {
        self.running.is_some()
    }

    fn begin(&mut self, step: FitStep, seconds: f64) {
        self.outcome = None;
        self.running = Some(Running { step, seconds, since: None, num_frames: 0, num_seen: 0, samples: Vec::new(), stride: 1 });
    }

    /// Takes a frame; gives the step whose time is over.
    pub(super) fn observe(&mut self, t: f64, sample: Option<Sample>) -> Option<FitStep> {
        let running = self.running.as_mut()?;
        let since = *running.since.get_or_insert(t);
        running.num_frames += 1;
        if let Some(sample) = sample {
            if running.num_seen.is_multiple_of(running.stride) {
                running.samples.push(sample);
            }
            running.num_seen += 1;
            if running.samples.len() == MOST_FRAMES {
                let mut i = 0;
                running.samples.retain(|_| {
                    i += 1;
                    i % 2 == 1
                });
                running.stride *= 2;
            }
        }
        (t - since >= running.seconds).then_some(running.step)
    }

    /// Ends the step that runs. A neutral face is measured by `neutral`.
    pub(super) fn end(&mut self, neutral: impl FnOnce() -> Option<CalibrationReport>) {
        let Some(running) = self.running.take() else { return };
        self.outcome = Some(self.conclude(running, neutral));
    }

    fn conclude(&mut self, running: Running, neutral: impl FnOnce() -> Option<CalibrationReport>) -> Result<StepReport, FitError> {
        let Running { step, num_frames, num_seen, samples, .. } = running;
        if num_seen < FEWEST_FRAMES || 2 * num_seen < num_frames {
            return Err(FitError::FaceLost { step, seen: num_seen, frames: num_frames });
        }
        let Some(channel) = channel_of(step) else {
            let report = neutral().ok_or(FitError::NoNeutral)?;
            // What was measured against another neutral counts no more.
            self.measured.clear();
            self.measured.push(Measured { step, sample: strongest(samples, |_| 0.0) });
            return Ok(StepReport { step, frames: report.num_frames, note: String::new() });
        };
        let sample = strongest(samples, |sample| asked(sample, step, channel));
        let amount = asked(&sample, step, channel);
        if amount < LEAST_AMOUNT {
            return Err(FitError::TooLittle { step, percent: (amount * 100.0).max(0.0) as u32 });
        }
        self.measured.retain(|known| known.step != step);
        self.measured.push(Measured { step, sample });
        Ok(StepReport { step, frames: num_seen, note: format!("went to {} % of the character's range", (amount * 100.0).round()) })
    }

    pub(super) fn take_outcome(&mut self) -> Option<Result<StepReport, FitError>> {
        self.outcome.take()
    }

    /// Factors, and what looked wrong.
    fn result(&self, kind: FaceKind, settings: &Settings) -> Result<(Ranges, Vec<String>, Settings), FitError> {
        if self.measured.is_empty() {
            return Err(FitError::Nothing);
        }
        let (mut ranges, mut warnings, mut offers) = (Ranges::ONE, Vec::new(), Settings::default());
        let [least, most] = RANGE_FACTORS;
        for Measured { step, sample } in &self.measured {
            let Some(channel) = channel_of(*step) else { continue };
            let amount = asked(sample, *step, channel);
            let factor = 1.0 / amount;
            if factor > most {
                let percent = (amount * 100.0).round();
                warnings.push(format!("{}: went to {percent} % only and is stretched {most} times, the most there is", step.name()));
            }
            ranges.set(*step, (factor.clamp(least, most) * 1000.0).round() / 1000.0);
        }
        self.check_sides(kind, settings, &mut warnings, &mut offers);
        self.check_drift(&mut warnings);
        let outside = self.measured.iter().map(|measured| measured.sample.outside).fold(0.0, f32::max);
        if outside > MOST_OUTSIDE {
            let percent = (outside * 100.0).round();
            warnings
                .push(format!("{percent} % of the landmarks lie outside the picture: is the hello's field image in their unit, pixels?"));
        }
        Ok((ranges, warnings, offers))
    }

    /// Did the mouth go to the side that was asked for?
    fn check_sides(&self, kind: FaceKind, settings: &Settings, warnings: &mut Vec<String>, offers: &mut Settings) {
        let Some(Measured { sample, .. }) = self.measured.iter().find(|measured| measured.step == FitStep::MouthLeft) else { return };
        let is_swapped = |left: f32, right: f32| right > left + CLEARLY;
        let mouth = channel_of(FitStep::MouthLeft).is_some_and(|left| is_swapped(sample.amounts[left], sample.amounts[MOUTH_RIGHT]));
        let jaw = is_swapped(sample.jaw[0], sample.jaw[1]);
        match kind {
            FaceKind::Landmarks if mouth => {
                warnings.push("the mouth went to the other side than asked: the tracker's picture is mirrored".into());
                offers.mirror = Some(!settings.mirror.unwrap_or(false));
            }
            FaceKind::Landmarks => {}
            FaceKind::Weights => {
                if mouth {
                    warnings.push("the mouth went to the other side than asked: the tracker's mouthLeft is another's mouthRight".into());
                    offers.swap_mouth = Some(!settings.swap_mouth.unwrap_or(false));
                }
                if jaw {
                    warnings.push("the jaw went to the other side than asked: the tracker's jawLeft is another's jawRight".into());
                    offers.swap_jaw = Some(!settings.swap_jaw.unwrap_or(false));
                }
                if mouth && jaw {
                    warnings.push("if one eye's wink moves the other, all of it is mirrored: then set mirror instead".into());
                }
            }
        }
    }

    /// What was to rest, did it come back to the neutral face?
    fn check_drift(&self, warnings: &mut Vec<String>) {
        let least_in = |steps: &[FitStep], of: &dyn Fn(&Sample) -> f32| {
            let seen: Vec<f32> = self.measured.iter().filter(|measured| steps.contains(&measured.step)).map(|m| of(&m.sample)).collect();
            // In one step alone it may belong to the face.
            if seen.len() < 2 { 0.0 } else { seen.iter().copied().fold(f32::INFINITY, f32::min) }
        };
        let resting_brows = [FitStep::Smile, FitStep::Pucker, FitStep::JawOpen, FitStep::MouthLeft];
        let resting_mouth = [FitStep::BrowsUp, FitStep::Frown, FitStep::Blink];
        for (step, resting) in [
            (FitStep::BrowsUp, &resting_brows[..]),
            (FitStep::Frown, &resting_brows[..]),
            (FitStep::Blink, &resting_brows[..]),
            (FitStep::Smile, &resting_mouth[..]),
            (FitStep::Pucker, &resting_mouth[..]),
            (FitStep::JawOpen, &resting_mouth[..]),
        ] {
            let Some(channel) = channel_of(step) else { continue };
            let amount = least_in(resting, &|sample| sample.amounts[channel]);
            if amount > DRIFT {
                let percent = (amount * 100.0).round();
                warnings.push(format!(
                    "{}: {percent} % of it stayed while other faces were asked for: the neutral face has drifted, take it again",
                    step.name()
                ));
            }
        }
    }
}

/// The amount of a step's own channel; to the side that is asked for or, from a tracker with other sides, to the other.
fn asked(sample: &Sample, step: FitStep, channel: usize) -> f32 {
    let amount = sample.amounts[channel];
    if step == FitStep::MouthLeft { amount.max(sample.amounts[MOUTH_RIGHT]) } else { amount }
}

/// Medians over the half of the samples in which `of` is greatest.
fn strongest(mut samples: Vec<Sample>, of: impl Fn(&Sample) -> f32) -> Sample {
    samples.sort_by(|a, b| of(b).total_cmp(&of(a)));
    samples.truncate(samples.len().div_ceil(2).max(1));
    let median = |of: &dyn Fn(&Sample) -> f32| {
        let mut values: Vec<f32> = samples.iter().map(of).collect();
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let mut amounts = [0.0; NUM_CHANNELS];
    for (channel, amount) in amounts.iter_mut().enumerate() {
        *amount = median(&|sample| sample.amounts[channel]);
    }
    Sample { amounts, jaw: [0, 1].map(|side| median(&|sample| sample.jaw[side])), outside: median(&|sample| sample.outside) }
}

impl Solver {
    /// Measures a step of the fit from the next frames, `seconds` on the sender's clock; see [`Self::take_fit`].
    pub fn measure(&mut self, step: FitStep, seconds: f64) {
        self.fit.begin(step, seconds);
    }

    /// A step that has been measured, or why it could not be, since the last call.
    pub fn take_fit(&mut self) -> Option<Result<StepReport, FitError>> {
        self.fit.take_outcome()
    }

    /// Forgets what has been measured.
    pub fn cancel_fit(&mut self) {
        self.fit = Fit::default();
    }

    /// Makes a profile of what has been measured and uses it from the next frame on.
    pub fn finish_fit(&mut self, name: Option<&RoomName>) -> Result<FitReport, FitError> {
        let kind = match self.last_source {
            Some(Source::Landmarks) => FaceKind::Landmarks,
            Some(Source::Weights) => FaceKind::Weights,
            Some(Source::Bones) => return Err(FitError::NoPerformer),
            None => return Err(FitError::Nothing),
        };
        let (ranges, warnings, offers) = self.fit.result(kind, &self.settings)?;
        self.cancel_fit();
        self.set_ranges(&ranges);
        let profile = Profile {
            rhytid_profile: PROFILE_VERSION,
            name: name.map(|name| name.as_str().to_owned()).unwrap_or_default(),
            source: self.hello.source.clone(),
            measured: kind,
            neutral: self.calibration().cloned(),
            ranges,
            settings: self.settings,
        };
        Ok(FitReport { profile, warnings, offers })
    }

    /// Uses a profile from the next frame on. Gives what of it does not fit this sender, for people.
    pub fn use_profile(&mut self, profile: &Profile) -> Result<Vec<String>, super::SolveError> {
        self.set(&profile.settings)?;
        self.set_ranges(&profile.ranges);
        let mut remarks = Vec::new();
        if let Some(neutral) = &profile.neutral {
            let num_points = self.landmarks.as_ref().map_or(0, LandmarkSession::num_points);
            let problem = super::calibration::problem(neutral, num_points, self.character.head_pivot.as_dvec3());
            match (&mut self.landmarks, profile.measured, problem) {
                (Some(landmarks), FaceKind::Landmarks, None) if !neutral.points.is_empty() => {
                    landmarks.restore(&self.character, neutral.clone())?;
                    // The camera has moved since: straight ahead is where the next face looks.
                    landmarks.recentre_next();
                    self.blend = Some(self.config.calibration.blend);
                }
                (_, FaceKind::Weights, _) if neutral.points.is_empty() && !matches!(self.last_source, Some(Source::Landmarks)) => {
                    self.weights.restore(neutral.weights.as_deref().unwrap_or(&[]));
                    self.sent_head.recentre_next();
                    self.sent_calibration = Some(neutral.clone());
                    self.blend = Some(self.config.calibration.blend);
                }
                _ => remarks.push("the profile's neutral face is that of another kind of tracker: one is searched for".to_owned()),
            }
        }
        Ok(remarks)
    }

    /// The factors in use.
    pub fn ranges(&self) -> &Ranges {
        &self.ranges
    }

    fn set_ranges(&mut self, ranges: &Ranges) {
        self.ranges = *ranges;
        self.range_rig.set(ranges);
        self.weights.set_factors(&self.range_rig.of_shapes());
    }

    /// Ends a step of the fit whose time is over.
    pub(super) fn end_fit_step(&mut self) {
        let mut fit = std::mem::take(&mut self.fit);
        fit.end(|| {
            self.calibrate();
            let report = self.report.filter(|report| report.requested);
            if report.is_none() {
                // Nobody waits for it: the performer is asked once more.
                self.is_wanted = false;
                self.landmarks.iter_mut().for_each(LandmarkSession::withdraw);
            }
            report
        });
        self.fit = fit;
    }

    /// Does what a command says, for feeds, whose commands nobody hears the answers of.
    pub fn command(&mut self, command: &Command) -> Result<(), super::SolveError> {
        match command {
            Command::Calibrate => self.calibrate(),
            Command::Settings(change) => self.set(change)?,
            Command::Recentre => {
                self.recentre();
            }
            Command::Fit(FitRequest::Measure { step, seconds }) => self.measure(*step, *seconds),
            Command::Fit(FitRequest::Finish { name }) => {
                // What could not be measured leaves the face as it was.
                let _ = self.finish_fit(name.as_ref());
            }
            Command::Fit(FitRequest::Cancel) => self.cancel_fit(),
            Command::Profile(ProfileChoice::Given(profile)) => {
                self.use_profile(profile)?;
            }
            Command::Profile(ProfileChoice::Named(name)) => return Err(super::SolveError::NamedProfile { name: name.to_string() }),
        }
        Ok(())
    }
}
