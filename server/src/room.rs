//! Rooms: where one publisher's packets meet any number of viewers. A room holds one state, the newest; nothing queues.

mod listing;
mod nodes;
mod recorded;

use crate::cluster::{Kept, RoomOutlet, StateHead};
use crate::framed::Framed;
use crate::lock::lock;
use crate::metrics::Metrics;
use crate::recording::{Item, Recorder, SessionEvent, Sink};
use crate::solve::mix::Mixer;
use crate::source::Control;
use crate::token::random_key;
use crate::viewer::Audience;
use rhytid_shared::packet::{Decoder, Encoder, PacketKind, PacketLayout};
use rhytid_shared::view::{CharacterHello, JsonFrame, ViewMessage};
use rhytid_shared::{Character, FaceFrame, PublishHello, Resume, RoomName, Slot};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};

pub(crate) use listing::{RoomListing, merge};
pub(crate) use nodes::{Fed, Others};

use nodes::FedState;

/// The newest state of a room, shared by all its viewers.
pub(crate) struct Latest {
    /// Counts the states of the room, over all sessions.
    pub index: u64,
    /// Counts how often the numbers of sessions have gone back. They do where two nodes had the room while they were cut off from
    /// each other, and it is the other's now. Viewers drop frames of an older session, so they must begin anew.
    pub era: u64,
    /// The key packet that decodes by itself.
    pub key: Arc<KeyPacket>,
    /// The newest packet where it is not the key packet.
    pub delta: Option<Framed>,
    json: OnceLock<Framed>,
}

/// A key packet with the index of its state.
pub(crate) struct KeyPacket {
    pub index: u64,
    pub framed: Framed,
}

impl Latest {
    /// The frame as JSON text: made once, by the first viewer that wants it.
    pub fn json(&self, layout: &PacketLayout, character: &CharacterHello) -> &Framed {
        let make = || {
            let (mut decoder, mut frame) = (Decoder::new(layout.clone()), layout.frame_at_rest());
            for framed in [Some(&self.key.framed), self.delta.as_ref()].into_iter().flatten() {
                decoder.decode(framed.payload(), &mut frame).expect("it comes from the room's own encoder, or was read when it came");
            }
            let message = ViewMessage::Frame(JsonFrame::new(&frame, character));
            Framed::text(&serde_json::to_string(&message).expect("plain data can be written"))
        };
        self.json.get_or_init(make)
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
    #[error("the slot has a publisher already; say \"takeover\":true in the hello to take its place")]
    SlotTaken,
    #[error("the room has {most} sources already, which is the limit")]
    TooManySlots { most: usize },
    #[error("another node has become the room's home in this moment; try again")]
    Elsewhere,
}

impl RoomError {
    /// Short and stable, for programs.
    pub fn code(self) -> &'static str {
        match self {
            Self::TooManyRooms { .. } => "too_many_rooms",
            Self::TooManyViewers { .. } => "too_many_viewers",
            Self::Taken => "room_taken",
            Self::SlotTaken => "slot_taken",
            Self::TooManySlots { .. } => "too_many_slots",
            Self::Elsewhere => "room_elsewhere",
        }
    }
}

/// Sources in one room: a phone, a webcam, an animator's hand for each group, and some.
pub(crate) const MAX_SLOTS: usize = 8;

/// What a source asks a room for: the same for every protocol that brings frames.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct SlotClaim {
    /// Name, priority and groups.
    pub slot: Slot,
    /// What the sender calls itself.
    pub source: String,
    /// Take the slot over from another publisher.
    pub takeover: bool,
    /// Take it over from this session, which was the claimant's own.
    pub resume: Option<Resume>,
    /// It plays a recording: no other one is made of that unless somebody asks for it.
    pub is_replay: bool,
}

impl SlotClaim {
    /// As a hello says it.
    pub fn of(hello: &PublishHello) -> Self {
        let PublishHello { slot, source, takeover, resume, .. } = hello;
        Self { slot: slot.clone(), source: source.clone(), takeover: *takeover, resume: resume.clone(), is_replay: false }
    }
}

/// All rooms.
pub(crate) struct Rooms {
    character: Arc<Character>,
    by_name: Mutex<BTreeMap<RoomName, Arc<Room>>>,
    max_rooms: usize,
    max_viewers: usize,
    metrics: Arc<Metrics>,
    recorder: Arc<Recorder>,
    /// Other nodes.
    others: Option<Others>,
}

/// One room.
pub(crate) struct Room {
    pub name: RoomName,
    pub audience: Audience,
    slot: watch::Sender<Option<Arc<Latest>>>,
    state: Mutex<RoomState>,
    /// The mixer's clock counts from here.
    since: Instant,
    layout: PacketLayout,
    metrics: Arc<Metrics>,
    outlet: Option<RoomOutlet>,
    interest: Option<watch::Sender<()>>,
}

struct RoomState {
    /// One a slot, at most [`MAX_SLOTS`].
    publishers: Vec<Publisher>,
    mixer: Mixer,
    encoder: Encoder,
    packet: Vec<u8>,
    /// The session that the encoder encodes.
    encoded_session: u32,
    /// Sessions so far: publishers, and hand-overs of the lead between them.
    num_sessions: u32,
    num_viewers: usize,
    /// Viewers so far.
    num_joins: u64,
    num_states: u64,
    key: Option<Arc<KeyPacket>>,
    eras: Eras,
    /// What the listing shows of the newest frame.
    shown: Option<(u32, u64, bool)>,
    /// By slot, at most [`MAX_SLOTS`].
    neutrals: BTreeMap<String, Neutral>,
    /// What keeps its messages, also where that has failed.
    recording: Option<Arc<Sink>>,
    /// Nobody has asked for that.
    records_by_itself: bool,
    /// Session of another node's packets that the recording is in, and how many it has of them.
    fed_session: Option<(u32, u64)>,
    empty_since: Instant,
    /// This node is the room's home; where there are no others it always is.
    is_home: bool,
    /// Epoch under which packets leave for other nodes; what comes under an older one is old.
    epoch: u64,
    /// NATS has recorded that epoch: packets under one that it has not would shut out those of the true home.
    is_shared: bool,
    /// Until then on the room's clock, ns, other nodes get its packets: somebody watches there, or may.
    wanted_until: u64,
    /// States that came before this node was the room's home: they are of another epoch.
    num_states_before: u64,
    /// What came from another node.
    fed: Option<Box<FedState>>,
}

/// The neutral face that a session came to: kept so that a publisher which comes back need not be searched again.
struct Neutral {
    session: u32,
    kept: Kept,
}

struct Publisher {
    session: u32,
    /// Nobody but this publisher is told it.
    key: Arc<str>,
    claim: SlotClaim,
    since: Instant,
    /// Frames that the room has taken.
    num_frames: u64,
    evict: oneshot::Sender<()>,
    controls: mpsc::Sender<Control>,
}

/// Knows when the numbers of sessions go back, see [`Latest::era`].
#[derive(Default)]
struct Eras {
    count: u64,
    /// Session and frame of the newest state.
    newest: (u32, u32),
}

impl Eras {
    /// The era of the next state, frame `seq` of `session`.
    fn of(&mut self, session: u32, seq: u32) -> u64 {
        // Numbers wrap.
        let since = |newer: u32, older: u32| newer.wrapping_sub(older).cast_signed();
        let by = since(session, self.newest.0);
        self.count += u64::from(by < 0 || (by == 0 && since(seq, self.newest.1) < 0));
        self.newest = (session, seq);
        self.count
    }
}

impl Publisher {
    /// It is the session that a claimant had. Its number alone says so where it is not used again: a cluster counts on, but a server
    /// without one begins at 1 each time that it is started.
    fn is_of(&self, resume: Option<&Resume>, counts_on: bool) -> bool {
        resume.is_some_and(|Resume { session, key }| *session == self.session && key.as_deref().map_or(counts_on, |key| *key == *self.key))
    }
}

impl Rooms {
    pub fn new(
        character: Arc<Character>,
        max_rooms: usize,
        max_viewers: usize,
        metrics: Arc<Metrics>,
        recorder: Arc<Recorder>,
        others: Option<Others>,
    ) -> Self {
        Self { character, by_name: Mutex::default(), max_rooms, max_viewers, metrics, recorder, others }
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
        state.num_joins += 1;
        let (number, is_first) = (state.num_joins, state.num_viewers == 1);
        drop(state);
        self.metrics.viewers.inc();
        if let Some(interest) = room.interest.as_ref().filter(|_| is_first) {
            interest.send_replace(());
        }
        Ok(Viewing { slot: room.slot.subscribe(), room, number })
    }

    /// Enters a room as a source, in place of the one in its slot where the claim says so. What comes with the place says when
    /// another takes it; others reach it through `controls`. `recorded` makes of the session's number what a recording shall say of
    /// its beginning.
    pub fn claim(
        &self,
        name: &RoomName,
        claim: SlotClaim,
        controls: mpsc::Sender<Control>,
        recorded: impl FnOnce(u32) -> Vec<Item>,
    ) -> Result<(Publishing, Evicted), RoomError> {
        let mut by_name = lock(&self.by_name);
        let room = self.find_or_make(&mut by_name, name)?;
        let mut state = lock(&room.state);
        if !state.is_home {
            return Err(RoomError::Elsewhere);
        }
        let before = state.publishers.iter().position(|publisher| publisher.claim.slot.name == claim.slot.name);
        match before {
            Some(at) if !claim.takeover && !state.publishers[at].is_of(claim.resume.as_ref(), self.others.is_some()) => {
                return Err(if claim.slot.name == Slot::MAIN { RoomError::Taken } else { RoomError::SlotTaken });
            }
            None if state.publishers.len() >= MAX_SLOTS => return Err(RoomError::TooManySlots { most: MAX_SLOTS }),
            _ => {}
        }
        if !claim.is_replay && self.recorder.is_automatic(name) && !state.is_recorded() {
            self.record_by_itself(&room, &mut state);
        }
        let (evict, evicted) = oneshot::channel();
        state.num_sessions = state.num_sessions.wrapping_add(1).max(1);
        let session = state.num_sessions;
        let before = before.map(|at| state.publishers.remove(at));
        if let Some(before) = &before {
            room.record(&state, || before.end());
            state.mixer.leave(before.session);
        }
        if claim.is_replay {
            room.end_recording_of_replay(&mut state);
        }
        if state.is_recorded() {
            recorded(session).into_iter().for_each(|item| room.record(&state, || item));
        }
        state.mixer.enter(session, &claim.slot);
        let key = random_key();
        state.publishers.push(Publisher { session, key: key.clone(), claim, since: Instant::now(), num_frames: 0, evict, controls });
        drop(state);
        if let Some(before) = before {
            // Its task may have ended in this moment; then nobody needs to be told.
            let _ = before.evict.send(());
        } else {
            self.metrics.publishers.inc();
        }
        Ok((Publishing { room, session, key }, evicted))
    }

    /// The room, made where there is none.
    pub fn room(&self, name: &RoomName) -> Result<Arc<Room>, RoomError> {
        self.find_or_make(&mut lock(&self.by_name), name)
    }

    fn check_place(&self, by_name: &BTreeMap<RoomName, Arc<Room>>) -> Result<(), RoomError> {
        if by_name.len() >= self.max_rooms {
            return Err(RoomError::TooManyRooms { most: self.max_rooms });
        }
        Ok(())
    }

    fn find_or_make(&self, by_name: &mut BTreeMap<RoomName, Arc<Room>>, name: &RoomName) -> Result<Arc<Room>, RoomError> {
        if let Some(room) = by_name.get(name) {
            return Ok(room.clone());
        }
        self.check_place(by_name)?;
        let layout = PacketLayout::from(&*self.character);
        let room = Arc::new(Room {
            since: Instant::now(),
            name: name.clone(),
            audience: Audience::default(),
            slot: watch::Sender::new(None),
            state: Mutex::new(RoomState {
                publishers: Vec::new(),
                mixer: Mixer::new(self.character.clone()),
                encoder: Encoder::new(layout.clone()),
                packet: Vec::new(),
                encoded_session: 0,
                num_sessions: 0,
                num_viewers: 0,
                num_joins: 0,
                num_states: 0,
                key: None,
                eras: Eras::default(),
                shown: None,
                neutrals: BTreeMap::new(),
                recording: None,
                records_by_itself: false,
                fed_session: None,
                empty_since: Instant::now(),
                is_home: self.others.is_none(),
                epoch: 0,
                is_shared: false,
                wanted_until: 0,
                num_states_before: 0,
                fed: None,
            }),
            layout,
            metrics: self.metrics.clone(),
            outlet: self.others.as_ref().map(|others| others.outlet.of(name)),
            interest: self.others.as_ref().map(|others| others.interest.clone()),
        });
        by_name.insert(name.clone(), room.clone());
        self.metrics.rooms.set(by_name.len() as i64);
        Ok(room)
    }

    /// The room of this name.
    pub fn find(&self, name: &RoomName) -> Option<Arc<Room>> {
        lock(&self.by_name).get(name).cloned()
    }

    /// What the room keeps for the slot of `hello`, of its tracker, where it asks for that.
    pub fn kept(&self, name: &RoomName, hello: &PublishHello) -> Option<Kept> {
        let room = self.find(name).filter(|_| hello.keep_neutral)?;
        let state = lock(&room.state);
        state.neutrals.get(&hello.slot.name).filter(|neutral| neutral.kept.tracker == hello.tracker()).map(|neutral| neutral.kept.clone())
    }

    /// Removes rooms that have been without publisher and viewers for `idle`; among nodes, none whose home is here: its lease
    /// is given back before.
    pub fn sweep(&self, idle: Duration) {
        let mut by_name = lock(&self.by_name);
        by_name.retain(|_, room| {
            let state = lock(&room.state);
            let is_led = self.others.is_some() && state.is_home;
            is_led || !state.publishers.is_empty() || state.num_viewers > 0 || state.empty_since.elapsed() < idle
        });
        self.metrics.rooms.set(by_name.len() as i64);
    }

    /// Wakes every viewer as a new state would: they look whether the service ends.
    pub fn wake_viewers(&self) {
        for room in lock(&self.by_name).values() {
            room.slot.send_modify(|_| {});
        }
    }
}

impl Room {
    /// The room's clock, ns.
    fn nanos(&self) -> u64 {
        u64::try_from(self.since.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    /// Seconds on the mixer's clock.
    fn now(&self) -> f64 {
        mixer_time(self.nanos())
    }

    /// When its clock began.
    pub fn since(&self) -> Instant {
        self.since
    }

    /// Where commands to the source in this slot go.
    pub fn controls(&self, slot: &str) -> Option<mpsc::Sender<Control>> {
        let state = lock(&self.state);
        state.publishers.iter().find(|publisher| publisher.claim.slot.name == slot).map(|publisher| publisher.controls.clone())
    }
}

/// The mixer's clock of the room's, ns: in whole nanoseconds, so that a recording can say it.
pub(crate) fn mixer_time(nanos: u64) -> f64 {
    nanos as f64 / 1e9
}

/// A viewer's place in a room; given back on drop.
pub(crate) struct Viewing {
    pub room: Arc<Room>,
    /// Counts those that have joined the room.
    pub number: u64,
    /// The newest state.
    pub slot: watch::Receiver<Option<Arc<Latest>>>,
}

impl Drop for Viewing {
    fn drop(&mut self) {
        let mut state = lock(&self.room.state);
        state.num_viewers -= 1;
        state.empty_since = Instant::now();
        let is_last = state.num_viewers == 0;
        drop(state);
        self.room.metrics.viewers.dec();
        if let Some(interest) = self.room.interest.as_ref().filter(|_| is_last) {
            interest.send_replace(());
        }
    }
}

/// A publisher's place in a room; given back on drop, unless another has taken it over.
pub(crate) struct Publishing {
    pub room: Arc<Room>,
    /// Number of this session in its room, from 1.
    pub session: u32,
    /// What proves that a publisher which comes back had this session.
    pub key: Arc<str>,
}

/// Done when another publisher has taken the place.
pub(crate) type Evicted = oneshot::Receiver<()>;

impl Publishing {
    /// What its place is taken back with.
    pub fn resume(&self) -> Resume {
        Resume { session: self.session, key: Some(self.key.to_string()) }
    }

    /// Takes the source's newest face; where the source leads, the merged face becomes the room's newest state. False where another
    /// publisher has the slot. `message`, which the face was made of, is recorded, and behind it the packet.
    pub fn publish(&self, face: &FaceFrame, message: Option<Item>) -> bool {
        let mut guard = lock(&self.room.state);
        let state = &mut *guard;
        let Some(publisher) = state.publishers.iter_mut().find(|publisher| publisher.session == self.session) else { return false };
        publisher.num_frames += 1;
        // One time for the mixer and the recording: solved again from there, it must come out the same.
        let nanos = self.room.nanos();
        if let (Some(sink), Some(message)) = (&state.recording, message) {
            sink.put(nanos, message);
        }
        let Some(merged) = state.mixer.take(self.session, face, mixer_time(nanos), &mut state.num_sessions) else { return true };
        if merged.session != state.encoded_session {
            // A session's packets depend on its frames alone.
            state.encoder = Encoder::new(self.room.layout.clone());
            state.encoded_session = merged.session;
        }
        let kind = state.encoder.encode(merged, &mut state.packet);
        state.num_states += 1;
        let index = state.num_states;
        let key_index = state.key.as_ref().filter(|_| kind == PacketKind::Delta).map_or(index, |key| key.index);
        if let Some(outlet) = self.room.outlet.as_ref().filter(|_| state.is_shared && nanos < state.wanted_until)
            && !outlet.send(StateHead { epoch: state.epoch, index, key_index }.message(&state.packet))
        {
            self.room.metrics.drop_frames("slow_cluster", 1);
        }
        let framed = Framed::packet(&state.packet);
        if let Some(sink) = &state.recording {
            sink.put(nanos, Item::Packet(framed.to_payload()));
        }
        let (key, delta) = match (kind, &state.key) {
            (PacketKind::Delta, Some(key)) => (key.clone(), Some(framed)),
            _ => (Arc::new(KeyPacket { index, framed }), None),
        };
        state.key = Some(key.clone());
        state.shown = Some((merged.seq, merged.captured_at_micros, merged.face));
        let era = state.eras.of(merged.session, merged.seq);
        // Under the lock, so that states stand in the slot in their order.
        self.room.slot.send_replace(Some(Arc::new(Latest { index, era, key, delta, json: OnceLock::new() })));
        true
    }

    /// Records what `item` gives, where the room is recorded and nobody else has the slot.
    pub fn record(&self, item: impl FnOnce() -> Item) {
        let state = lock(&self.room.state);
        if state.publishers.iter().any(|publisher| publisher.session == self.session) {
            self.room.record(&state, item);
        }
    }

    /// Makes `kept` what the room keeps for `slot`, unless a later session has left something or it is kept already; true where it
    /// is new.
    pub fn keep(&self, slot: &str, kept: Kept) -> bool {
        let mut guard = lock(&self.room.state);
        let state = &mut *guard;
        let neutrals = &mut state.neutrals;
        let before = neutrals.get(slot);
        let is_new = before.is_none_or(|before| before.kept.calibration != kept.calibration);
        if before.is_none() && neutrals.len() >= MAX_SLOTS {
            // Slots come and go under any names: the oldest neutral makes room.
            let oldest = neutrals.iter().min_by_key(|(_, neutral)| neutral.session).map(|(slot, _)| slot.clone());
            oldest.map(|oldest| neutrals.remove(&oldest));
        } else if before.is_some_and(|before| before.session > self.session || before.kept == kept) {
            return false;
        }
        let calibration = kept.calibration.clone();
        neutrals.insert(slot.to_owned(), Neutral { session: self.session, kept });
        if is_new {
            self.room.record(state, || Item::Event(SessionEvent::Neutral { session: self.session, calibration: Box::new(calibration) }));
        }
        // Where another node is the home by now, it knows better.
        state.is_home
    }
}

impl Drop for Publishing {
    fn drop(&mut self) {
        let mut state = lock(&self.room.state);
        if let Some(at) = state.publishers.iter().position(|publisher| publisher.session == self.session) {
            let publisher = state.publishers.remove(at);
            self.room.record(&state, || publisher.end());
            state.mixer.leave(self.session);
            if !state.publishers.is_empty() {
                self.room.end_recording_of_replay(&mut state);
            }
            state.empty_since = Instant::now();
            self.room.metrics.publishers.dec();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rooms(max_rooms: usize, max_viewers: usize) -> Rooms {
        let character = Arc::new(Character::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).unwrap());
        let metrics = Arc::new(Metrics::new());
        let recorder = Recorder::new(crate::recording::RecordConfig::default(), &character, metrics.clone(), mpsc::channel(1).0);
        Rooms::new(character, max_rooms, max_viewers, metrics, Arc::new(recorder), None)
    }

    /// Claims a slot that nobody commands, and of which nothing is recorded.
    fn claim(rooms: &Rooms, name: &RoomName, claim: SlotClaim) -> Result<(Publishing, Evicted), RoomError> {
        rooms.claim(name, claim, mpsc::channel(1).0, |_| Vec::new())
    }

    fn main(source: &str, takeover: bool) -> SlotClaim {
        SlotClaim { source: source.into(), takeover, ..SlotClaim::default() }
    }

    fn slot(name: &str, takeover: bool) -> SlotClaim {
        SlotClaim { slot: Slot { name: name.into(), ..Slot::default() }, ..main(name, takeover) }
    }

    #[test]
    fn slots_are_taken_one_by_one() {
        let rooms = rooms(10, 10);
        let room = name("a");
        let mut places: Vec<_> = (0..MAX_SLOTS).map(|i| claim(&rooms, &room, slot(&format!("s{i}"), false)).unwrap()).collect();
        assert_eq!(claim(&rooms, &room, slot("more", false)).err(), Some(RoomError::TooManySlots { most: 8 }));
        assert_eq!(claim(&rooms, &room, slot("s3", false)).err(), Some(RoomError::SlotTaken));
        let again = claim(&rooms, &room, slot("s3", true)).unwrap();
        assert_eq!(places[3].1.try_recv(), Ok(()), "it is told");
        assert!(places[2].1.try_recv().is_err(), "and nobody else");
        assert_eq!(rooms.metrics.publishers.get(), 8);
        let face = FaceFrame::at_rest(&rooms.character);
        assert!(again.0.publish(&face, None) && !places[3].0.publish(&face, None));
        let listed = serde_json::to_value(rooms.list()).unwrap();
        assert_eq!((listed[0]["sources"].as_array().unwrap().len(), &listed[0]["publisher"]["source"]), (8, &"s3".into()));
        drop((places, again));
        assert_eq!(rooms.metrics.publishers.get(), 0);
    }

    fn name(text: &str) -> RoomName {
        RoomName::new(text).unwrap()
    }

    #[test]
    fn a_room_has_one_publisher_and_takeover_replaces_it() {
        let rooms = rooms(10, 10);
        let (first, mut evicted) = claim(&rooms, &name("a"), main("one", false)).unwrap();
        assert_eq!(claim(&rooms, &name("a"), main("two", false)).err(), Some(RoomError::Taken));
        let (second, _evicted) = claim(&rooms, &name("a"), main("two", true)).unwrap();
        assert_eq!((first.session, second.session), (1, 2));
        assert_eq!(evicted.try_recv(), Ok(()));
        drop(first);
        assert_eq!(claim(&rooms, &name("a"), main("three", false)).err(), Some(RoomError::Taken), "the old one's end frees nothing");
        drop(second);
        assert_eq!(claim(&rooms, &name("a"), main("three", false)).unwrap().0.session, 3);
        assert_eq!(rooms.metrics.publishers.get(), 0);
    }

    #[test]
    fn a_room_of_one_source_has_the_packets_of_its_pipeline() {
        use crate::pipeline::Pipeline;
        use crate::solve::SolveConfig;
        let rooms = rooms(1, 1);
        let text = include_str!("../../shared/assets/demo.ibug68.jsonl");
        let mut feed = crate::feed::Feed::new(std::io::Cursor::new(text), "demo".into(), &rooms.character).unwrap();
        let (place, _evicted) = claim(&rooms, &name("a"), SlotClaim::of(&feed.hello)).unwrap();
        let mut pipeline = Pipeline::new(rooms.character.clone(), &SolveConfig::default(), &feed.hello, place.session).unwrap();
        let (mut frame, mut packet) = (rhytid_shared::TrackingFrame::default(), Vec::new());
        for _ in 0..120 {
            feed.next_frame(&mut frame).unwrap();
            pipeline.frame(&frame, &mut packet).unwrap();
            assert!(place.publish(pipeline.face(), None));
            let latest = place.room.slot.borrow().clone().unwrap();
            assert_eq!(latest.delta.as_ref().unwrap_or(&latest.key.framed).payload(), packet);
        }
    }

    #[test]
    fn era_begins_where_sessions_go_back_and_not_where_numbers_wrap() {
        let mut eras = Eras::default();
        let states = [(1, 0), (1, 7), (3, 0), (1 << 30, 9), (1 << 31, 0), (3 << 30, 5), (u32::MAX, 5), (0, 0), (4, u32::MAX), (4, 0)];
        assert!(states.iter().all(|&(session, seq)| eras.of(session, seq) == 0), "all go on");
        assert_eq!((eras.of(3, 100), eras.of(3, 101), eras.of(3, 50), eras.of(4, 0)), (1, 1, 2, 2));
    }

    #[test]
    fn limits_hold_and_idle_rooms_go() {
        let rooms = rooms(2, 1);
        let viewer = rooms.join(&name("a")).unwrap();
        assert_eq!(rooms.join(&name("a")).err(), Some(RoomError::TooManyViewers { most: 1 }));
        let publisher = claim(&rooms, &name("b"), main("", false)).unwrap();
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
