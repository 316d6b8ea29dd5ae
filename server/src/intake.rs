//! What every publisher does with its frames, whatever it speaks: a place in a room, the solve, the packet.

use crate::pipeline::Pipeline;
use crate::room::{Evicted, Publishing, RoomError};
use crate::service::Hub;
use crate::solve::{Calibration, SolveError};
use rhytid_shared::{PublishHello, RoomName, TrackingFrame};

/// Why a publisher could not start.
#[derive(Debug, thiserror::Error)]
pub(crate) enum IntakeError {
    /// The hello does not fit the character.
    #[error("hello: {0}")]
    Hello(#[from] SolveError),
    /// The room cannot be had.
    #[error(transparent)]
    Room(#[from] RoomError),
}

/// One publisher's session in a room; it leaves on drop.
pub(crate) struct Intake {
    pub place: Publishing,
    pub pipeline: Pipeline,
    hello: PublishHello,
    packet: Vec<u8>,
    pub num_frames: u64,
}

/// A session that has begun.
pub(crate) struct Begun {
    pub intake: Intake,
    /// Done when another publisher has taken the room.
    pub evicted: Evicted,
    /// The session starts from the neutral face that the room has kept.
    pub kept_neutral: bool,
}

impl Intake {
    /// Claims the room for what `hello` says.
    pub fn begin(hub: &Hub, room: &RoomName, hello: PublishHello) -> Result<Begun, IntakeError> {
        // Before the room is claimed: a hello that leads to nothing takes no room from anybody.
        let kept = hello.keep_neutral.then(|| hub.rooms.neutral(room, &hello)).flatten();
        let (mut pipeline, kept_neutral) = start(hub, &hello, kept)?;
        let (place, evicted) = hub.rooms.claim(room, &hello.source, hello.takeover)?;
        pipeline.set_session(place.session);
        tracing::info!(%room, session = place.session, source = hello.source, takeover = hello.takeover, kept_neutral, "publisher ready");
        Ok(Begun { intake: Self { place, pipeline, hello, packet: Vec::new(), num_frames: 0 }, evicted, kept_neutral })
    }

    /// Solves a frame and makes it the room's newest state. False where another publisher has the room.
    pub fn frame(&mut self, hub: &Hub, frame: &TrackingFrame) -> Result<bool, SolveError> {
        let start = std::time::Instant::now();
        self.pipeline.solve(frame)?;
        hub.metrics.solve_seconds.observe(start.elapsed().as_secs_f64());
        let kind = self.pipeline.encode(&mut self.packet);
        if !self.place.publish(kind, &self.packet, self.pipeline.face()) {
            return Ok(false);
        }
        hub.metrics.frames_in.inc();
        self.num_frames += 1;
        Ok(true)
    }

    /// Leaves the neutral in use with the room.
    pub fn keep_neutral(&self) {
        if let Some(calibration) = self.pipeline.calibration() {
            self.place.keep_neutral(&self.hello, calibration);
        }
    }

    /// The end of the session: what has refined the neutral since it was told of is kept.
    pub fn end(&self) {
        self.keep_neutral();
        tracing::info!(room = %self.place.room.name, session = self.place.session, frames = self.num_frames, "publisher gone");
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
