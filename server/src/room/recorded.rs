//! What recordings keep of a room.

use super::{Publisher, Room, RoomState, Rooms, lock};
use crate::recording::{Item, RecordError, RecorderStatus, SessionEvent, Sink};
use std::sync::Arc;

impl Rooms {
    /// Begins the recording of a room that is recorded without being asked to. Waits for nothing.
    pub(super) fn record_by_itself(&self, room: &Room, state: &mut RoomState) {
        match self.recorder.start(&room.name, room.since) {
            Ok((sink, _)) => room.begin_recording(state, sink),
            Err(error) => {
                self.metrics.recording_failures.inc();
                tracing::error!(room = %room.name, %error, "the room is not recorded");
            }
        }
    }
}

impl RoomState {
    /// True while what happens is recorded.
    pub(super) fn is_recorded(&self) -> bool {
        self.recording.as_ref().is_some_and(|sink| !sink.has_ended())
    }
}

impl Publisher {
    /// What a recording says of its end.
    pub(super) fn end(&self) -> Item {
        Item::Event(SessionEvent::End { session: self.session, frames: self.num_frames })
    }
}

impl Room {
    /// Records what `item` gives, where the room is recorded.
    pub(super) fn record(&self, state: &RoomState, item: impl FnOnce() -> Item) {
        if let Some(sink) = &state.recording {
            sink.put(self.nanos(), item());
        }
    }

    /// True while what happens here is recorded.
    pub fn is_recorded(&self) -> bool {
        lock(&self.state).is_recorded()
    }

    /// Records into `sink` from now on.
    pub fn record_into(&self, sink: Arc<Sink>) -> Result<(), RecordError> {
        let mut state = lock(&self.state);
        if state.is_recorded() {
            return Err(RecordError::Running);
        }
        self.begin_recording(&mut state, sink);
        Ok(())
    }

    /// Publishers that are there are noted as under way, with the state that their packets refer to.
    fn begin_recording(&self, state: &mut RoomState, sink: Arc<Sink>) {
        for Publisher { session, claim, .. } in &state.publishers {
            let event = SessionEvent::Start {
                session: *session,
                slot: claim.slot.name.clone(),
                source: claim.source.clone(),
                under_way: true,
                kept_neutral: None,
                profile: None,
                solve: None,
            };
            sink.put(self.nanos(), Item::Event(event));
        }
        if let Some(key) = state.key.as_ref().filter(|_| !state.publishers.is_empty()) {
            sink.put(self.nanos(), Item::Packet(key.bytes.clone()));
        }
        state.recording = Some(sink);
    }

    /// How its recording stands.
    pub fn recording(&self) -> Option<RecorderStatus> {
        lock(&self.state).recording.as_ref().map(|sink| sink.status())
    }

    /// Ends the recording; its file is finished by its own thread.
    pub fn end_recording(&self) -> Option<RecorderStatus> {
        let sink = lock(&self.state).recording.take()?;
        sink.put(self.nanos(), Item::Event(SessionEvent::Stop { reason: "asked to".into() }));
        Some(sink.status())
    }
}
