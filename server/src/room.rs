//! Rooms: where one publisher's packets meet any number of viewers. A room holds one state, the newest; nothing queues.

use crate::metrics::Metrics;
use crate::solve::Calibration;
use rhytid_shared::packet::{Decoder, PacketKind, PacketLayout};
use rhytid_shared::view::{CharacterHello, JsonFrame, ViewMessage};
use rhytid_shared::{FaceFrame, PublishHello, RoomName};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};
use std::time::{Duration, Instant};
use tokio::sync::{oneshot, watch};
use tokio_tungstenite::tungstenite::{Bytes, Utf8Bytes};

/// The newest state of a room, shared by all its viewers.
pub(crate) struct Latest {
    /// Counts the states of the room, over all sessions.
    pub index: u64,
    /// The key packet that decodes by itself.
    pub key: Arc<KeyPacket>,
    /// The newest packet where it is not the key packet.
    pub delta: Option<Bytes>,
    json: OnceLock<Utf8Bytes>,
}

/// A key packet with the index of its state.
pub(crate) struct KeyPacket {
    pub index: u64,
    pub bytes: Bytes,
}

impl Latest {
    /// The frame as JSON text: made once, by the first viewer that wants it.
    pub fn json(&self, layout: &PacketLayout, character: &CharacterHello) -> Utf8Bytes {
        let make = || {
            let (mut decoder, mut frame) = (Decoder::new(layout.clone()), layout.frame_at_rest());
            for packet in [Some(&self.key.bytes), self.delta.as_ref()].into_iter().flatten() {
                decoder.decode(packet, &mut frame).expect("a packet of the room's own encoder can be read");
            }
            let message = ViewMessage::Frame(JsonFrame::new(&frame, character));
            serde_json::to_string(&message).expect("plain data can be written").into()
        };
        self.json.get_or_init(make).clone()
    }
}

/// Why a room could not be entered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum RoomError {
    #[error("the server has {most} rooms already, which is its limit")]
    TooManyRooms { most: usize },
    #[error("the room has {most} viewers already, which is its limit")]
    TooManyViewers { most: usize },
    #[error("the room has a publisher already; say \"takeover\":true in the hello to take its place")]
    Taken,
}

impl RoomError {
    /// Short and stable, for programs.
    pub fn code(self) -> &'static str {
        match self {
            Self::TooManyRooms { .. } => "too_many_rooms",
            Self::TooManyViewers { .. } => "too_many_viewers",
            Self::Taken => "room_taken",
        }
    }
}

/// All rooms.
pub(crate) struct Rooms {
    by_name: Mutex<BTreeMap<RoomName, Arc<Room>>>,
    max_rooms: usize,
    max_viewers: usize,
    metrics: Arc<Metrics>,
}

/// One room.
pub(crate) struct Room {
    pub name: RoomName,
    slot: watch::Sender<Option<Arc<Latest>>>,
    state: Mutex<RoomState>,
    metrics: Arc<Metrics>,
}

struct RoomState {
    publisher: Option<Publisher>,
    /// Publishers so far.
    num_sessions: u32,
    num_viewers: usize,
    num_states: u64,
    key: Option<Arc<KeyPacket>>,
    /// What the listing shows of the newest frame.
    shown: Option<(u32, u64, bool)>,
    neutral: Option<Neutral>,
    empty_since: Instant,
}

/// The neutral face that a session came to: kept so that a publisher which comes back need not be searched again.
struct Neutral {
    session: u32,
    /// Whose it is.
    hello: PublishHello,
    calibration: Calibration,
}

struct Publisher {
    session: u32,
    source: String,
    since: Instant,
    evict: oneshot::Sender<()>,
}

/// A room as `/api/rooms` lists it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct RoomListing {
    name: String,
    viewers: usize,
    /// Publishers the room has had.
    session: u32,
    publisher: Option<PublisherListing>,
    frame: Option<FrameListing>,
    /// The neutral face that the room keeps.
    neutral: Option<NeutralListing>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct PublisherListing {
    source: String,
    seconds: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct FrameListing {
    seq: u32,
    t: f64,
    face: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct NeutralListing {
    /// The session that came to it, and the time on its sender's clock, seconds.
    session: u32,
    t: f64,
    /// Frames it is the median of.
    num_frames: usize,
    /// The publisher asked for it.
    requested: bool,
}

/// A lock that a panicking holder left is still whole: every change under it is complete at each step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

impl Rooms {
    pub fn new(max_rooms: usize, max_viewers: usize, metrics: Arc<Metrics>) -> Self {
        Self { by_name: Mutex::default(), max_rooms, max_viewers, metrics }
    }

    /// Enters a room as a viewer; the room is made where there is none.
    pub fn join(&self, name: &RoomName) -> Result<Viewing, RoomError> {
        let mut by_name = lock(&self.by_name);
        let room = self.find_or_make(&mut by_name, name)?;
        let mut state = lock(&room.state);
        if state.num_viewers >= self.max_viewers {
            return Err(RoomError::TooManyViewers { most: self.max_viewers });
        }
        state.num_viewers += 1;
        drop(state);
        self.metrics.viewers.inc();
        Ok(Viewing { slot: room.slot.subscribe(), room })
    }

    /// Enters a room as its publisher, in place of another one where `takeover` says so. What comes with the place says when
    /// another takes it.
    pub fn claim(&self, name: &RoomName, source: &str, takeover: bool) -> Result<(Publishing, Evicted), RoomError> {
        let mut by_name = lock(&self.by_name);
        let room = self.find_or_make(&mut by_name, name)?;
        let mut state = lock(&room.state);
        if state.publisher.is_some() && !takeover {
            return Err(RoomError::Taken);
        }
        let (evict, evicted) = oneshot::channel();
        state.num_sessions = state.num_sessions.wrapping_add(1).max(1);
        let session = state.num_sessions;
        let before = state.publisher.replace(Publisher { session, source: source.to_owned(), since: Instant::now(), evict });
        drop(state);
        if let Some(before) = before {
            // Its task may have ended in this moment; then nobody needs to be told.
            let _ = before.evict.send(());
        } else {
            self.metrics.publishers.inc();
        }
        Ok((Publishing { room, session }, evicted))
    }

    fn find_or_make(&self, by_name: &mut BTreeMap<RoomName, Arc<Room>>, name: &RoomName) -> Result<Arc<Room>, RoomError> {
        if let Some(room) = by_name.get(name) {
            return Ok(room.clone());
        }
        if by_name.len() >= self.max_rooms {
            return Err(RoomError::TooManyRooms { most: self.max_rooms });
        }
        let room = Arc::new(Room {
            name: name.clone(),
            slot: watch::Sender::new(None),
            state: Mutex::new(RoomState {
                publisher: None,
                num_sessions: 0,
                num_viewers: 0,
                num_states: 0,
                key: None,
                shown: None,
                neutral: None,
                empty_since: Instant::now(),
            }),
            metrics: self.metrics.clone(),
        });
        by_name.insert(name.clone(), room.clone());
        self.metrics.rooms.set(by_name.len() as i64);
        Ok(room)
    }

    /// The neutral face that the room keeps of the tracker of `hello`.
    pub fn neutral(&self, name: &RoomName, hello: &PublishHello) -> Option<Calibration> {
        let room = lock(&self.by_name).get(name).cloned()?;
        let state = lock(&room.state);
        state.neutral.as_ref().filter(|kept| kept.hello.is_of_same_tracker(hello)).map(|kept| kept.calibration.clone())
    }

    /// Removes rooms that have been without publisher and viewers for `idle`.
    pub fn sweep(&self, idle: Duration) {
        let mut by_name = lock(&self.by_name);
        by_name.retain(|_, room| {
            let state = lock(&room.state);
            state.publisher.is_some() || state.num_viewers > 0 || state.empty_since.elapsed() < idle
        });
        self.metrics.rooms.set(by_name.len() as i64);
    }

    /// Wakes every viewer as a new state would: they look whether the service ends.
    pub fn wake_viewers(&self) {
        for room in lock(&self.by_name).values() {
            room.slot.send_modify(|_| {});
        }
    }

    /// All rooms, by name.
    pub fn list(&self) -> Vec<RoomListing> {
        let rooms: Vec<Arc<Room>> = lock(&self.by_name).values().cloned().collect();
        rooms.iter().map(|room| room.listing()).collect()
    }
}

impl Room {
    fn listing(&self) -> RoomListing {
        let state = lock(&self.state);
        RoomListing {
            name: self.name.to_string(),
            viewers: state.num_viewers,
            session: state.num_sessions,
            publisher: state
                .publisher
                .as_ref()
                .map(|publisher| PublisherListing { source: publisher.source.clone(), seconds: publisher.since.elapsed().as_secs_f64() }),
            frame: state.shown.map(|(seq, micros, face)| FrameListing { seq, t: micros as f64 / 1e6, face }),
            neutral: state.neutral.as_ref().map(|Neutral { session, calibration, .. }| NeutralListing {
                session: *session,
                t: calibration.t,
                num_frames: calibration.num_frames,
                requested: calibration.requested,
            }),
        }
    }
}

/// A viewer's place in a room; given back on drop.
pub(crate) struct Viewing {
    pub room: Arc<Room>,
    /// The newest state.
    pub slot: watch::Receiver<Option<Arc<Latest>>>,
}

impl Drop for Viewing {
    fn drop(&mut self) {
        let mut state = lock(&self.room.state);
        state.num_viewers -= 1;
        state.empty_since = Instant::now();
        self.room.metrics.viewers.dec();
    }
}

/// A publisher's place in a room; given back on drop, unless another has taken it over.
pub(crate) struct Publishing {
    pub room: Arc<Room>,
    /// Number of this session in its room, from 1.
    pub session: u32,
}

/// Done when another publisher has taken the place.
pub(crate) type Evicted = oneshot::Receiver<()>;

impl Publishing {
    /// Makes `packet` the room's newest state. False where another publisher has the room.
    pub fn publish(&self, kind: PacketKind, packet: &[u8], face: &FaceFrame) -> bool {
        let mut state = lock(&self.room.state);
        if state.publisher.as_ref().is_none_or(|publisher| publisher.session != self.session) {
            return false;
        }
        state.num_states += 1;
        let index = state.num_states;
        let bytes = Bytes::copy_from_slice(packet);
        let (key, delta) = match (kind, &state.key) {
            (PacketKind::Delta, Some(key)) => (key.clone(), Some(bytes)),
            _ => (Arc::new(KeyPacket { index, bytes }), None),
        };
        state.key = Some(key.clone());
        state.shown = Some((face.seq, face.captured_at_micros, face.face));
        // Under the lock, so that states stand in the slot in their order.
        self.room.slot.send_replace(Some(Arc::new(Latest { index, key, delta, json: OnceLock::new() })));
        true
    }

    /// Makes `calibration` the neutral face that the room keeps, unless a later session has left one or it is kept already.
    pub fn keep_neutral(&self, hello: &PublishHello, calibration: &Calibration) {
        let mut state = lock(&self.room.state);
        if state.neutral.as_ref().is_none_or(|kept| kept.session <= self.session && kept.calibration != *calibration) {
            state.neutral = Some(Neutral { session: self.session, hello: hello.clone(), calibration: calibration.clone() });
        }
    }
}

impl Drop for Publishing {
    fn drop(&mut self) {
        let mut state = lock(&self.room.state);
        if state.publisher.as_ref().is_some_and(|publisher| publisher.session == self.session) {
            state.publisher = None;
            state.empty_since = Instant::now();
            self.room.metrics.publishers.dec();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rooms(max_rooms: usize, max_viewers: usize) -> Rooms {
        Rooms::new(max_rooms, max_viewers, Arc::new(Metrics::new()))
    }

    fn name(text: &str) -> RoomName {
        RoomName::new(text).unwrap()
    }

    #[test]
    fn a_room_has_one_publisher_and_takeover_replaces_it() {
        let rooms = rooms(10, 10);
        let (first, mut evicted) = rooms.claim(&name("a"), "one", false).unwrap();
        assert_eq!(rooms.claim(&name("a"), "two", false).err(), Some(RoomError::Taken));
        let (second, _evicted) = rooms.claim(&name("a"), "two", true).unwrap();
        assert_eq!((first.session, second.session), (1, 2));
        assert_eq!(evicted.try_recv(), Ok(()));
        drop(first);
        assert_eq!(rooms.claim(&name("a"), "three", false).err(), Some(RoomError::Taken), "the old one's end frees nothing");
        drop(second);
        assert_eq!(rooms.claim(&name("a"), "three", false).unwrap().0.session, 3);
        assert_eq!(rooms.metrics.publishers.get(), 0);
    }

    #[test]
    fn limits_hold_and_idle_rooms_go() {
        let rooms = rooms(2, 1);
        let viewer = rooms.join(&name("a")).unwrap();
        assert_eq!(rooms.join(&name("a")).err(), Some(RoomError::TooManyViewers { most: 1 }));
        let publisher = rooms.claim(&name("b"), "", false).unwrap();
        assert_eq!(rooms.join(&name("c")).err(), Some(RoomError::TooManyRooms { most: 2 }));
        rooms.sweep(Duration::ZERO);
        assert_eq!((rooms.list().len(), rooms.metrics.rooms.get(), rooms.metrics.viewers.get()), (2, 2, 1));
        drop((viewer, publisher));
        rooms.sweep(Duration::from_secs(60));
        assert_eq!(rooms.list().len(), 2, "an empty room waits");
        rooms.sweep(Duration::ZERO);
        assert_eq!((rooms.list().len(), rooms.metrics.rooms.get(), rooms.metrics.viewers.get()), (0, 0, 0));
    }
}
