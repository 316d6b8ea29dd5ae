//! What recordings keep of a room.

use super::{Publisher, Room, RoomState, Rooms, lock};
use crate::recording::{Item, Made, RecordError, Recorder, RecorderStatus, SessionEvent, Sink};
use rhytid_shared::Slot;
use std::sync::Arc;
use std::time::Instant;
use tokio_tungstenite::tungstenite::Bytes;

/// What sources at another node are called in a recording.
const ELSEWHERE: &str = "another node";
/// Why a recording that nobody asked for ends where its room has moved: the new home records it as this one did. One that somebody
/// asked for goes on with the packets that come from there.
pub(super) const ELSEWHERE_NOW: &str = "another node is the room's home now";

impl Rooms {
    /// Begins the recording of a room that is recorded without being asked to. Waits for nothing.
    pub(super) fn record_by_itself(&self, room: &Room, state: &mut RoomState) {
        match self.recorder.start(&room.name, room.since) {
            Ok((sink, _)) => {
                room.begin_recording(state, sink);
                state.records_by_itself = true;
            }
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

    /// Somebody watches or records it here.
    pub(super) fn is_wanted(&self) -> bool {
        self.num_viewers > 0 || self.is_recorded()
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

    /// Begins a recording that somebody has asked for. Waits for nothing: whether its file is there is told later.
    pub fn record_with(&self, recorder: &Recorder) -> Result<Made, RecordError> {
        let mut state = lock(&self.state);
        if state.is_recorded() {
            return Err(RecordError::Running);
        }
        // Under the lock: of two who ask at once, the second leaves no file.
        let (sink, made) = recorder.start(&self.name, self.since)?;
        self.begin_recording(&mut state, sink);
        state.records_by_itself = false;
        drop(state);
        if let Some(interest) = &self.interest {
            // Where its home is elsewhere, its packets are asked for.
            interest.send_replace(());
        }
        Ok(made)
    }

    /// Sessions that are there are noted as under way, with the state that their packets refer to.
    fn begin_recording(&self, state: &mut RoomState, sink: Arc<Sink>) {
        for Publisher { session, claim, .. } in &state.publishers {
            sink.put(self.nanos(), Item::under_way(*session, &claim.slot.name, &claim.source));
        }
        let fed = state.fed.as_ref().filter(|_| !state.is_home).map(|fed| fed.frame.session);
        if let Some(session) = fed {
            sink.put(self.nanos(), Item::under_way(session, Slot::MAIN, ELSEWHERE));
        }
        if let Some(key) = state.key.as_ref().filter(|_| !state.publishers.is_empty() || fed.is_some()) {
            sink.put(self.nanos(), Item::Packet(key.framed.to_payload()));
        }
        state.fed_session = fed.map(|session| (session, 0));
        state.recording = Some(sink);
    }

    /// Records a packet of `session` that came from the room's home at another node, where the room is recorded.
    pub(super) fn record_fed(&self, state: &mut RoomState, session: u32, packet: Bytes) {
        // Its lease may be heard of after its packets.
        self.end_recording_by_itself(state, ELSEWHERE_NOW);
        if !state.is_recorded() {
            return;
        }
        let before = state.fed_session.filter(|(before, _)| *before == session);
        if before.is_none() {
            self.end_fed(state);
            self.record(state, || Item::under_way(session, Slot::MAIN, ELSEWHERE));
        }
        self.record(state, || Item::Packet(packet));
        state.fed_session = Some((session, before.map_or(0, |(_, frames)| frames) + 1));
        // A room of which something is recorded stays, though nobody watches it here.
        state.empty_since = Instant::now();
    }

    /// Packets of other nodes are over, for the recording: what is published here can be solved again.
    pub(super) fn end_fed(&self, state: &mut RoomState) {
        if let Some((session, frames)) = state.fed_session.take() {
            self.record(state, || Item::Event(SessionEvent::End { session, frames }));
        }
    }

    /// Ends a recording that nobody asked for.
    pub(super) fn end_recording_by_itself(&self, state: &mut RoomState, reason: &str) {
        if state.records_by_itself
            && let Some(sink) = state.recording.take()
        {
            sink.put(self.nanos(), Item::Event(SessionEvent::Stop { reason: reason.into() }));
        }
    }

    /// Ends a recording that nobody asked for where nobody but players is left: what is played is recorded only where somebody asks
    /// for that.
    pub(super) fn end_recording_of_replay(&self, state: &mut RoomState) {
        if state.publishers.iter().all(|publisher| publisher.claim.is_replay) {
            self.end_recording_by_itself(state, "a recording is played in the room");
        }
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
