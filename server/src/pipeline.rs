//! One publish session's way from tracking frames to packets: the solve, then the encoder. No clock, no I/O: the packets
//! depend on the feed alone, so the same feed gives the same bytes at any speed.

use crate::solve::{Calibration, CalibrationReport, DelayReport, SolveConfig, SolveError, Solver};
use rhytid_shared::packet::{Encoder, PacketKind};
use rhytid_shared::{Character, Command, FaceFrame, PublishHello, TrackingFrame};
use std::sync::Arc;

/// Solves and encodes the frames of one session.
pub struct Pipeline {
    solver: Solver,
    encoder: Encoder,
    face: FaceFrame,
    session: u32,
    num_frames: u32,
}

impl Pipeline {
    /// Starts session number `session` (from 1) of a room.
    pub fn new(character: Arc<Character>, config: &SolveConfig, hello: &PublishHello, session: u32) -> Result<Self, SolveError> {
        Ok(Self::of(Solver::new(Arc::clone(&character), config, hello)?, &character, session))
    }

    /// As [`Self::new`], with the neutral of an earlier session (see [`Self::calibration`]) in place of the search for one.
    pub fn with_calibration(
        character: Arc<Character>,
        config: &SolveConfig,
        hello: &PublishHello,
        session: u32,
        calibration: Calibration,
    ) -> Result<Self, SolveError> {
        Ok(Self::of(Solver::with_calibration(Arc::clone(&character), config, hello, calibration)?, &character, session))
    }

    fn of(solver: Solver, character: &Character, session: u32) -> Self {
        Self { encoder: Encoder::new(character), face: FaceFrame::at_rest(character), solver, session, num_frames: 0 }
    }

    /// Numbers the session, where its number is known only after the pipeline stands.
    pub(crate) fn set_session(&mut self, session: u32) {
        self.session = session;
    }

    /// Solves `frame` and writes its packet into `packet`, which is emptied first. Every frame that the solve takes gives one
    /// packet.
    pub fn frame(&mut self, frame: &TrackingFrame, packet: &mut Vec<u8>) -> Result<PacketKind, SolveError> {
        self.solve(frame)?;
        Ok(self.encode(packet))
    }

    /// The first half of [`Self::frame`].
    pub(crate) fn solve(&mut self, frame: &TrackingFrame) -> Result<(), SolveError> {
        self.solver.solve(frame, &mut self.face)?;
        self.face.session = self.session;
        self.face.seq = self.num_frames;
        self.num_frames = self.num_frames.wrapping_add(1);
        Ok(())
    }

    /// The second half of [`Self::frame`]; in a room the room encodes.
    fn encode(&mut self, packet: &mut Vec<u8>) -> PacketKind {
        self.encoder.encode(&self.face, packet)
    }

    /// Takes the neutral face now.
    pub fn calibrate(&mut self) {
        self.solver.calibrate();
    }

    /// Does what a feed's command says.
    pub fn command(&mut self, command: &Command) -> Result<(), SolveError> {
        self.solver.command(command)
    }

    /// The solve itself: settings, profile, fit.
    pub(crate) fn solver(&mut self) -> &mut Solver {
        &mut self.solver
    }

    /// A neutral that has been reached since the last call.
    pub fn take_calibrated(&mut self) -> Option<CalibrationReport> {
        self.solver.take_calibrated()
    }

    /// The neutral in use, once one has been reached: kept with a session, a part of it can be replayed exactly.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.solver.calibration()
    }

    /// What the smoothing adds now.
    pub fn added_delay(&self) -> DelayReport {
        self.solver.added_delay()
    }

    /// The frame last solved.
    pub fn face(&self) -> &FaceFrame {
        &self.face
    }
}
