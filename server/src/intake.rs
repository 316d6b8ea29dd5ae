//! What every publisher does with its frames, whatever it speaks: a place in a room, the solve, the packet.

use crate::pipeline::Pipeline;
use crate::recording::{Item, SessionEvent, text};
use crate::room::{Evicted, MAIN_SLOT, Publishing, RoomError};
use crate::service::Hub;
use crate::solve::{Calibration, SolveError};
use rhytid_shared::{PublishHello, PublishReader, RoomName, TrackingFrame};
use std::sync::Arc;
use tokio_tungstenite::tungstenite::{Bytes, Utf8Bytes};

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
    slot: Arc<str>,
    /// For publishers that send no messages: what would read them.
    reader: Option<(PublishReader, TrackingFrame)>,
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
    /// Claims the room for what `hello` says; `message` is the hello's text where the publisher sent one.
    pub fn begin(hub: &Hub, room: &RoomName, hello: PublishHello, message: Option<Utf8Bytes>) -> Result<Begun, IntakeError> {
        // Before the room is claimed: a hello that leads to nothing takes no room from anybody.
        let kept = hello.keep_neutral.then(|| hub.rooms.neutral(room, &hello)).flatten();
        let (mut pipeline, kept_neutral) = start(hub, &hello, kept.clone())?;
        let (place, evicted) = hub.rooms.claim(room, &hello.source, hello.takeover)?;
        pipeline.set_session(place.session);
        tracing::info!(%room, session = place.session, source = hello.source, takeover = hello.takeover, kept_neutral, "publisher ready");
        crate::service::record_by_itself(hub, &place.room);
        let reader = message.is_none().then(|| {
            let mut reader = PublishReader::new(&hub.character);
            let mut frame = TrackingFrame::default();
            // A hello made of one that was checked.
            reader.read(&text::of_hello(&hello), &mut frame).ok().map(|_| (reader, frame))
        });
        let message = message.unwrap_or_else(|| text::of_hello(&hello).into());
        let slot: Arc<str> = MAIN_SLOT.into();
        place.record(|| {
            Item::Event(SessionEvent::Start {
                session: place.session,
                slot: slot.to_string(),
                source: hello.source.clone(),
                under_way: false,
                kept_neutral: kept.filter(|_| kept_neutral).map(Box::new),
                solve: Box::new(hub.config.solve.clone()),
            })
        });
        place.record(|| Item::Text { slot: slot.clone(), t: None, text: message });
        let intake = Self { place, pipeline, hello, packet: Vec::new(), num_frames: 0, slot, reader: reader.flatten() };
        Ok(Begun { intake, evicted, kept_neutral })
    }

    /// Solves a frame and makes it the room's newest state; `message` is its text where the publisher sent one. False where another
    /// publisher has the room.
    pub fn frame(&mut self, hub: &Hub, frame: &TrackingFrame, message: Option<&Utf8Bytes>) -> Result<bool, SolveError> {
        let start = std::time::Instant::now();
        let is_recorded = self.place.is_recorded();
        let mut made = None;
        let mut solved = frame;
        if is_recorded
            && message.is_none()
            && let Some((reader, read)) = &mut self.reader
        {
            // What is recorded is solved: text may round differently than a tracker's own form.
            let text = text::of_frame(frame);
            if reader.read(&text, read).is_ok() {
                (made, solved) = (Some(Utf8Bytes::from(text)), read);
            }
        }
        if let Err(error) = self.pipeline.solve(solved) {
            if let (Some(_), Some((reader, _))) = (made, &mut self.reader) {
                reader.take_back();
            }
            return Err(error);
        }
        hub.metrics.solve_seconds.observe(start.elapsed().as_secs_f64());
        let kind = self.pipeline.encode(&mut self.packet);
        let text = made.or_else(|| message.filter(|_| is_recorded).cloned());
        let message = text.map(|text| Item::Text { slot: self.slot.clone(), t: Some(frame.t), text });
        if !self.place.publish(kind, &self.packet, self.pipeline.face(), message) {
            return Ok(false);
        }
        hub.metrics.frames_in.inc();
        self.num_frames += 1;
        Ok(true)
    }

    /// Takes the neutral face now, as `message` asks.
    pub fn calibrate(&mut self, message: Utf8Bytes) {
        self.pipeline.calibrate();
        self.place.record(|| Item::Text { slot: self.slot.clone(), t: None, text: message });
    }

    /// Keeps a message that was refused with the recording.
    pub fn refuse(&self, bytes: Bytes) {
        self.place.record(|| Item::Refused { slot: self.slot.clone(), bytes });
    }

    /// Leaves the neutral in use with the room.
    pub fn keep_neutral(&self) {
        if let Some(calibration) = self.pipeline.calibration() {
            if self.place.keep_neutral(&self.hello, calibration) {
                let (session, calibration) = (self.place.session, Box::new(calibration.clone()));
                self.place.record(|| Item::Event(SessionEvent::Neutral { session, calibration }));
            }
        }
    }

    /// The end of the session: what has refined the neutral since it was told of is kept.
    pub fn end(&self) {
        self.keep_neutral();
        self.place.record_end(self.num_frames);
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
