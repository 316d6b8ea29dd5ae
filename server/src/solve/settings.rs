//! Settings that change while a session goes on: sides, gains, smoothing, and which way is ahead.

use super::config::{FilterConfig, OneEuroConfig};
use super::easing::FaceState;
use super::landmark_session::LandmarkSession;
use super::mix::{group_of_bone, group_of_shape};
use super::weight_session::{SentHead, WeightSession};
use super::{SolveConfig, SolveError, Solver, Source};
use rhytid_shared::character::Drive;
use rhytid_shared::limits::MAX_HEAD_TRAVEL;
use rhytid_shared::{ARKIT_NAMES, ChannelGroup, Character, Settings};

/// Cut-off of what is not to be smoothed, Hz: a thousandth of a percent is left of the past at any frame rate.
const RAW: f64 = 1e9;

impl Solver {
    /// The settings in use.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Takes over what `change` says, which has been checked, from the next frame on. Other sides need another neutral, which is
    /// searched for and blended in.
    pub fn set(&mut self, change: &Settings) -> Result<(), SolveError> {
        let before = self.settings;
        self.settings.change(change);
        let Settings { mirror, gains, smoothing, swap_jaw, swap_mouth } = self.settings;
        let is_mirrored = mirror.unwrap_or(self.config.mirror);
        if is_mirrored != before.mirror.unwrap_or(self.config.mirror) {
            let config = SolveConfig { mirror: is_mirrored, ..self.config.clone() };
            self.landmarks = match &self.hello.layout {
                Some(layout) => Some(LandmarkSession::new(&self.character, &config, layout, &self.hello)?),
                None => None,
            };
            self.weights = WeightSession::new(&self.character, &config);
            self.weights.set_factors(&self.range_rig.of_shapes());
            self.sent_head = SentHead::new(is_mirrored);
            self.sent_calibration = None;
            self.blend = Some(self.config.calibration.blend);
        }
        let [brows, lids, _, mouth, head] = smoothing.or_one();
        let FilterConfig { brows: of_brows, eyelids: of_lids, mouth: of_mouth, head: of_head, weights } = self.config.filter;
        if let Some(landmarks) = &mut self.landmarks {
            landmarks.set_filter(&FilterConfig {
                brows: smoothed(of_brows, brows),
                eyelids: smoothed(of_lids, lids),
                mouth: smoothed(of_mouth, mouth),
                head: smoothed(of_head, head),
                weights,
            });
        }
        self.weights.set_filters([brows, lids, mouth].map(|factor| smoothed(weights, factor)));
        self.weights.set_sides(is_mirrored, swap_jaw.unwrap_or(false), swap_mouth.unwrap_or(false));
        self.amplifier.gains = gains.or_one();
        Ok(())
    }

    /// Makes the head's present pose straight ahead; false where no face has been seen yet.
    pub fn recentre(&mut self) -> bool {
        let is_done = match self.last_source {
            Some(Source::Weights | Source::Bones) => {
                self.sent_head.calibrate();
                true
            }
            _ => self.landmarks.as_mut().is_some_and(LandmarkSession::recentre),
        };
        if is_done {
            self.blend = Some(self.config.calibration.blend);
        }
        is_done
    }
}

/// A filter that smooths `factor` times as much.
fn smoothed(filter: OneEuroConfig, factor: f32) -> OneEuroConfig {
    let factor = f64::from(factor);
    if factor == 0.0 {
        return OneEuroConfig { min_cutoff: RAW, ..filter };
    }
    OneEuroConfig { min_cutoff: filter.min_cutoff / factor, beta: filter.beta / factor, ..filter }
}

/// Gains by group about the neutral face.
pub(super) struct Amplifier {
    /// In the order of `ChannelGroup::ALL`.
    gains: [f32; 5],
    bones: Vec<(ChannelGroup, Range)>,
}

/// What a bone's motion may become.
#[derive(Debug, Clone, Copy)]
enum Range {
    Free,
    /// Angle that shuts the lid.
    Lid(f32),
    /// Largest pitch and yaw.
    Angles([f32; 2]),
}

impl Amplifier {
    pub(super) fn new(character: &Character) -> Self {
        let bones = character.bones.iter().enumerate().map(|(i, bone)| {
            let range = match bone.drive {
                Drive::Lid { shut_angle, .. } => Range::Lid(shut_angle),
                Drive::Eye { range, .. } => Range::Angles([range[1], range[0]]),
                Drive::Jaw { max_angle, .. } => Range::Angles([max_angle, 0.0873]),
                Drive::Skin { .. } | Drive::Still => Range::Free,
            };
            (group_of_bone(character, i), range)
        });
        Self { gains: [1.0; 5], bones: bones.collect() }
    }

    /// Keeps bones that turn within what they can.
    pub(super) fn limit(&self, motions: &mut [glam::Vec3]) {
        for (motion, (_, range)) in motions.iter_mut().zip(&self.bones) {
            match *range {
                Range::Free => {}
                Range::Lid(shut) => {
                    if motion.x / shut > 1.0 {
                        motion.x = shut;
                    }
                }
                Range::Angles([pitch, yaw]) => {
                    motion.x = motion.x.clamp(-pitch.abs(), pitch.abs());
                    motion.y = motion.y.clamp(-yaw.abs(), yaw.abs());
                }
            }
        }
    }

    /// Applies the gains; where all are 1 no bit changes.
    pub(super) fn amplify(&self, state: &mut FaceState) {
        if self.gains == [1.0; 5] {
            return;
        }
        for (motion, (group, range)) in state.motions.iter_mut().zip(&self.bones) {
            let gain = self.gains[group.index()];
            match *range {
                Range::Free => *motion *= gain,
                // The way the lid shuts; an open eye stays as open as it is.
                Range::Lid(shut) if motion.x * shut > 0.0 => {
                    let share = (motion.x / shut * gain).min(1.0_f32.max(motion.x / shut));
                    motion.x = share * shut;
                }
                Range::Lid(_) => {}
                Range::Angles([pitch, yaw]) => {
                    motion.x = (motion.x * gain).clamp(-pitch.abs(), pitch.abs());
                    motion.y = (motion.y * gain).clamp(-yaw.abs(), yaw.abs());
                }
            }
        }
        if let Some(weights) = &mut state.weights {
            for (weight, name) in weights.iter_mut().zip(ARKIT_NAMES) {
                let group = group_of_shape(name);
                if group != ChannelGroup::Lids || name.starts_with("eyeBlink") {
                    *weight = (*weight * self.gains[group.index()]).clamp(0.0, 1.0);
                }
            }
        }
        let farthest = f64::from(MAX_HEAD_TRAVEL);
        let gain = f64::from(self.gains[ChannelGroup::Head.index()]);
        for axis in 0..3 {
            state.head[axis] *= gain;
            state.head[3 + axis] = (state.head[3 + axis] * gain).clamp(-farthest, farthest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::{DEFAULT_CHARACTER_GLB, FaceFrame, PublishMessage, PublishReader, TrackingFrame};
    use std::sync::Arc;

    /// The face after thirty frames of these weights, under these settings.
    fn face(settings: &str, weights: &str) -> (FaceFrame, Solver) {
        let character = Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap());
        let mut reader = PublishReader::new(&character);
        let mut frame = TrackingFrame::default();
        let hello = format!(r#"{{"type":"hello","version":1,"settings":{settings}}}"#);
        let Ok(PublishMessage::Hello(hello)) = reader.read(&hello, &mut frame) else { panic!("{hello}") };
        let mut out = FaceFrame::at_rest(&character);
        let mut solver = Solver::new(character, &SolveConfig::default(), &hello).unwrap();
        for i in 0..30 {
            reader.read(&format!(r#"{{"type":"frame","t":{},"weights":{weights}}}"#, f64::from(i) * 0.04), &mut frame).unwrap();
            solver.solve(&frame, &mut out).unwrap();
        }
        (out, solver)
    }

    fn weight(face: &FaceFrame, name: &str) -> f32 {
        face.shapes.unwrap()[ARKIT_NAMES.iter().position(|known| *known == name).unwrap()]
    }

    #[test]
    fn gains_swaps_and_mirror_do_what_they_say() {
        let weights = r#"{"browInnerUp":0.3,"eyeBlinkLeft":0.4,"eyeWideRight":0.4,"jawLeft":0.5,"mouthLeft":0.6}"#;
        let (plain, _) = face("{}", weights);
        assert!((weight(&plain, "browInnerUp") - 0.3).abs() < 1e-3);
        let (strong, _) = face(r#"{"gains":{"brows":2,"lids":2}}"#, weights);
        assert!((weight(&strong, "browInnerUp") - 0.6).abs() < 2e-3);
        assert!((weight(&strong, "eyeBlinkLeft") - 0.8).abs() < 2e-3);
        assert_eq!(weight(&strong, "eyeWideRight"), weight(&plain, "eyeWideRight"), "a gain of the closing range only");
        let (open, _) = face(r#"{"gains":{"lids":3}}"#, "{}");
        assert_eq!(open.points, face("{}", "{}").0.points, "no offset");
        let (swapped, _) = face(r#"{"swap_jaw":true}"#, weights);
        assert!(weight(&swapped, "jawRight") > 0.49 && weight(&swapped, "jawLeft") == 0.0 && weight(&swapped, "mouthLeft") > 0.59);
        let (mirrored, _) = face(r#"{"mirror":true,"swap_mouth":true}"#, weights);
        assert!(weight(&mirrored, "eyeBlinkRight") > 0.39 && weight(&mirrored, "jawRight") > 0.49 && weight(&mirrored, "mouthLeft") > 0.59);
    }

    #[test]
    fn smoothing_says_what_it_adds() {
        let delay = |settings: &str| face(settings, "{}").1.added_delay();
        let plain = delay("{}");
        assert!((delay(r#"{"smoothing":{"mouth":2}}"#).mouth - 2.0 * plain.mouth).abs() < 1e-9);
        assert_eq!(delay(r#"{"smoothing":{"mouth":2}}"#).brows, plain.brows);
        assert!(delay(r#"{"smoothing":{"mouth":0}}"#).mouth < 1e-9);
    }

    #[test]
    fn settings_change_at_the_next_frame() {
        let (_, mut solver) = face("{}", r#"{"jawOpen":0.4}"#);
        let mut out = FaceFrame::at_rest(&solver.character);
        let mut reader = PublishReader::for_any_character();
        let mut frame = TrackingFrame::default();
        reader.read(r#"{"type":"hello","version":1}"#, &mut frame).unwrap();
        let Ok(PublishMessage::Command(change)) = reader.read(r#"{"type":"settings","gains":{"mouth":0}}"#, &mut frame) else { panic!() };
        solver.command(&change).unwrap();
        reader.read(r#"{"type":"frame","t":2,"weights":{"jawOpen":0.4}}"#, &mut frame).unwrap();
        solver.solve(&frame, &mut out).unwrap();
        assert_eq!(weight(&out, "jawOpen"), 0.0);
    }
}
