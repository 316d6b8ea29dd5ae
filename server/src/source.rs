//! One source of a room, whatever it speaks, a WebSocket or a tracker's datagrams: frame in → solve → mix → room.

use crate::pipeline::Pipeline;
use crate::room::{Evicted, Publishing, RoomError, SlotClaim};
use crate::service::Hub;
use crate::solve::{Calibration, CalibrationReport, DelayReport, SolveError};
use rhytid_shared::{PublishHello, RoomName, Settings, TrackingFrame};

/// Why a source could not enter a room.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OpenError {
    /// The hello's layout, camera or settings make no sense.
    #[error("hello: {0}")]
    Hello(#[from] SolveError),
    /// The room or the slot has no place.
    #[error(transparent)]
    Room(#[from] RoomError),
}

/// Why a frame was not taken.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameError {
    /// It counts for nothing; the source is as before.
    #[error(transparent)]
    Bad(#[from] SolveError),
    /// Another publisher has taken the slot over: the source is over.
    #[error("another publisher has taken the room over")]
    Evicted,
}

/// A source that has claimed its slot; gives it back on drop.
pub(crate) struct Source {
    place: Publishing,
    pipeline: Pipeline,
    hello: PublishHello,
    num_frames: u64,
    /// It started from the neutral face that the room had kept.
    pub kept_neutral: bool,
}

impl Source {
    /// Claims the slot that `hello` names. The second value is done when another publisher has taken it over.
    pub fn open(hub: &Hub, room: &RoomName, hello: PublishHello) -> Result<(Self, Evicted), OpenError> {
        // Before the slot is claimed: a hello that leads to nothing takes no slot from anybody.
        let kept = hello.keep_neutral.then(|| hub.rooms.neutral(room, &hello)).flatten();
        let (mut pipeline, kept_neutral) = start(hub, &hello, kept)?;
        let (place, evicted) = hub.rooms.claim(room, SlotClaim::of(&hello))?;
        pipeline.set_session(place.session);
        let (session, slot) = (place.session, &hello.slot.name);
        tracing::info!(%room, session, source = hello.source, slot, takeover = hello.takeover, kept_neutral, "publisher ready");
        Ok((Self { place, pipeline, hello, num_frames: 0, kept_neutral }, evicted))
    }

    /// Solves a frame and puts it into the room.
    pub fn frame(&mut self, hub: &Hub, frame: &TrackingFrame) -> Result<(), FrameError> {
        let start = std::time::Instant::now();
        self.pipeline.solve(frame)?;
        hub.metrics.solve_seconds.observe(start.elapsed().as_secs_f64());
        if !self.place.publish(self.pipeline.face()) {
            return Err(FrameError::Evicted);
        }
        hub.metrics.frames_in.inc();
        self.num_frames += 1;
        Ok(())
    }

    /// Takes the neutral face now.
    pub fn calibrate(&mut self) {
        self.pipeline.calibrate();
    }

    /// Takes over some settings from the next frame on.
    pub fn set(&mut self, change: &Settings) -> Result<(), SolveError> {
        self.pipeline.set(change)
    }

    /// The settings in use.
    pub fn settings(&self) -> &Settings {
        self.pipeline.settings()
    }

    /// Makes the head's present pose straight ahead; false where no face has been seen yet.
    pub fn recentre(&mut self) -> bool {
        self.pipeline.recentre()
    }

    /// A neutral that has been reached since the last call; it is left with the room.
    pub fn take_calibrated(&mut self) -> Option<CalibrationReport> {
        let report = self.pipeline.take_calibrated()?;
        self.keep_neutral();
        Some(report)
    }

    /// Leaves the neutral in use with the room.
    fn keep_neutral(&self) {
        if let Some(calibration) = self.pipeline.calibration() {
            self.place.keep_neutral(&self.hello, calibration);
        }
    }

    /// What the smoothing adds now.
    pub fn added_delay(&self) -> DelayReport {
        self.pipeline.added_delay()
    }

    /// Number of this session in its room, from 1.
    pub fn session(&self) -> u32 {
        self.place.session
    }

    /// The room.
    pub fn room(&self) -> &RoomName {
        &self.place.room.name
    }
}

impl Drop for Source {
    /// What has refined the neutral since it was told of is kept.
    fn drop(&mut self) {
        self.keep_neutral();
        tracing::info!(room = %self.room(), session = self.session(), frames = self.num_frames, "publisher gone");
    }
}

/// The session's pipeline, and whether it starts from the `kept` neutral face.
fn start(hub: &Hub, hello: &PublishHello, kept: Option<Calibration>) -> Result<(Pipeline, bool), SolveError> {
    let (character, config) = (&hub.character, &hub.config.solve);
    // A neutral of weights does not fit a sender that has a layout too: its landmarks have none yet.
    if let Some(pipeline) = kept.and_then(|kept| Pipeline::with_calibration(character.clone(), config, hello, 0, kept).ok()) {
        return Ok((pipeline, true));
    }
    Ok((Pipeline::new(character.clone(), config, hello, 0)?, false))
}
