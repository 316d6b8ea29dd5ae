//! One source of a room, whatever it speaks, a WebSocket or a tracker's datagrams: frame in → solve → mix → room.

use crate::pipeline::Pipeline;
use crate::recording::{Item, SessionEvent, text};
use crate::room::{Evicted, Publishing, RoomError, SlotClaim};
use crate::service::Hub;
use crate::solve::{Calibration, CalibrationReport, DelayReport, SolveError};
use rhytid_shared::{PublishHello, PublishReader, RoomName, Settings, TrackingFrame};
use std::sync::Arc;
use tokio_tungstenite::tungstenite::{Bytes, Utf8Bytes};

/// A message as its publisher sent it.
#[derive(Debug, Clone)]
pub(crate) enum Sent {
    Text(Utf8Bytes),
    Binary(Bytes),
}

impl Sent {
    fn taken(self, slot: Arc<str>, t: Option<f64>) -> Item {
        match self {
            Self::Text(text) => Item::Text { slot, t, text },
            Self::Binary(bytes) => Item::Binary { slot, t, bytes },
        }
    }
}

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
    /// Its slot's name.
    slot: Arc<str>,
    /// For publishers that send no messages: what would read them.
    reader: Option<(PublishReader, TrackingFrame)>,
    /// It started from the neutral face that the room had kept.
    pub kept_neutral: bool,
}

impl Source {
    /// Claims the slot that `hello` names; `sent` is the hello's text where the publisher sent one. The second value is done when another
    /// publisher has taken it over.
    pub fn open(hub: &Hub, room: &RoomName, hello: PublishHello, sent: Option<Utf8Bytes>) -> Result<(Self, Evicted), OpenError> {
        // Before the slot is claimed: a hello that leads to nothing takes no slot from anybody.
        let kept = hello.keep_neutral.then(|| hub.rooms.neutral(room, &hello)).flatten();
        let (mut pipeline, kept_neutral) = start(hub, &hello, kept.clone())?;
        let slot: Arc<str> = hello.slot.name.as_str().into();
        let reader = sent.is_none().then(|| {
            let mut reader = PublishReader::new(&hub.character);
            let mut frame = TrackingFrame::default();
            // A hello made of one that was checked.
            reader.read(&text::of_hello(&hello), &mut frame).ok().map(|_| (reader, frame))
        });
        let recorded = |session| {
            let start = SessionEvent::Start {
                session,
                slot: slot.to_string(),
                source: hello.source.clone(),
                under_way: false,
                kept_neutral: kept.filter(|_| kept_neutral).map(Box::new),
                solve: Some(Box::new(hub.config.solve.clone())),
            };
            let text = sent.unwrap_or_else(|| text::of_hello(&hello).into());
            vec![Item::Event(start), Item::Text { slot: slot.clone(), t: None, text }]
        };
        let (place, evicted) = hub.rooms.claim(room, SlotClaim::of(&hello), recorded)?;
        pipeline.set_session(place.session);
        let session = place.session;
        tracing::info!(%room, session, source = hello.source, slot = %slot, takeover = hello.takeover, kept_neutral, "publisher ready");
        Ok((Self { place, pipeline, hello, num_frames: 0, slot, reader: reader.flatten(), kept_neutral }, evicted))
    }

    /// Solves a frame and puts it into the room; `sent` is its message where the publisher sent one.
    pub fn frame(&mut self, hub: &Hub, frame: &TrackingFrame, sent: Option<Sent>) -> Result<(), FrameError> {
        let start = std::time::Instant::now();
        let (mut made, mut solved) = (None, frame);
        if sent.is_none()
            && self.place.room.is_recorded()
            && let Some((reader, read)) = &mut self.reader
        {
            // What is recorded is solved: text may round differently than a tracker's own form.
            let text = text::of_frame(frame);
            if reader.read(&text, read).is_ok() {
                (made, solved) = (Some(Sent::Text(text.into())), read);
            }
        }
        if let Err(error) = self.pipeline.solve(solved) {
            if let (Some(_), Some((reader, _))) = (made, &mut self.reader) {
                reader.take_back();
            }
            return Err(error.into());
        }
        hub.metrics.solve_seconds.observe(start.elapsed().as_secs_f64());
        let message = made.or(sent).map(|sent| sent.taken(self.slot.clone(), Some(frame.t)));
        if !self.place.publish(self.pipeline.face(), message) {
            return Err(FrameError::Evicted);
        }
        hub.metrics.frames_in.inc();
        self.num_frames += 1;
        Ok(())
    }

    /// Keeps with the recording a message that is no frame and was taken.
    pub fn record_taken(&self, sent: Sent) {
        self.place.record(|| sent.taken(self.slot.clone(), None));
    }

    /// Keeps with the recording a message that was refused.
    pub fn record_refused(&self, sent: Sent) {
        let bytes = match sent {
            Sent::Text(text) => text.into(),
            Sent::Binary(bytes) => bytes,
        };
        self.place.record(|| Item::Refused { slot: self.slot.clone(), bytes });
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
