//! Leases: which node is a room's home.

use super::wire::{EnterAnswer, EnterQuestion, Kept, Lease};
use super::{Cluster, GATHERING, Held, KEPT_FOR, PATIENT_TIMEOUT, REQUEST_TIMEOUT, lock};
use crate::room::{RoomError, Rooms};
use async_nats::RequestErrorKind;
use async_nats::jetstream::kv::{CreateErrorKind, Operation, UpdateErrorKind};
use futures_util::StreamExt;
use rhytid_shared::{PublishHello, RoomName};
use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio_tungstenite::tungstenite::Bytes;

/// Tries against others that claim the same room in the same moment.
const MOST_TRIES: usize = 5;
/// A home that had no publisher for this long gives its room back; one that reconnects finds it still there.
const EMPTY_FOR: Duration = Duration::from_secs(2);
/// Numbers of sessions that a home takes at a time: none of them is used again where it dies.
const SESSIONS_AT_ONCE: u32 = 1000;
/// A home that has so few of them left takes more.
const SESSIONS_LEFT: u32 = 200;
/// A lease is written again after this long: NATS forgets what is older than a day.
const RENEWED_AFTER: Duration = Duration::from_secs(3600);
/// Between looks for leases that are to be forgotten.
const LOOKED_THROUGH_AFTER: Duration = Duration::from_secs(60);
/// How long a home that does not answer may just be slow: only one who wants back what it had does not wait.
const SLOW: Duration = Duration::from_secs(2);
/// Between questions to a home that does not answer.
const ASK_AGAIN: Duration = Duration::from_millis(200);
/// A tracker that was refused a room is refused it for so long without another question.
const REFUSED_FOR: Duration = Duration::from_secs(1);
/// Rooms that trackers ask for at a time.
const MOST_ENTERING: usize = 4096;

/// Why a room cannot have its home here.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum LeaseError {
    /// The slot is taken there.
    #[error("the room has a publisher already, at another node; say \"takeover\":true in the hello to take its place")]
    Taken,
    /// Other sources drive it there.
    #[error("the room's sources are at {address}: publish there, or say \"takeover\":true in the hello to take the whole room over")]
    Elsewhere {
        /// Where.
        address: String,
    },
    /// It has no place here.
    #[error(transparent)]
    Room(#[from] RoomError),
    /// The service ends.
    #[error("this node is shutting down")]
    Leaving,
}

impl LeaseError {
    /// Short and stable, for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Taken => "room_taken",
            Self::Elsewhere { .. } => "room_elsewhere",
            Self::Room(error) => error.code(),
            Self::Leaving => "shutting_down",
        }
    }
}

/// The leases of all rooms as NATS has told of them.
#[derive(Default)]
pub(super) struct Leases {
    by_room: HashMap<RoomName, (Lease, Instant)>,
    /// When they were looked through.
    looked: Option<Instant>,
}

impl Leases {
    fn get(&self, room: &RoomName) -> Option<&Lease> {
        self.by_room.get(room).map(|(lease, _)| lease)
    }

    fn remove(&mut self, room: &RoomName) {
        self.by_room.remove(room);
    }

    /// Takes what NATS has told at `now`; true where the room's home or its epoch is another than before.
    fn insert(&mut self, room: RoomName, lease: Lease, now: Instant) -> bool {
        let home = (lease.node.clone(), lease.epoch);
        let before = self.by_room.insert(room, (lease, now));
        before.is_none_or(|(before, _)| (before.node, before.epoch) != home)
    }

    /// Forgets what NATS has forgotten by `now`, which tells nobody of that: leases that no home renews.
    pub fn forget(&mut self, now: Instant) {
        if self.looked.is_none_or(|looked| now.saturating_duration_since(looked) >= LOOKED_THROUGH_AFTER) {
            self.looked = Some(now);
            self.by_room.retain(|_, (_, told)| now.saturating_duration_since(*told) < KEPT_FOR);
            self.by_room.shrink_to_fit();
        }
    }
}

/// How it stands with a room that a tracker has asked for.
pub(super) enum Entering {
    /// Not known yet.
    Asked,
    /// It may not have it.
    Refused(&'static str, Instant),
}

/// What a room's home says.
enum Said {
    /// It is no longer the home, or there is none.
    Yes,
    /// It stays the home.
    No(EnterAnswer),
    /// Nothing: it is dead, stopped, slow or cut off.
    Nothing,
}

fn now_millis() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

/// NATS's answer, or `None` where it takes too long.
async fn within<T>(answer: impl Future<Output = T>) -> Option<T> {
    tokio::time::timeout(REQUEST_TIMEOUT, answer).await.ok()
}

impl Held {
    /// Notes at `now` whether its room has a publisher; true where it has had none for long enough.
    fn note_empty(&mut self, is_empty: bool, now: Instant) -> bool {
        self.empty_since = is_empty.then(|| self.empty_since.unwrap_or(now));
        self.is_empty(now)
    }

    /// Its room has had no publisher for long enough.
    fn is_empty(&self, now: Instant) -> bool {
        self.empty_since.is_some_and(|since| now.saturating_duration_since(since) >= EMPTY_FOR)
    }

    /// It is to be given back, claimed, or written again; `num_sessions` of its room have been.
    fn is_due(&self, num_sessions: u32, now: Instant) -> bool {
        let is_short = num_sessions.saturating_add(SESSIONS_LEFT) > self.lease.sessions;
        self.is_empty(now) || self.revision.is_none() || is_short || now.saturating_duration_since(self.renewed) >= RENEWED_AFTER
    }
}

impl Cluster {
    /// What a publisher of `hello` finds kept of its slot where it asks for that: here, if this is the room's home, else in the
    /// cluster.
    pub async fn find_kept(&self, rooms: &Rooms, room: &RoomName, hello: &PublishHello) -> Option<Kept> {
        let here = rooms.kept(room, hello);
        if !hello.keep_neutral || self.is_home(room) && here.is_some() {
            return here;
        }
        self.kept(room, &hello.slot.name).await.or(here)
    }

    /// Makes this node the home of `room` for the publisher of `hello`, with what is `kept` of its slot; or says whose it is.
    /// Without NATS this node is it at once, until others can be asked.
    pub async fn enter(
        self: &Arc<Self>,
        rooms: &Arc<Rooms>,
        room: &RoomName,
        hello: &PublishHello,
        kept: Option<Kept>,
    ) -> Result<(), LeaseError> {
        let (cluster, rooms, room, hello) = (self.clone(), rooms.clone(), room.clone(), hello.clone());
        // In a task of its own: who waits may go, and no lease shall be left without this node's knowing of it.
        let entering = tokio::spawn(async move { cluster.enter_now(&rooms, &room, &hello, kept).await });
        entering.await.unwrap_or(Err(LeaseError::Leaving))
    }

    async fn enter_now(&self, rooms: &Rooms, room: &RoomName, hello: &PublishHello, kept: Option<Kept>) -> Result<(), LeaseError> {
        let _claiming = self.claiming.read().await;
        if self.is_leaving.load(Ordering::SeqCst) {
            return Err(LeaseError::Leaving);
        }
        let is_new = match lock(&self.held).get_mut(room) {
            Some(held) => {
                // Not given back in this moment.
                held.empty_since = None;
                false
            }
            None => true,
        };
        if is_new {
            rooms.has_place(room)?;
            self.claim(rooms, room, hello).await?;
        }
        let slot = &hello.slot.name;
        if let Some(kept) = kept.filter(|_| is_new || !rooms.has_kept(room, slot)) {
            // It may be this node's own, and lost to the cluster.
            self.fill(room, slot, &kept);
            rooms.restore(room, slot, kept);
        }
        Ok(())
    }

    /// As [`Self::enter`], for who cannot wait: says whether the room may be published to now, and if not, why.
    pub fn enter_soon(self: &Arc<Self>, rooms: &Arc<Rooms>, room: &RoomName, hello: &PublishHello) -> Result<(), &'static str> {
        if self.is_home(room) {
            return Ok(());
        }
        let mut entering = lock(&self.entering);
        match entering.get(room) {
            Some(Entering::Asked) => return Err("room_asked_for"),
            Some(Entering::Refused(code, at)) if at.elapsed() < REFUSED_FOR => return Err(code),
            _ => {}
        }
        if entering.len() >= MOST_ENTERING {
            entering.retain(|_, entering| matches!(entering, Entering::Asked));
            if entering.len() >= MOST_ENTERING {
                return Err("too_many_sessions");
            }
        }
        entering.insert(room.clone(), Entering::Asked);
        let (cluster, rooms, room, hello) = (self.clone(), rooms.clone(), room.clone(), hello.clone());
        tokio::spawn(async move {
            let kept = cluster.find_kept(&rooms, &room, &hello).await;
            let entered = cluster.enter(&rooms, &room, &hello, kept).await;
            let mut entering = lock(&cluster.entering);
            match entered {
                Ok(()) => drop(entering.remove(&room)),
                Err(error) => {
                    tracing::debug!(%room, %error, "tracker has no room");
                    entering.insert(room, Entering::Refused(error.code(), Instant::now()));
                }
            }
        });
        Err("room_asked_for")
    }

    async fn claim(&self, rooms: &Rooms, room: &RoomName, hello: &PublishHello) -> Result<(), LeaseError> {
        let question = EnterQuestion {
            room: room.to_string(),
            takeover: hello.takeover,
            resume: hello.resume.as_ref().map(|resume| resume.session),
            resume_key: hello.resume.as_ref().and_then(|resume| resume.key.clone()),
        };
        let Some(buckets) = self.buckets.get().filter(|_| self.problem().is_none()) else {
            self.ask_known_home(&question, room, &hello.slot.name).await?;
            return self.hold_alone(rooms, room);
        };
        let mut tried = None;
        for _ in 0..MOST_TRIES {
            let entry = match self.patiently(|| buckets.leases.entry(room.as_str())).await {
                Some(Ok(entry)) => entry,
                // NATS has gone in this moment, or its servers are choosing one that leads them.
                told => {
                    note_unrecorded(room, told);
                    self.ask_known_home(&question, room, &hello.slot.name).await?;
                    return self.hold_alone(rooms, room);
                }
            };
            // What no node has written is written over.
            let found = entry.filter(|entry| entry.operation == Operation::Put);
            let before = found.as_ref().and_then(|entry| Lease::read(&entry.value)).unwrap_or_default();
            if !before.node.is_empty() && before.node != self.node {
                self.ask_to_leave(&before, &question, &hello.slot.name).await?;
            }
            // Written before, and NATS said so too late.
            let is_written = tried.as_ref().is_some_and(|(_, lease)| *lease == before);
            let (first, lease) = tried.take().filter(|_| is_written).unwrap_or_else(|| {
                let first = before.sessions.max(rooms.num_sessions(room));
                (first, self.own_lease(before.next_epoch(now_millis()), first.wrapping_add(SESSIONS_AT_ONCE)))
            });
            tried = Some((first, lease.clone()));
            let revision = match found {
                Some(entry) if is_written => entry.revision,
                Some(entry) => match self.patiently(|| buckets.leases.update(room.as_str(), text_of(&lease), entry.revision)).await {
                    Some(Ok(revision)) => revision,
                    Some(Err(error)) if error.kind() == UpdateErrorKind::WrongLastRevision => continue,
                    told => {
                        note_unrecorded(room, told);
                        return self.hold_alone(rooms, room);
                    }
                },
                None => match self.patiently(|| buckets.leases.create(room.as_str(), text_of(&lease))).await {
                    Some(Ok(revision)) => revision,
                    Some(Err(error)) if error.kind() == CreateErrorKind::AlreadyExists => continue,
                    told => {
                        note_unrecorded(room, told);
                        return self.hold_alone(rooms, room);
                    }
                },
            };
            rooms.forget_kept(room);
            return match self.hold(rooms, room, lease.clone(), Some(revision), first) {
                Ok(()) => Ok(()),
                Err(error) => {
                    self.give_back(rooms, room, &lease, Some(revision)).await;
                    Err(error)
                }
            };
        }
        Err(LeaseError::Taken)
    }

    /// NATS's answer; where it takes too long and is there for all that is known, it is asked once more and given longer.
    async fn patiently<F: Future>(&self, ask: impl Fn() -> F) -> Option<F::Output> {
        match within(ask()).await {
            None if self.problem().is_none() => tokio::time::timeout(PATIENT_TIMEOUT, ask()).await.ok(),
            answer => answer,
        }
    }

    fn own_lease(&self, epoch: u64, sessions: u32) -> Lease {
        Lease { node: self.node.clone(), address: self.address.clone(), epoch, sessions }
    }

    /// As [`Self::ask_to_leave`], where NATS keeps no records but lets nodes talk: what it has told before says whom to ask.
    async fn ask_known_home(&self, question: &EnterQuestion, room: &RoomName, slot: &str) -> Result<(), LeaseError> {
        let known = lock(&self.leases).get(room).cloned();
        match known.filter(|lease| !lease.node.is_empty() && lease.node != self.node && self.can_talk()) {
            Some(lease) => self.ask_to_leave(&lease, question, slot).await,
            None => Ok(()),
        }
    }

    /// Has a room's home let go of it, or says why it does not. One that is dead does not answer, nor one that is stopped: its
    /// lease is void.
    async fn ask_to_leave(&self, lease: &Lease, question: &EnterQuestion, slot: &str) -> Result<(), LeaseError> {
        let start = Instant::now();
        let mut timeout = REQUEST_TIMEOUT;
        loop {
            match self.ask_home(lease, question, std::mem::replace(&mut timeout, PATIENT_TIMEOUT)).await {
                _ if self.is_leaving.load(Ordering::SeqCst) => return Err(LeaseError::Leaving),
                (Said::Yes, _) => return Ok(()),
                (Said::No(answer), _) if answer.slots.iter().any(|taken| taken == slot) => return Err(LeaseError::Taken),
                (Said::No(_), _) => return Err(LeaseError::Elsewhere { address: lease.address.clone() }),
                (Said::Nothing, is_gone) => {
                    let patience = match (is_gone, self.is_gathering()) {
                        _ if question.takeover || question.resume.is_some() => Duration::ZERO,
                        (_, true) => GATHERING,
                        (true, false) => Duration::ZERO,
                        (false, false) => SLOW,
                    };
                    if start.elapsed() >= patience {
                        return Ok(());
                    }
                    tokio::time::sleep(ASK_AGAIN).await;
                }
            }
        }
    }

    /// What a room's home says; the second value is true where NATS knows of no such node.
    async fn ask_home(&self, lease: &Lease, question: &EnterQuestion, timeout: Duration) -> (Said, bool) {
        let subject = self.subject(&format!("node.{}.enter", lease.node));
        let text = serde_json::to_vec(question).expect("plain data can be written");
        match tokio::time::timeout(timeout, self.client.request(subject, text.into())).await {
            Ok(Ok(answer)) => match serde_json::from_slice::<EnterAnswer>(&answer.payload) {
                Ok(answer) if answer.is_granted => (Said::Yes, false),
                Ok(answer) => (Said::No(answer), false),
                // Not a node's.
                Err(_) => (Said::Nothing, false),
            },
            Ok(Err(error)) => (Said::Nothing, error.kind() == RequestErrorKind::NoResponders),
            Err(_) => (Said::Nothing, false),
        }
    }

    /// Makes this node a room's home without asking anybody.
    fn hold_alone(&self, rooms: &Rooms, room: &RoomName) -> Result<(), LeaseError> {
        use std::hash::{BuildHasher, Hasher};
        let before = lock(&self.leases).get(room).cloned().unwrap_or_default();
        // Another node may do the same in this moment; their sessions shall not have the same numbers.
        let at_random = std::collections::hash_map::RandomState::new().build_hasher().finish() % 10_000;
        let first = before.sessions.max(rooms.num_sessions(room)).wrapping_add(SESSIONS_AT_ONCE * (1 + at_random as u32));
        let lease = self.own_lease(before.next_epoch(now_millis()), first.wrapping_add(SESSIONS_AT_ONCE));
        self.hold(rooms, room, lease, None, first)
    }

    fn hold(&self, rooms: &Rooms, room: &RoomName, lease: Lease, revision: Option<u64>, sessions: u32) -> Result<(), LeaseError> {
        let mut held = lock(&self.held);
        // Behind the lock: all that is held is given back.
        if self.is_leaving.load(Ordering::SeqCst) {
            return Err(LeaseError::Leaving);
        }
        rooms.lead(room, lease.epoch, revision.is_some(), sessions)?;
        tracing::info!(%room, epoch = lease.epoch, shared = revision.is_some(), "home of a room");
        held.insert(room.clone(), Held { lease, revision, renewed: Instant::now(), empty_since: None });
        Ok(())
    }

    /// Gives back what has no publisher any more, and claims what could not be claimed before.
    pub(super) async fn renew(&self, rooms: &Rooms) {
        let mut due = Vec::new();
        {
            let mut held = lock(&self.held);
            for (room, held) in held.iter_mut() {
                held.note_empty(rooms.slots(room).is_empty(), Instant::now());
                if held.is_due(rooms.num_sessions(room), Instant::now()) {
                    due.push((room.clone(), held.clone()));
                }
            }
        }
        // One after the other they would take a round trip each; all at once they would be a burst of thousands.
        let due = due.into_iter().map(|(room, held)| async move { self.renew_one(rooms, &room, held).await });
        futures_util::stream::iter(due).buffer_unordered(64).collect::<()>().await;
    }

    /// Lets go of a room, unless a publisher has entered it, or is about to.
    fn give_up(&self, rooms: &Rooms, room: &RoomName) -> Option<Held> {
        let mut held = lock(&self.held);
        let is_given_up = held.get(room).is_some_and(|held| held.is_empty(Instant::now())) && rooms.give_up(room);
        if is_given_up { held.remove(room) } else { None }
    }

    /// Lets go of rooms without a publisher while NATS is away: what it has recorded of them binds nobody.
    pub(super) fn give_up_empty(&self, rooms: &Rooms) {
        for room in self.look_for_empty(rooms) {
            self.give_up(rooms, &room);
        }
    }

    /// Notes which rooms have no publisher; gives those that have been so for long enough.
    fn look_for_empty(&self, rooms: &Rooms) -> Vec<RoomName> {
        let mut held = lock(&self.held);
        held.iter_mut()
            .filter_map(|(room, held)| held.note_empty(rooms.slots(room).is_empty(), Instant::now()).then(|| room.clone()))
            .collect()
    }

    async fn renew_one(&self, rooms: &Rooms, room: &RoomName, held: Held) {
        let Some(buckets) = self.buckets.get() else { return };
        if held.is_empty(Instant::now()) {
            if let Some(held) = self.give_up(rooms, room) {
                self.give_back(rooms, room, &held.lease, held.revision).await;
            }
            return;
        }
        if let Some(revision) = held.revision {
            let lease = Lease { sessions: rooms.num_sessions(room).wrapping_add(SESSIONS_AT_ONCE), ..held.lease };
            let renewed = within(buckets.leases.update(room.as_str(), text_of(&lease), revision)).await;
            {
                let mut held = lock(&self.held);
                // Who has taken it meanwhile is heard of by the watch, too.
                let Some(held) = held.get_mut(room).filter(|held| held.revision == Some(revision)) else { return };
                match renewed {
                    Some(Ok(revision)) => (held.lease, held.revision, held.renewed) = (lease, Some(revision), Instant::now()),
                    // Its record is another, or is gone: it is claimed anew.
                    Some(Err(error)) if error.kind() == UpdateErrorKind::WrongLastRevision => return held.revision = None,
                    Some(Err(error)) => return tracing::debug!(%room, %error, "lease not renewed"),
                    None => return tracing::debug!(%room, "lease not renewed: no answer"),
                }
            }
            self.keep_again(rooms, room, true);
            return;
        }
        // Opened while NATS was away, or held since before: whoever claims it first keeps it.
        let entry = match self.patiently(|| buckets.leases.entry(room.as_str())).await {
            Some(Ok(entry)) => entry.filter(|entry| entry.operation == Operation::Put),
            _ => return tracing::debug!(%room, "lease not looked up"),
        };
        let Some(entry) = entry else {
            if let Some(Ok(revision)) = within(buckets.leases.create(room.as_str(), text_of(&held.lease))).await {
                self.confirm(rooms, room, held.lease, revision);
            }
            return;
        };
        // What no node has written is written over.
        let (revision, other) = (entry.revision, Lease::read(&entry.value).unwrap_or_default());
        let is_own = other.node == self.node;
        if !is_own && !other.node.is_empty() {
            let question = EnterQuestion { room: room.to_string(), ..EnterQuestion::default() };
            match self.ask_home(&other, &question, PATIENT_TIMEOUT).await {
                (Said::Yes, _) => {}
                (Said::No(_), _) => return self.lose(rooms, room, other.epoch),
                // It may be back in a moment; this one is asked for again in the next round.
                (Said::Nothing, _) if self.is_gathering() => return,
                (Said::Nothing, _) => {}
            }
        }
        let epoch = if is_own { held.lease.epoch.max(other.epoch) } else { other.next_epoch(held.lease.epoch) };
        let lease = Lease { epoch, sessions: held.lease.sessions.max(other.sessions), ..held.lease };
        // Written before, and NATS said so too late.
        if other == lease {
            self.confirm(rooms, room, lease, revision);
        } else if let Some(Ok(revision)) = within(buckets.leases.update(room.as_str(), text_of(&lease), revision)).await {
            self.confirm(rooms, room, lease, revision);
        }
    }

    /// What was held alone is held before all.
    fn confirm(&self, rooms: &Rooms, room: &RoomName, lease: Lease, revision: u64) {
        {
            let mut held = lock(&self.held);
            let Some(held) = held.get_mut(room) else { return };
            if let Err(error) = rooms.lead(room, lease.epoch, true, 0) {
                return tracing::warn!(%room, %error, "it is not there any more");
            }
            tracing::info!(%room, epoch = lease.epoch, "home of a room before all nodes");
            (held.lease, held.revision, held.renewed) = (lease, Some(revision), Instant::now());
        }
        self.keep_again(rooms, room, false);
    }

    async fn give_back(&self, rooms: &Rooms, room: &RoomName, lease: &Lease, revision: Option<u64>) {
        let (Some(buckets), Some(revision)) = (self.buckets.get(), revision) else { return };
        // As many as may have been, where there is no such room any more.
        let sessions = rooms.num_sessions(room).max(lease.sessions.saturating_sub(SESSIONS_AT_ONCE));
        let free = Lease { node: String::new(), address: String::new(), sessions, epoch: lease.epoch };
        match within(buckets.leases.update(room.as_str(), text_of(&free), revision)).await {
            Some(Ok(_)) => {}
            // Another has taken it meanwhile, or finds that nobody answers for it.
            Some(Err(error)) => tracing::debug!(%room, %error, "room not given back"),
            None => tracing::debug!(%room, "room not given back: no answer"),
        }
    }

    /// Another node is the room's home, under `epoch`.
    fn lose(&self, rooms: &Rooms, room: &RoomName, epoch: u64) {
        tracing::warn!(%room, "another node is the room's home now");
        lock(&self.held).remove(room);
        rooms.evict(room, Some(epoch));
        self.homes.send_replace(());
        self.interest.send_replace(());
    }

    /// Follows all leases: a node that was stopped learns here what was taken from it.
    pub(super) async fn watch_leases(self: Arc<Self>, rooms: Weak<Rooms>) {
        let Some(buckets) = self.buckets.get() else { return };
        let Ok(mut changes) = buckets.leases.watch_with_history(">").await else { return };
        while let Some(Ok(entry)) = changes.next().await {
            let (Some(rooms), Ok(room)) = (rooms.upgrade(), RoomName::new(&entry.key)) else { continue };
            let lease = if entry.operation == Operation::Put { Lease::read(&entry.value) } else { None };
            let Some(lease) = lease else {
                lock(&self.leases).remove(&room);
                // Not by a node: then who holds it claims it anew.
                if let Some(held) = lock(&self.held).get_mut(&room).filter(|held| held.revision.is_some_and(|own| own < entry.revision)) {
                    held.revision = None;
                }
                continue;
            };
            let is_lost = {
                let held = lock(&self.held);
                held.get(&room).is_some_and(|held| held.revision.is_some_and(|own| own < entry.revision) && lease.node != self.node)
            };
            if is_lost {
                self.lose(&rooms, &room, lease.epoch);
            } else if lease.node != self.node {
                rooms.follow(&room, lease.epoch);
            }
            // Every home writes its leases again now and then.
            if lock(&self.leases).insert(room, lease, Instant::now()) {
                self.homes.send_replace(());
                self.interest.send_replace(());
            }
        }
    }

    /// The home of a room, where it is another node.
    pub(super) fn home_elsewhere(&self, room: &RoomName) -> Option<String> {
        lock(&self.leases).get(room).map(|lease| lease.node.clone()).filter(|node| !node.is_empty() && *node != self.node)
    }

    /// This node is the room's home.
    pub fn is_home(&self, room: &RoomName) -> bool {
        lock(&self.held).contains_key(room)
    }

    /// Gives every room back before the publishers are sent away: each is free for the node that they come to.
    pub async fn leave(&self, rooms: &Rooms) {
        self.is_leaving.store(true, Ordering::SeqCst);
        let all: Vec<_> = lock(&self.held).drain().collect();
        let giving = all.iter().map(|(room, held)| self.give_back(rooms, room, &held.lease, held.revision));
        let giving = futures_util::stream::iter(giving).buffer_unordered(64).collect::<()>();
        let all = async {
            giving.await;
            // What is being claimed in this moment is given back there.
            drop(self.claiming.write().await);
        };
        // Whoever comes for the rest finds that nobody answers.
        let _ = tokio::time::timeout(Duration::from_secs(1), all).await;
    }
}

/// Notes why a room opens before NATS has a record of it.
fn note_unrecorded<T, E: std::fmt::Display>(room: &RoomName, told: Option<Result<T, E>>) {
    let why = told.and_then(Result::err).map_or_else(|| "no answer".to_owned(), |error| error.to_string());
    tracing::warn!(%room, why, "no lease to be had of NATS: the room opens here, and is claimed when it can be");
}

fn text_of(lease: &Lease) -> Bytes {
    serde_json::to_vec(lease).expect("plain data can be written").into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lease_is_written_again_long_before_nats_forgets_it() {
        let now = Instant::now();
        let lease = Lease { sessions: 1000, ..Lease::default() };
        let held = Held { lease, revision: Some(1), renewed: now, empty_since: None };
        let half_an_hour = now + Duration::from_secs(1800);
        assert!(!held.is_due(800, half_an_hour));
        assert!(held.is_due(801, half_an_hour), "few sessions are left");
        assert!(held.is_due(0, now + KEPT_FOR / 12));
        assert!(Held { revision: None, ..held.clone() }.is_due(0, now));
        let empty = Held { empty_since: Some(now), ..held };
        assert!(!empty.is_due(0, now + EMPTY_FOR / 2) && empty.is_due(0, now + EMPTY_FOR));
    }

    #[test]
    fn lease_that_no_home_renews_is_forgotten() {
        let (start, mut leases) = (Instant::now(), Leases::default());
        let [old, renewed] = ["old", "renewed"].map(|name| RoomName::new(name).unwrap());
        let lease = Lease { node: "a".into(), epoch: 1, ..Lease::default() };
        assert!(leases.insert(old.clone(), lease.clone(), start) && leases.insert(renewed.clone(), lease.clone(), start));
        leases.forget(start + KEPT_FOR / 2);
        assert!(leases.get(&old).is_some());
        assert!(!leases.insert(renewed.clone(), Lease { sessions: 1000, ..lease }, start + KEPT_FOR / 2), "it says nothing new");
        leases.forget(start + KEPT_FOR);
        assert_eq!((leases.get(&old), leases.by_room.len()), (None, 1));
    }
}
