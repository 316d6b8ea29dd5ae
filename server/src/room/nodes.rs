//! Rooms among nodes: which of them is a room's home, what goes to the others and what comes from them.

use super::recorded::ELSEWHERE_NOW;
use super::{KeyPacket, Latest, MAX_SLOTS, Neutral, Room, RoomError, RoomState, Rooms, lock};
use crate::cluster::{Kept, Outlet, StateHead};
use crate::framed::Framed;
use rhytid_shared::packet::{Decoder, PacketKind};
use rhytid_shared::{FaceFrame, Resume, RoomName};
use std::collections::HashMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_tungstenite::tungstenite::Bytes;

/// Packets go to other nodes for so long after one of them has told that it watches, which each does twice a second.
const WANTED_FOR: Duration = Duration::from_secs(3);

/// What rooms need of other nodes.
pub(crate) struct Others {
    /// Where packets leave for them.
    pub outlet: Outlet,
    /// Told when a room's first viewer comes, or its last one goes.
    pub interest: watch::Sender<()>,
}

/// The newest state that came from another node.
pub(super) struct FedState {
    head: StateHead,
    /// Epoch and index of the key packet that its deltas need.
    key: (u64, u64),
    decoder: Decoder,
    pub(super) frame: FaceFrame,
}

/// What became of another node's packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fed {
    /// It is the room's newest state.
    Taken,
    /// It is no newer than what has been shown, or this node is the home.
    Old,
    /// It needs a key packet that did not come.
    NeedsKey,
    /// It cannot be read.
    Broken,
}

impl Rooms {
    /// Whether there is a room of this name, or could be.
    pub fn has_place(&self, name: &RoomName) -> Result<(), RoomError> {
        let by_name = lock(&self.by_name);
        if by_name.contains_key(name) { Ok(()) } else { self.check_place(&by_name) }
    }

    /// True where something is kept of a room's slot.
    pub fn has_kept(&self, name: &RoomName, slot: &str) -> bool {
        self.find(name).is_some_and(|room| lock(&room.state).neutrals.contains_key(slot))
    }

    /// Gives `take` what is kept of each slot of a room whose home this node is, and whether somebody has the slot. Nothing newer is
    /// kept meanwhile.
    pub fn each_kept(&self, name: &RoomName, mut take: impl FnMut(&str, &Kept, bool)) {
        let Some(room) = self.find(name) else { return };
        let state = lock(&room.state);
        for (slot, neutral) in state.neutrals.iter().filter(|_| state.is_home) {
            take(slot, &neutral.kept, state.publishers.iter().any(|publisher| publisher.claim.slot.name == *slot));
        }
    }

    /// Takes over what other nodes keep of a room's slot.
    pub fn restore(&self, name: &RoomName, slot: &str, kept: Kept) {
        let Ok(room) = self.find_or_make(&mut lock(&self.by_name), name) else { return };
        let mut state = lock(&room.state);
        if state.neutrals.len() < MAX_SLOTS || state.neutrals.contains_key(slot) {
            state.neutrals.insert(slot.to_owned(), Neutral { session: 0, kept });
        }
    }

    /// Forgets what is kept of a room: another node, which was its home, knows better.
    pub fn forget_kept(&self, name: &RoomName) {
        if let Some(room) = self.find(name) {
            lock(&room.state).neutrals.clear();
        }
    }

    /// Slots of a room that are taken, each with its session.
    pub fn slots(&self, name: &RoomName) -> Vec<(String, u32)> {
        let Some(room) = self.find(name) else { return Vec::new() };
        lock(&room.state).publishers.iter().map(|publisher| (publisher.claim.slot.name.clone(), publisher.session)).collect()
    }

    /// Nobody else publishes to a room than the one who wants to have it back.
    pub fn is_free_for(&self, name: &RoomName, resume: Option<&Resume>) -> bool {
        self.find(name).is_none_or(|room| lock(&room.state).publishers.iter().all(|publisher| publisher.is_of(resume, true)))
    }

    /// The greatest number that a session of a room has had, as far as is known here.
    pub fn num_sessions(&self, name: &RoomName) -> u32 {
        self.find(name).map_or(0, |room| lock(&room.state).num_sessions)
    }

    /// A room's newest state as messages for another node: the key packet, and the delta where there is one.
    pub fn newest(&self, name: &RoomName) -> Vec<Bytes> {
        let Some(room) = self.find(name) else { return Vec::new() };
        let mut guard = lock(&room.state);
        let state = &mut *guard;
        // Who asks watches, and gets from here on whatever comes.
        room.want(state);
        let is_own = |latest: &Arc<Latest>| state.is_home && latest.key.index > state.num_states_before;
        let Some(latest) = room.slot.borrow().clone().filter(is_own) else { return Vec::new() };
        let head = |index| StateHead { epoch: state.epoch, index, key_index: latest.key.index };
        let key = head(latest.key.index).message(latest.key.framed.payload());
        latest.delta.iter().fold(vec![key], |mut messages, delta| {
            messages.push(head(latest.index).message(delta.payload()));
            messages
        })
    }

    /// This node is a room's home from now on, under `epoch`, which others know of where it `is_shared`; they may have had
    /// `sessions` sessions of it.
    pub fn lead(&self, name: &RoomName, epoch: u64, is_shared: bool, sessions: u32) -> Result<(), RoomError> {
        let room = self.find_or_make(&mut lock(&self.by_name), name)?;
        let mut state = lock(&room.state);
        if !std::mem::replace(&mut state.is_home, true) {
            state.num_states_before = state.num_states;
            room.end_fed(&mut state);
            if let Some(fed) = &mut state.fed {
                // What is shown from here on has other key packets: should this node follow again, it begins with one of that home's.
                fed.key = (0, 0);
            }
        }
        (state.epoch, state.is_shared) = (epoch, is_shared);
        // It is not known yet who watches.
        room.want(&mut state);
        state.num_sessions = state.num_sessions.max(sessions);
        Ok(())
    }

    /// Another node is a room's home under `epoch`: what was shown under a greater one came from a node that was none.
    pub fn follow(&self, name: &RoomName, epoch: u64) {
        let Some(room) = self.find(name) else { return };
        let mut state = lock(&room.state);
        if state.is_home {
            return;
        }
        // It may have moved while nobody published, which sent nobody away.
        room.end_recording_by_itself(&mut state, ELSEWHERE_NOW);
        if state.epoch > epoch {
            state.follow(epoch);
        }
    }

    /// Another node watches the rooms of these names, or may watch `all`, where it could not name each.
    pub fn want<'a>(&self, all: bool, names: impl Iterator<Item = &'a str>) {
        let rooms: Vec<Arc<Room>> = {
            let by_name = lock(&self.by_name);
            if all {
                by_name.values().cloned().collect()
            } else {
                names.filter_map(|name| by_name.get(&RoomName::new(name).ok()?).cloned()).collect()
            }
        };
        for room in rooms {
            room.want(&mut lock(&room.state));
        }
    }

    /// This node is a room's home no longer, unless somebody publishes to it.
    pub fn give_up(&self, name: &RoomName) -> bool {
        let Some(room) = self.find(name) else { return true };
        let mut state = lock(&room.state);
        if state.publishers.is_empty() {
            state.is_home = false;
        }
        !state.is_home
    }

    /// Sends a room's publishers away: another node is its home, under `epoch` where that is known.
    pub fn evict(&self, name: &RoomName, epoch: Option<u64>) {
        let Some(room) = self.find(name) else { return };
        let mut state = lock(&room.state);
        state.is_home = false;
        if let Some(epoch) = epoch {
            // Where both were cut off from each other, this one's may be the greater.
            state.follow(epoch);
        }
        for publisher in std::mem::take(&mut state.publishers) {
            room.record(&state, || publisher.end());
            state.mixer.leave(publisher.session);
            self.metrics.publishers.dec();
            // Its task may have ended in this moment.
            let _ = publisher.evict.send(());
        }
        room.end_recording_by_itself(&mut state, ELSEWHERE_NOW);
        state.empty_since = Instant::now();
    }

    /// Rooms that somebody watches or records here.
    pub fn watched(&self) -> HashMap<RoomName, Arc<Room>> {
        let by_name = lock(&self.by_name);
        let watched = by_name.iter().filter(|(_, room)| lock(&room.state).is_wanted());
        watched.map(|(name, room)| (name.clone(), room.clone())).collect()
    }
}

impl RoomState {
    /// Takes packets from `epoch` on.
    fn follow(&mut self, epoch: u64) {
        self.epoch = epoch;
        if self.fed.as_ref().is_some_and(|fed| fed.head.epoch > epoch) {
            self.fed = None;
        }
    }
}

impl Room {
    /// Somebody watches at another node, or may.
    fn want(&self, state: &mut RoomState) {
        state.wanted_until = self.nanos().saturating_add(WANTED_FOR.as_nanos() as u64);
    }

    /// Takes a packet that came from the room's home at another node.
    pub fn feed(&self, head: StateHead, packet: Bytes) -> Fed {
        let mut guard = lock(&self.state);
        let state = &mut *guard;
        if state.is_home || head.epoch < state.epoch || state.fed.as_ref().is_some_and(|fed| head <= fed.head) {
            return Fed::Old;
        }
        let is_key = head.index == head.key_index;
        let key = (head.epoch, head.key_index);
        let fed = match &mut state.fed {
            Some(fed) if is_key || fed.key == key => fed,
            empty @ None if is_key => empty.insert(Box::new(FedState {
                head: StateHead { epoch: 0, index: 0, key_index: 0 },
                key: (0, 0),
                decoder: Decoder::new(self.layout.clone()),
                frame: self.layout.frame_at_rest(),
            })),
            _ => return Fed::NeedsKey,
        };
        // Here, once for all viewers: what cannot be read goes no further.
        let is_sound = match fed.decoder.decode(&packet, &mut fed.frame) {
            Ok(kind) => (kind == PacketKind::Key) == is_key,
            Err(_) => false,
        };
        let framed = Framed::packet(&packet);
        let (delta, key_packet) = match (&state.key, is_key) {
            _ if !is_sound => {
                // Its decoder may hold another key packet than is noted.
                state.fed = None;
                self.metrics.drop_frames("bad_cluster_packet", 1);
                return Fed::Broken;
            }
            (_, true) => (None, Arc::new(KeyPacket { index: state.num_states + 1, framed })),
            (Some(key), false) => (Some(framed), key.clone()),
            (None, false) => return Fed::NeedsKey,
        };
        (fed.head, fed.key) = (head, key);
        let session = fed.frame.session;
        state.shown = Some((fed.frame.seq, fed.frame.captured_at_micros, fed.frame.face));
        state.num_sessions = state.num_sessions.max(session);
        state.epoch = head.epoch;
        state.key = Some(key_packet.clone());
        state.num_states += 1;
        let (index, era) = (state.num_states, state.eras.of(session, fed.frame.seq));
        self.slot.send_replace(Some(Arc::new(Latest { index, era, key: key_packet, delta, json: OnceLock::new() })));
        self.record_fed(state, session, packet);
        Fed::Taken
    }
}
