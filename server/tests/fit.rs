//! The guided fit on the default character: performers whose faces go less far than the character's, to another side, or drift.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod solve_fixture;

use glam::Vec3;
use rhytid_server::solve::{FitError, FitReport, SolveConfig, Solver, StepReport};
use rhytid_shared::layout::Layout;
use rhytid_shared::{
    Character, Command, DEFAULT_CHARACTER_GLB, FaceFrame, FaceKind, FitStep, Profile, ProfileChoice, PublishHello, Ranges, Settings,
};
use solve_fixture::{View, hello, landmark_frame, see, weight_frame};
use std::sync::Arc;

/// What each step is made of, at the character's own range.
fn faces(step: FitStep) -> &'static [(&'static str, f32)] {
    match step {
        FitStep::Neutral => &[],
        FitStep::BrowsUp => &[("browInnerUp", 1.0), ("browOuterUpLeft", 1.0), ("browOuterUpRight", 1.0)],
        FitStep::Frown => &[("browDownLeft", 1.0), ("browDownRight", 1.0)],
        FitStep::Smile => &[("mouthSmileLeft", 1.0), ("mouthSmileRight", 1.0)],
        FitStep::Pucker => &[("mouthPucker", 1.0)],
        FitStep::JawOpen => &[("jawOpen", 1.0)],
        FitStep::Blink => &[("eyeBlinkLeft", 1.0), ("eyeBlinkRight", 1.0)],
        FitStep::MouthLeft => &[("mouthLeft", 1.0), ("jawLeft", 0.6)],
    }
}

fn scaled(face: &[(&'static str, f32)], by: f32) -> Vec<(&'static str, f32)> {
    face.iter().map(|(name, weight)| (*name, weight * by)).collect()
}

/// A performer before the solve.
struct Performer {
    character: Arc<Character>,
    solver: Solver,
    /// Sends landmarks of the face; else its weights.
    sends_landmarks: bool,
    t: f64,
    out: FaceFrame,
}

impl Performer {
    fn new(sends_landmarks: bool) -> Self {
        let layout = sends_landmarks.then_some(Layout::Ibug68);
        Self::with(hello(layout, Some(640.0)))
    }

    fn with(hello: PublishHello) -> Self {
        let character = Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap());
        let solver = Solver::new(character.clone(), &SolveConfig::default(), &hello).unwrap();
        Self { out: FaceFrame::at_rest(&character), sends_landmarks: hello.layout.is_some(), character, solver, t: 0.0 }
    }

    /// Holds a face for `seconds`.
    fn hold(&mut self, face: &[(&str, f32)], seconds: f64) {
        for _ in 0..(seconds * 30.0) as usize {
            let frame = if self.sends_landmarks {
                let mut points: Vec<Vec3> = self.character.ibug68.to_vec();
                for (name, weight) in face {
                    if let Some(shape) = self.character.shapes.iter().find(|shape| shape.shape.name() == *name) {
                        points.iter_mut().zip(&shape.landmarks).for_each(|(point, delta)| *point += *delta * *weight);
                    }
                }
                landmark_frame(self.t, see(&points, self.character.head_pivot, &View::FRONT))
            } else {
                weight_frame(self.t, face)
            };
            self.solver.solve(&frame, &mut self.out).unwrap();
            self.t += 1.0 / 30.0;
        }
    }

    fn measure(&mut self, step: FitStep, face: &[(&str, f32)]) -> Result<StepReport, FitError> {
        self.hold(face, 1.0);
        self.solver.measure(step, 1.0);
        self.hold(face, 1.2);
        self.solver.take_fit().expect("the step is over")
    }

    /// All steps, each at `by` of the character's range.
    fn fit(&mut self, by: f32) -> FitReport {
        for step in FitStep::ALL {
            self.measure(step, &scaled(faces(step), by)).unwrap();
        }
        self.solver.finish_fit(None).unwrap()
    }

    /// Root-mean-square difference of the bones to those of another face, metres.
    fn distance(&self, other: &FaceFrame) -> f32 {
        let sum: f32 = self.out.points.iter().zip(&other.points).map(|(a, b)| a.distance_squared(*b)).sum();
        (sum / self.out.points.len() as f32).sqrt()
    }
}

#[test]
fn a_performer_of_weak_weights_reaches_the_characters_whole_range() {
    let mut performer = Performer::new(false);
    let report = performer.fit(0.5);
    assert_eq!((report.warnings.len(), report.offers), (0, Settings::default()), "{:?}", report.warnings);
    assert_eq!(report.profile.measured, FaceKind::Weights);
    for step in FitStep::ALL.into_iter().skip(1) {
        let factor = report.profile.ranges.of(step);
        assert!((factor - 2.0).abs() < 0.05, "{step:?}: {factor}");
    }
    for step in FitStep::ALL.into_iter().skip(1).filter(|step| *step != FitStep::MouthLeft) {
        let mut whole = Performer::new(false);
        whole.hold(faces(step), 2.0);
        performer.hold(&scaled(faces(step), 0.5), 2.0);
        assert!(performer.distance(&whole.out) < 2e-5, "{step:?}");
        performer.hold(&[], 2.0);
        assert!(performer.distance(&Performer::new(false).out) < 1e-6, "a gain, no offset");
    }
}

#[test]
fn a_performer_of_weak_landmarks_reaches_the_characters_whole_range() {
    let mut performer = Performer::new(true);
    let report = performer.fit(0.6);
    assert_eq!(report.offers, Settings::default());
    assert_eq!(report.profile.measured, FaceKind::Landmarks);
    let neutral = report.profile.neutral.as_ref().expect("the neutral was asked for");
    assert!(neutral.requested && neutral.points.len() == 68);
    let rest = Performer::new(false).out;
    for step in [FitStep::BrowsUp, FitStep::Frown, FitStep::Smile, FitStep::JawOpen, FitStep::Blink] {
        let mut own = Performer::new(false);
        own.hold(faces(step), 2.0);
        // How much of the character's own face is there.
        let amount = |seen: &FaceFrame| {
            let dot = |a: &FaceFrame| -> f32 {
                let pairs = a.points.iter().zip(&own.out.points).zip(&rest.points);
                pairs.map(|((a, own), rest)| (*a - *rest).dot(*own - *rest)).sum()
            };
            dot(seen) / dot(&own.out)
        };
        let weak = scaled(faces(step), 0.6);
        let mut plain = Performer::new(true);
        plain.hold(&[], 3.0);
        plain.hold(&weak, 2.0);
        performer.hold(&[], 1.0);
        performer.hold(&weak, 2.0);
        let (with, without) = (amount(&performer.out), amount(&plain.out));
        assert!(
            (with - 1.0).abs() < 0.15 && (with - 1.0).abs() < (without - 1.0).abs(),
            "{step:?}: {with} with the profile, {without} without"
        );
    }
}

#[test]
fn a_profile_is_used_by_the_next_session_and_by_another_kind_of_tracker() {
    let mut performer = Performer::new(false);
    performer.hold(&[("browInnerUp", 0.3)], 1.0);
    performer.solver.measure(FitStep::Neutral, 1.0);
    performer.hold(&[("browInnerUp", 0.3)], 1.5);
    performer.solver.take_fit().unwrap().unwrap();
    performer.measure(FitStep::Smile, &[("browInnerUp", 0.3), ("mouthSmileLeft", 0.4), ("mouthSmileRight", 0.4)]).unwrap();
    performer.solver.set(&Settings { mirror: Some(false), ..Settings::default() }).unwrap();
    let profile = performer.solver.finish_fit(None).unwrap().profile;
    let profile = Profile::from_json(&serde_json::to_string(&profile).unwrap()).unwrap();
    assert_eq!(profile.ranges, Ranges { smile: 2.5, ..Ranges::ONE });

    let choice = ProfileChoice::Given(Box::new(profile.clone()));
    let mut next = Performer::with(PublishHello { profile: Some(choice.clone()), ..hello(None, None) });
    next.hold(&[("browInnerUp", 0.3), ("mouthSmileLeft", 0.4), ("mouthSmileRight", 0.4)], 2.0);
    let mut whole = Performer::new(false);
    whole.hold(&[("mouthSmileLeft", 1.0), ("mouthSmileRight", 1.0)], 2.0);
    assert!(next.distance(&whole.out) < 1e-5, "neutral and range came with the profile");

    let mut webcam = Performer::new(true);
    webcam.hold(&[], 1.0);
    let remarks = webcam.solver.use_profile(&profile).unwrap();
    assert!(remarks.len() == 1 && remarks[0].contains("another kind of tracker"), "{remarks:?}");
    assert_eq!(webcam.solver.ranges(), &profile.ranges, "the ranges are the performer's own");
    webcam.solver.command(&Command::Profile(choice)).unwrap();
}

#[test]
fn what_cannot_be_measured_is_said_and_changes_nothing() {
    let mut performer = Performer::new(false);
    assert_eq!(performer.solver.finish_fit(None), Err(FitError::Nothing));
    performer.measure(FitStep::Neutral, &[]).unwrap();
    let error = performer.measure(FitStep::Smile, &[("mouthSmileLeft", 0.04)]).unwrap_err();
    assert_eq!(error, FitError::TooLittle { step: FitStep::Smile, percent: 2 });
    assert!(error.to_string().contains("smile: the face moved by 2 % of the character's range"), "{error}");
    performer.solver.measure(FitStep::Blink, 1.0);
    for i in 0..40 {
        let frame = rhytid_shared::TrackingFrame::new(performer.t + f64::from(i) / 30.0, rhytid_shared::TrackingData::NoFace);
        performer.solver.solve(&frame, &mut performer.out).unwrap();
    }
    assert!(matches!(performer.solver.take_fit(), Some(Err(FitError::FaceLost { step: FitStep::Blink, seen: 0, .. }))));
    performer.t += 2.0;
    let report = performer.solver.finish_fit(None).unwrap();
    assert_eq!(report.profile.ranges, Ranges::ONE);
    // Given up in the middle, nothing is told.
    performer.solver.measure(FitStep::JawOpen, 1.0);
    performer.hold(faces(FitStep::JawOpen), 0.3);
    performer.solver.cancel_fit();
    performer.hold(faces(FitStep::JawOpen), 1.5);
    assert!(performer.solver.take_fit().is_none());
}

#[test]
fn wrong_sides_and_drift_are_found() {
    let mut phone = Performer::new(false);
    phone.measure(FitStep::Neutral, &[]).unwrap();
    phone.measure(FitStep::MouthLeft, &[("mouthRight", 0.8), ("jawLeft", 0.5)]).unwrap();
    let report = phone.solver.finish_fit(None).unwrap();
    assert_eq!(report.offers, Settings { swap_mouth: Some(true), ..Settings::default() });
    assert!(report.warnings[0].contains("mouthLeft"), "{:?}", report.warnings);
    assert!((report.profile.ranges.mouth_left - 1.25).abs() < 0.02);

    let mut webcam = Performer::new(true);
    webcam.measure(FitStep::Neutral, &[]).unwrap();
    webcam.measure(FitStep::MouthLeft, &[("mouthRight", 1.0)]).unwrap();
    assert_eq!(webcam.solver.finish_fit(None).unwrap().offers, Settings { mirror: Some(true), ..Settings::default() });

    let mut drifting = Performer::new(false);
    let brows = [("browInnerUp", 0.5), ("browOuterUpLeft", 0.5), ("browOuterUpRight", 0.5)];
    drifting.measure(FitStep::Neutral, &[]).unwrap();
    drifting.measure(FitStep::Smile, &[faces(FitStep::Smile), &brows].concat()).unwrap();
    drifting.measure(FitStep::JawOpen, &[faces(FitStep::JawOpen), &brows].concat()).unwrap();
    let warnings = drifting.solver.finish_fit(None).unwrap().warnings;
    assert!(warnings.iter().any(|warning| warning.starts_with("brows_up: 50 %") && warning.contains("drifted")), "{warnings:?}");
}
