//! Many nodes, one face: nodes meet in NATS. A room's home is the node at which its publishers are; it holds the room's lease, a
//! record in a JetStream bucket that is changed only against its last revision, so that no two nodes hold it. Its packets go out
//! under the lease's epoch; a node with viewers of the room subscribes to them and gives them to its own viewers, each packet
//! once, in order, none older than one it gave before.
//!
//! Nothing here is needed for a node's own rooms: without NATS they go on, and what others hold is looked at again when it is
//! back.

mod feed;
mod lease;
mod wire;

use crate::room::{Others, RoomListing, Rooms};
use crate::service::stopped;
use async_nats::connection::State;
use async_nats::jetstream::kv;
use async_nats::{Client, ConnectOptions, Event};
use futures_util::StreamExt;
use rhytid_shared::RoomName;
use serde::Deserialize;
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tokio_tungstenite::tungstenite::Bytes;

pub(crate) use lease::LeaseError;
pub(crate) use wire::{Kept, StateHead};
use wire::{Lease, MOST_LISTED, NodeListing};

/// Packets that wait for the connection to NATS; what finds no place is lost to other nodes, whose viewers see the next one.
const MOST_WAITING: usize = 4096;
/// How long NATS, or another node through it, may take to answer.
const REQUEST_TIMEOUT: Duration = Duration::from_millis(400);
/// How often a node tells of itself and looks after its leases.
const ROUND: Duration = Duration::from_millis(500);
/// A node that has told nothing for this long is not listed.
const FORGOTTEN: Duration = Duration::from_secs(3);
/// What is kept of rooms nobody comes back to.
const KEPT_FOR: Duration = Duration::from_secs(24 * 3600);
/// Largest record kept of a performer.
const MOST_KEPT_BYTES: i32 = 256 << 10;

/// Which cluster a node joins, and how it gets in.
#[derive(Debug, Clone, PartialEq, Eq, Default, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct ClusterConfig {
    /// Join other nodes through this NATS server, which must have JetStream: `nats://HOST:4222`, `tls://…`, user and password in
    /// the address (several with commas between them).
    #[arg(long = "cluster", id = "cluster", value_name = "URL")]
    pub nats: Option<String>,
    /// A file of NATS credentials (`.creds`).
    #[arg(long = "cluster-creds", value_name = "FILE.creds")]
    pub creds: Option<PathBuf>,
    /// Authorities that NATS's certificate is trusted by, besides the system's.
    #[arg(long = "cluster-ca", value_name = "FILE.pem")]
    pub ca: Option<PathBuf>,
    /// Where other nodes send publishers of a room whose home this node is; default: the address it listens on.
    #[arg(long = "cluster-advertise", value_name = "URL")]
    pub advertise: Option<String>,
}

/// Why a node could not join.
#[derive(Debug, thiserror::Error)]
pub enum ClusterError {
    /// The credentials cannot be read.
    #[error("cannot read NATS credentials {path}: {source}")]
    Credentials {
        /// The file as it was named.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The address or the certificates make no sense, or NATS refuses this node.
    #[error("cannot join the cluster at {url}: {problem}")]
    Connect {
        /// As it was given, without its password.
        url: String,
        /// What happened.
        problem: String,
    },
}

/// A packet on its way to other nodes.
struct Outbound {
    room: RoomName,
    message: Bytes,
}

/// Where a room's packets leave for other nodes.
#[derive(Clone)]
pub(crate) struct Outlet(mpsc::Sender<Outbound>);

impl Outlet {
    /// Sends a packet without waiting; false where it found no place.
    pub fn send(&self, room: &RoomName, head: StateHead, packet: &[u8]) -> bool {
        self.0.try_send(Outbound { room: room.clone(), message: head.message(packet) }).is_ok()
    }
}

/// The buckets that nodes share.
#[derive(Clone)]
struct Buckets {
    leases: kv::Store,
    kept: kv::Store,
}

/// A lease that this node holds.
#[derive(Debug, Clone)]
struct Held {
    lease: Lease,
    /// Of its record; `None` where NATS was not to be had and it has yet to be claimed.
    revision: Option<u64>,
    /// Since when its room has had no publisher.
    empty_since: Option<Instant>,
}

/// This node among others.
pub(crate) struct Cluster {
    client: Client,
    node: String,
    address: String,
    /// Nodes with another character are another cluster: their packets mean nothing here.
    prefix: String,
    outbound: Mutex<Option<mpsc::Receiver<Outbound>>>,
    outlet: Outlet,
    buckets: OnceLock<Buckets>,
    held: Mutex<HashMap<RoomName, Held>>,
    /// Rooms of which this node's viewers want to see something, as they come and go.
    interest: watch::Sender<()>,
    nodes: Mutex<HashMap<String, (Instant, NodeListing)>>,
    leases: Mutex<HashMap<RoomName, Lease>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Cluster {
    /// Starts connecting; NATS may come later.
    pub async fn join(config: &ClusterConfig, url: &str, address: String, character_sha256: &str) -> Result<Arc<Self>, ClusterError> {
        let shown = without_password(url);
        let problem = |problem: String| ClusterError::Connect { url: shown.clone(), problem };
        let mut options = match &config.creds {
            Some(path) => {
                let of_file = |source| ClusterError::Credentials { path: path.display().to_string(), source };
                let text = std::fs::read_to_string(path).map_err(of_file)?;
                ConnectOptions::with_credentials(&text).map_err(of_file)?
            }
            None => ConnectOptions::new(),
        };
        if let Some(ca) = &config.ca {
            options = options.add_root_certificates(ca.clone());
        }
        let servers: Vec<String> = url.split(',').map(|server| server.trim().to_owned()).collect();
        let client = options
            .name("rhytid")
            .retry_on_initial_connect()
            .connection_timeout(Duration::from_secs(3))
            .ping_interval(Duration::from_secs(2))
            .request_timeout(Some(REQUEST_TIMEOUT))
            .reconnect_delay_callback(|attempts| Duration::from_millis((50 * attempts as u64).min(1000)))
            .event_callback(async |event| match event {
                Event::Connected => tracing::info!("NATS reached"),
                Event::Disconnected => tracing::warn!("NATS lost: this node's own rooms go on"),
                event => tracing::warn!(%event, "NATS"),
            })
            .connect(servers)
            .await
            .map_err(|error| problem(error.to_string()))?;
        let (outlet, outbound) = mpsc::channel(MOST_WAITING);
        Ok(Arc::new(Self {
            node: node_id(),
            address,
            prefix: format!("rhytid.{}", &character_sha256[..8.min(character_sha256.len())]),
            client,
            outbound: Mutex::new(Some(outbound)),
            outlet: Outlet(outlet),
            buckets: OnceLock::new(),
            held: Mutex::default(),
            interest: watch::Sender::new(()),
            nodes: Mutex::default(),
            leases: Mutex::default(),
        }))
    }

    /// What rooms need of other nodes.
    pub fn others(&self) -> Others {
        Others { outlet: self.outlet.clone(), interest: self.interest.clone() }
    }

    /// This node's id.
    pub fn node(&self) -> &str {
        &self.node
    }

    /// Why the node is on its own, if so.
    pub fn problem(&self) -> Option<&'static str> {
        match self.client.connection_state() {
            State::Connected if self.buckets.get().is_some() => None,
            State::Connected => Some("NATS has no JetStream yet"),
            _ => Some("NATS is not reached"),
        }
    }

    /// Rooms elsewhere, all or those of one name, by the node that told of them.
    pub fn elsewhere(&self, name: Option<&RoomName>) -> Vec<(String, RoomListing)> {
        let mut nodes = lock(&self.nodes);
        nodes.retain(|_, (heard, _)| heard.elapsed() < FORGOTTEN);
        let rooms = nodes.values().flat_map(|(_, told)| told.rooms.iter().map(|room| (told.node.clone(), room.clone())));
        rooms.filter(|(_, room)| name.is_none_or(|name| name.as_str() == room.name)).collect()
    }

    /// Whose rooms are whose has changed.
    fn interest_changed(&self) {
        self.interest.send_replace(());
    }

    fn subject(&self, rest: &str) -> String {
        format!("{}.{rest}", self.prefix)
    }

    fn packets_of(&self, room: &RoomName) -> String {
        self.subject(&format!("room.{room}"))
    }

    /// Runs the node's part until the service ends.
    pub fn start(self: &Arc<Self>, rooms: Weak<Rooms>, shutdown: &watch::Receiver<bool>) {
        let mut tasks = tokio::task::JoinSet::new();
        if let Some(outbound) = lock(&self.outbound).take() {
            tasks.spawn(self.clone().send_packets(outbound));
        }
        tasks.spawn(self.clone().answer(rooms.clone()));
        tasks.spawn(self.clone().hear_of_nodes());
        tasks.spawn(self.clone().look_after(rooms.clone()));
        tasks.spawn(feed::run(self.clone(), rooms));
        let mut shutdown = shutdown.clone();
        let cluster = self.clone();
        tokio::spawn(async move {
            stopped(&mut shutdown).await;
            tasks.shutdown().await;
            // What publishers of this node had is free at once for the node that they come to.
            cluster.release_all().await;
        });
    }

    async fn send_packets(self: Arc<Self>, mut outbound: mpsc::Receiver<Outbound>) {
        while let Some(Outbound { room, message }) = outbound.recv().await {
            // Without a connection it would only wait: by then it is old.
            if self.client.connection_state() == State::Connected
                && let Err(error) = self.client.publish(self.packets_of(&room), message).await
            {
                tracing::debug!(%room, %error, "packet not sent to other nodes");
            }
        }
    }

    /// Answers what other nodes ask: what slots a room has, its newest state, and to let a room go.
    async fn answer(self: Arc<Self>, rooms: Weak<Rooms>) {
        let subject = self.subject(&format!("node.{}.*", self.node));
        let Ok(mut questions) = self.client.subscribe(subject).await else { return };
        while let Some(message) = questions.next().await {
            let (Some(rooms), Some(reply)) = (rooms.upgrade(), message.reply.clone()) else { continue };
            let Some(room) = std::str::from_utf8(&message.payload).ok().and_then(|name| RoomName::new(name).ok()) else { continue };
            let answer: Bytes = match message.subject.rsplit('.').next() {
                Some("slots") => {
                    let answer = wire::RoomAnswer { slots: rooms.slots(&room) };
                    serde_json::to_vec(&answer).expect("plain data can be written").into()
                }
                Some("state") => wire::join(&rooms.newest(&room)),
                Some("yield") => {
                    lock(&self.held).remove(&room);
                    rooms.evict(&room);
                    Bytes::new()
                }
                _ => continue,
            };
            if let Err(error) = self.client.publish(reply, answer).await {
                tracing::debug!(%error, "question of another node not answered");
            }
        }
    }

    async fn hear_of_nodes(self: Arc<Self>) {
        let Ok(mut listings) = self.client.subscribe(self.subject("listing")).await else { return };
        while let Some(message) = listings.next().await {
            match serde_json::from_slice::<NodeListing>(&message.payload) {
                Ok(told) if told.node != self.node => {
                    lock(&self.nodes).insert(told.node.clone(), (Instant::now(), told));
                }
                Ok(_) => {}
                Err(error) => tracing::debug!(%error, "listing of another node not read"),
            }
        }
    }

    /// Every so often: buckets, leases, and what this node tells of itself.
    async fn look_after(self: Arc<Self>, rooms: Weak<Rooms>) {
        let mut round = tokio::time::interval(ROUND);
        round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut watching: Option<tokio::task::JoinHandle<()>> = None;
        loop {
            round.tick().await;
            let Some(rooms) = rooms.upgrade() else { return };
            if self.client.connection_state() != State::Connected {
                continue;
            }
            if self.buckets.get().is_none() {
                match self.make_buckets().await {
                    Ok(buckets) => drop(self.buckets.set(buckets)),
                    Err(problem) => {
                        tracing::warn!(problem, "JetStream is not to be had");
                        continue;
                    }
                }
            }
            if watching.as_ref().is_none_or(tokio::task::JoinHandle::is_finished) {
                watching = Some(tokio::spawn(self.clone().watch_leases(Arc::downgrade(&rooms))));
            }
            self.renew(&rooms).await;
            let mut told = rooms.list();
            told.truncate(MOST_LISTED);
            let told = NodeListing { node: self.node.clone(), address: self.address.clone(), rooms: told };
            let text = serde_json::to_vec(&told).expect("plain data can be written");
            if let Err(error) = self.client.publish(self.subject("listing"), text.into()).await {
                tracing::debug!(%error, "listing not sent");
            }
        }
    }

    async fn make_buckets(&self) -> Result<Buckets, String> {
        let jetstream = async_nats::jetstream::new(self.client.clone());
        let bucket = |name: &str, max_value_size: i32| kv::Config {
            bucket: format!("{}_{name}", self.prefix.replace('.', "_")),
            max_age: KEPT_FOR,
            max_value_size,
            ..kv::Config::default()
        };
        let leases = jetstream.create_key_value(bucket("leases", 4096)).await.map_err(|error| error.to_string())?;
        let kept = jetstream.create_key_value(bucket("kept", MOST_KEPT_BYTES)).await.map_err(|error| error.to_string())?;
        Ok(Buckets { leases, kept })
    }

    /// What the cluster keeps of a room's slot.
    pub async fn kept(&self, room: &RoomName, slot: &str) -> Option<Kept> {
        let buckets = self.buckets.get()?;
        let bytes = tokio::time::timeout(REQUEST_TIMEOUT, buckets.kept.get(format!("{room}.{slot}"))).await.ok()?.ok()??;
        serde_json::from_slice(&bytes).ok()
    }

    /// Keeps what a room keeps of a slot, for whichever node its publisher comes to next.
    pub fn keep(self: &Arc<Self>, room: &RoomName, slot: &str, kept: &Kept) {
        let Some(buckets) = self.buckets.get().cloned() else { return };
        let (key, text) = (format!("{room}.{slot}"), serde_json::to_vec(kept).expect("plain data can be written"));
        tokio::spawn(async move {
            match tokio::time::timeout(REQUEST_TIMEOUT, buckets.kept.put(&key, text.into())).await {
                Ok(Ok(_)) => {}
                Ok(Err(error)) => tracing::warn!(key, %error, "neutral face not kept in the cluster"),
                Err(_) => tracing::warn!(key, "neutral face not kept in the cluster: no answer"),
            }
        });
    }
}

/// An id that no other start has: 64 random bits from the standard library's own source.
fn node_id() -> String {
    use std::hash::{BuildHasher, Hasher};
    format!("{:016x}", std::collections::hash_map::RandomState::new().build_hasher().finish())
}

/// An address that may be logged.
fn without_password(url: &str) -> String {
    let hide = |server: &str| match (server.find("://"), server.rfind('@')) {
        (Some(scheme), Some(at)) if at > scheme => format!("{}…{}", &server[..scheme + 3], &server[at..]),
        _ => server.to_owned(),
    };
    url.split(',').map(hide).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_are_not_shown() {
        assert_eq!(without_password("nats://me:secret@a:4222,tls://b"), "nats://…@a:4222,tls://b");
        assert_ne!(node_id(), node_id());
    }
}
