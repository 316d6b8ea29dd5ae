//! Leases: which node is a room's home.

use super::wire::{Lease, RoomAnswer};
use super::{Cluster, Held, REQUEST_TIMEOUT, lock};
use crate::room::Rooms;
use async_nats::connection::State;
use async_nats::jetstream::kv::{CreateErrorKind, Operation, UpdateErrorKind};
use futures_util::StreamExt;
use rhytid_shared::RoomName;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Tries against others that claim the same room in the same moment.
const MOST_TRIES: usize = 5;
/// A home that had no publisher for this long gives its room back; one that reconnects finds it still there.
const EMPTY_FOR: Duration = Duration::from_secs(2);
/// Sessions that a home which died may have had since it claimed the room, and more.
const SESSIONS_OF_A_HOME: u32 = 100_000;

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
    /// NATS does not answer as it should.
    #[error("the cluster does not answer: {0}")]
    Cluster(String),
}

impl LeaseError {
    /// Short and stable, for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Taken => "room_taken",
            Self::Elsewhere { .. } => "room_elsewhere",
            Self::Cluster(_) => "cluster",
        }
    }
}

fn now_millis() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

impl Cluster {
    /// Makes this node a room's home, or says whose it is. Without NATS it is at once, until others can be asked.
    pub async fn enter(&self, rooms: &Rooms, room: &RoomName, slot: &str, takeover: bool) -> Result<(), LeaseError> {
        if lock(&self.held).contains_key(room) {
            return Ok(());
        }
        let before = lock(&self.leases).get(room).cloned().unwrap_or_default();
        let own = |before: &Lease| Lease {
            node: self.node.clone(),
            address: self.address.clone(),
            epoch: now_millis().max(before.epoch + 1),
            sessions: before.sessions.wrapping_add(SESSIONS_OF_A_HOME),
        };
        let (Some(buckets), State::Connected) = (self.buckets.get(), self.client.connection_state()) else {
            return Ok(self.hold(rooms, room, own(&before), None));
        };
        for _ in 0..MOST_TRIES {
            let entry = tokio::time::timeout(REQUEST_TIMEOUT, buckets.leases.entry(room.as_str())).await;
            let entry = match entry {
                Ok(Ok(entry)) => entry.filter(|entry| entry.operation == Operation::Put),
                Ok(Err(error)) => return Err(LeaseError::Cluster(error.to_string())),
                // NATS has gone in this moment.
                Err(_) => return Ok(self.hold(rooms, room, own(&before), None)),
            };
            let found: Option<(u64, Lease)> = entry.and_then(|entry| Some((entry.revision, serde_json::from_slice(&entry.value).ok()?)));
            let Some((revision, lease)) = found else {
                let lease = own(&before);
                match buckets.leases.create(room.as_str(), text_of(&lease)).await {
                    Ok(revision) => return Ok(self.hold(rooms, room, lease, Some(revision))),
                    Err(error) if error.kind() == CreateErrorKind::AlreadyExists => continue,
                    Err(error) => return Err(LeaseError::Cluster(error.to_string())),
                }
            };
            if !lease.node.is_empty() && lease.node != self.node {
                self.check_home(room, &lease, slot, takeover).await?;
            }
            let lease = own(&lease);
            match buckets.leases.update(room.as_str(), text_of(&lease), revision).await {
                Ok(revision) => return Ok(self.hold(rooms, room, lease, Some(revision))),
                Err(error) if error.kind() == UpdateErrorKind::WrongLastRevision => {}
                Err(error) => return Err(LeaseError::Cluster(error.to_string())),
            }
        }
        Err(LeaseError::Taken)
    }

    /// Asks a room's home whether it is still there and what it has; a `takeover` makes it let go.
    async fn check_home(&self, room: &RoomName, lease: &Lease, slot: &str, takeover: bool) -> Result<(), LeaseError> {
        let question = if takeover { "yield" } else { "slots" };
        let subject = self.subject(&format!("node.{}.{question}", lease.node));
        // One that is dead, or stopped, does not answer: its lease is void.
        let Ok(answer) = self.client.request(subject, room.as_str().to_owned().into()).await else { return Ok(()) };
        if takeover {
            return Ok(());
        }
        let answer: RoomAnswer = serde_json::from_slice(&answer.payload).unwrap_or_default();
        if answer.slots.is_empty() {
            return Ok(());
        }
        if answer.slots.iter().any(|taken| taken == slot) {
            return Err(LeaseError::Taken);
        }
        Err(LeaseError::Elsewhere { address: lease.address.clone() })
    }

    fn hold(&self, rooms: &Rooms, room: &RoomName, lease: Lease, revision: Option<u64>) {
        rooms.lead(room, lease.epoch, lease.sessions);
        tracing::info!(%room, epoch = lease.epoch, shared = revision.is_some(), "home of a room");
        lock(&self.held).insert(room.clone(), Held { lease, revision, empty_since: None });
    }

    /// Gives back what has no publisher any more, and claims what could not be claimed before.
    pub(super) async fn renew(&self, rooms: &Rooms) {
        let Some(buckets) = self.buckets.get() else { return };
        let mut due = Vec::new();
        {
            let mut held = lock(&self.held);
            for (room, held) in held.iter_mut() {
                let is_empty = rooms.slots(room).is_empty();
                let since = if is_empty { Some(held.empty_since.unwrap_or_else(Instant::now)) } else { None };
                held.empty_since = since;
                if since.is_some_and(|since| since.elapsed() >= EMPTY_FOR) || held.revision.is_none() {
                    due.push((room.clone(), held.clone()));
                }
            }
        }
        for (room, held) in due {
            if held.empty_since.is_some_and(|since| since.elapsed() >= EMPTY_FOR) {
                lock(&self.held).remove(&room);
                let free = Lease { node: String::new(), address: String::new(), sessions: rooms.num_sessions(&room), ..held.lease };
                if let Some(revision) = held.revision
                    && let Err(error) = buckets.leases.update(room.as_str(), text_of(&free), revision).await
                {
                    tracing::debug!(%room, %error, "room not given back");
                }
                continue;
            }
            // Opened while NATS was away: whoever claims it first keeps it.
            match buckets.leases.entry(room.as_str()).await {
                Ok(Some(entry)) if entry.operation == Operation::Put => {
                    let Ok(other) = serde_json::from_slice::<Lease>(&entry.value) else { continue };
                    let is_free =
                        other.node.is_empty() || other.node == self.node || self.check_home(&room, &other, "", false).await.is_ok();
                    if is_free {
                        let lease = Lease { epoch: held.lease.epoch.max(other.epoch + 1), ..held.lease };
                        if let Ok(revision) = buckets.leases.update(room.as_str(), text_of(&lease), entry.revision).await {
                            self.hold(rooms, &room, lease, Some(revision));
                        }
                    } else {
                        self.lose(rooms, &room);
                    }
                }
                Ok(_) => {
                    if let Ok(revision) = buckets.leases.create(room.as_str(), text_of(&held.lease)).await {
                        self.hold(rooms, &room, held.lease, Some(revision));
                    }
                }
                Err(error) => tracing::debug!(%room, %error, "lease not looked up"),
            }
        }
    }

    /// Another node is the room's home.
    fn lose(&self, rooms: &Rooms, room: &RoomName) {
        tracing::warn!(%room, "another node is the room's home now");
        lock(&self.held).remove(room);
        rooms.evict(room);
    }

    /// Follows all leases: a node that was stopped learns here what was taken from it.
    pub(super) async fn watch_leases(self: Arc<Self>, rooms: Weak<Rooms>) {
        let Some(buckets) = self.buckets.get() else { return };
        let Ok(mut changes) = buckets.leases.watch_with_history(">").await else { return };
        while let Some(Ok(entry)) = changes.next().await {
            let (Some(rooms), Ok(room)) = (rooms.upgrade(), RoomName::new(&entry.key)) else { continue };
            let lease: Option<Lease> = if entry.operation == Operation::Put { serde_json::from_slice(&entry.value).ok() } else { None };
            let Some(lease) = lease else {
                lock(&self.leases).remove(&room);
                continue;
            };
            let is_lost = {
                let held = lock(&self.held);
                held.get(&room).is_some_and(|held| held.revision.is_some_and(|own| own < entry.revision) && lease.node != self.node)
            };
            if is_lost {
                self.lose(&rooms, &room);
            }
            lock(&self.leases).insert(room, lease);
            self.interest_changed();
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

    /// Gives every room back, at the end of the service.
    pub(super) async fn release_all(&self) {
        let all: Vec<_> = lock(&self.held).drain().collect();
        let Some(buckets) = self.buckets.get() else { return };
        for (room, held) in all {
            let free = Lease { node: String::new(), address: String::new(), ..held.lease };
            if let Some(revision) = held.revision {
                let giving = buckets.leases.update(room.as_str(), text_of(&free), revision);
                let _ = tokio::time::timeout(REQUEST_TIMEOUT, giving).await;
            }
        }
    }
}

fn text_of(lease: &Lease) -> tokio_tungstenite::tungstenite::Bytes {
    serde_json::to_vec(lease).expect("plain data can be written").into()
}
