//! Many nodes, one face: nodes meet in NATS. A room's home is the node at which its publishers are; it holds the room's lease, a
//! record in a JetStream bucket that is changed only against its last revision, so that no two nodes hold it. Its packets go out
//! under the lease's epoch; a node with viewers of the room subscribes to them and gives them to its own viewers, each packet
//! once, in order, none older than one it gave before.
//!
//! Nothing here is needed for a node's own rooms: without NATS they go on, and what others hold is looked at again when it is
//! back.

mod feed;
mod keeping;
mod lease;
mod wire;

use crate::lock::lock;
use crate::room::{Others, RoomListing, Rooms};
use crate::service::stopped;
use async_nats::connection::State;
use async_nats::jetstream::{kv, stream};
use async_nats::{Client, ConnectOptions, Event, Subject};
use futures_util::StreamExt;
use rhytid_shared::RoomName;
use serde::Deserialize;
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, RwLock, mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};
use tokio_tungstenite::tungstenite::Bytes;

use keeping::Keeping;
use lease::Entering;
pub(crate) use lease::LeaseError;
use lease::Leases;
use wire::{EnterAnswer, EnterQuestion, LISTED_AT_ONCE, Lease, ListingHead, MOST_LISTED, NodeListing};
pub(crate) use wire::{Kept, StateHead};

/// Packets that wait for the connection to NATS; what finds no place is lost to other nodes, whose viewers see the next one.
const MOST_WAITING: usize = 4096;
/// Packets that have waited for longer are not sent: the next one says more.
const OLD: Duration = Duration::from_millis(500);
/// Messages that wait in the connection itself.
const MOST_SENDING: usize = 512;
/// How long NATS, or another node through it, may take to answer.
const REQUEST_TIMEOUT: Duration = Duration::from_millis(300);
/// How long they may take where this node is not to go on without them: a slow NATS is no sign that nobody has a room.
const PATIENT_TIMEOUT: Duration = Duration::from_secs(1);
/// How long NATS may take to make a bucket.
const BUCKET_TIMEOUT: Duration = Duration::from_secs(3);
/// How long a start waits for NATS: a publisher that comes in the first moment would else find a node that is on its own.
const FIRST_JOIN: Duration = Duration::from_secs(2);
/// How often a node looks whether NATS still keeps records: servers that have lost too many of their own kind answer all else.
const RECORDS_ROUND: Duration = Duration::from_secs(2);
/// How long the others may take to find NATS again when it is back: until then who does not answer may live.
const GATHERING: Duration = Duration::from_secs(3);
/// How often a node tells of itself and looks after its leases.
const ROUND: Duration = Duration::from_millis(500);
/// A node that has told something so often and has not heard itself is cut off, whatever TCP thinks: NATS's own pings wait for as
/// long as there is something to send.
const DEAF: u32 = 4;
/// A node that has told nothing for this long is not listed.
const FORGOTTEN: Duration = Duration::from_secs(3);
/// Nodes that are listed.
const MOST_NODES: usize = 1024;
/// Messages of one subscription that wait for this node; more are lost, and their rooms ask for a key packet.
const MOST_UNREAD: usize = 4096;
/// What is kept of rooms nobody comes back to.
const KEPT_FOR: Duration = Duration::from_secs(24 * 3600);
/// Largest lease.
const MOST_LEASE_BYTES: i32 = 4096;
/// Largest record kept of a performer.
const MOST_KEPT_BYTES: i32 = 256 << 10;
/// All leases: those of some 25,000 rooms, of 215 bytes and up to 335 with long names. Beyond that the oldest goes, which is one that no home renews:
/// where fewer rooms than that have a publisher or are opened within an hour.
const ALL_LEASE_BYTES: i64 = 8 << 20;
/// All records of performers: 5 KB with 68 landmarks, some 30 KB with 478. That is a thousand of the latter; beyond that the oldest
/// goes. NATS sets both aside for each character, at each server that keeps them, whether they are used or not.
const ALL_KEPT_BYTES: i64 = 32 << 20;

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
    /// Authorities that NATS's certificate is trusted by, instead of the system's.
    #[arg(long = "cluster-ca", value_name = "FILE.pem")]
    pub ca: Option<PathBuf>,
    /// A certificate that this node shows to NATS.
    #[arg(long = "cluster-cert", value_name = "FILE.pem", requires = "cluster_key")]
    pub cert: Option<PathBuf>,
    /// The private key of --cluster-cert.
    #[arg(long = "cluster-key", id = "cluster_key", value_name = "FILE.pem", requires = "cert")]
    pub key: Option<PathBuf>,
    /// Servers of a NATS cluster that keep each record, 1 to 5; 1 where it is not said.
    #[arg(long = "cluster-replicas", value_name = "N", value_parser = clap::value_parser!(u8).range(1..=5))]
    pub replicas: Option<u8>,
    /// Where other nodes send publishers of a room whose home this node is; default: the address it listens on, which will not do
    /// where that is all addresses (0.0.0.0).
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
    since: Instant,
    subject: Subject,
    message: Bytes,
}

/// Where packets leave for other nodes.
#[derive(Clone)]
pub(crate) struct Outlet {
    prefix: String,
    outbound: mpsc::Sender<Outbound>,
}

impl Outlet {
    /// Where a room's packets leave.
    pub fn of(&self, room: &RoomName) -> RoomOutlet {
        RoomOutlet { subject: packets_of(&self.prefix, room), outbound: self.outbound.clone() }
    }
}

/// Where one room's packets leave for other nodes.
pub(crate) struct RoomOutlet {
    subject: Subject,
    outbound: mpsc::Sender<Outbound>,
}

impl RoomOutlet {
    /// Sends a [`StateHead::message`] without waiting; false where it found no place.
    pub fn send(&self, message: Bytes) -> bool {
        self.outbound.try_send(Outbound { since: Instant::now(), subject: self.subject.clone(), message }).is_ok()
    }
}

fn packets_of(prefix: &str, room: &RoomName) -> Subject {
    format!("{prefix}.room.{room}").into()
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
    /// Of its record; `None` where NATS was not to be had, or has come back, and it has yet to be claimed.
    revision: Option<u64>,
    /// When its record was written.
    renewed: Instant,
    /// Since when its room has had no publisher.
    empty_since: Option<Instant>,
}

/// Connections to NATS.
struct Connections {
    /// Made so far.
    made: AtomicU64,
    /// A new one stands, or one is lost.
    changed: Notify,
}

/// What another node tells of itself.
struct Told {
    heard: Instant,
    address: String,
    /// Its rooms, in the parts in which they come.
    parts: Vec<Vec<RoomListing>>,
}

/// This node among others.
pub(crate) struct Cluster {
    client: Client,
    connections: Arc<Connections>,
    /// Which connection the buckets and leases have been looked at through, and since when.
    joined: watch::Sender<(u64, Instant)>,
    /// Why NATS keeps no records, where that is so.
    lack: Mutex<Option<String>>,
    started: Instant,
    node: String,
    address: String,
    replicas: usize,
    /// Nodes with another character are another cluster: their packets mean nothing here.
    prefix: String,
    outbound: Mutex<Option<mpsc::Receiver<Outbound>>>,
    outlet: Outlet,
    buckets: OnceLock<Buckets>,
    held: Mutex<HashMap<RoomName, Held>>,
    /// Rooms that trackers have asked for, which cannot wait.
    entering: Mutex<HashMap<RoomName, Entering>>,
    /// How often it has told others something since it has last heard that itself, and whether that is too often.
    unheard: AtomicU32,
    is_cut: AtomicBool,
    /// The service ends: no room gets its home here.
    is_leaving: AtomicBool,
    /// Read while a room is claimed.
    claiming: RwLock<()>,
    /// Rooms of which this node's viewers want to see something, as they come and go.
    interest: watch::Sender<()>,
    /// Rooms whose home has changed.
    homes: watch::Sender<()>,
    nodes: Mutex<HashMap<String, Told>>,
    leases: Mutex<Leases>,
    keeping: Keeping,
    /// What empties it, until the service ends.
    keeper: Mutex<Option<JoinHandle<()>>>,
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
        if let (Some(cert), Some(key)) = (&config.cert, &config.key) {
            options = options.add_client_certificate(cert.clone(), key.clone());
        }
        let servers: Vec<String> = url.split(',').map(|server| server.trim().to_owned()).collect();
        // `async-nats` leaves them where they are.
        options = match servers.iter().find_map(|server| login(server)) {
            Some((user, Some(password))) => options.user_and_password(user, password),
            Some((token, None)) => options.token(token),
            None => options,
        };
        let connections = Arc::new(Connections { made: AtomicU64::new(0), changed: Notify::new() });
        let counted = connections.clone();
        let client = options
            .name("rhytid")
            .retry_on_initial_connect()
            .connection_timeout(Duration::from_secs(3))
            // Three of them without an answer end a connection.
            .ping_interval(Duration::from_secs(1))
            .request_timeout(Some(PATIENT_TIMEOUT))
            .subscription_capacity(MOST_UNREAD)
            .client_capacity(MOST_SENDING)
            .reconnect_delay_callback(|attempts| Duration::from_millis((50 * attempts as u64).min(1000)))
            .event_callback(move |event| {
                match &event {
                    Event::Connected => {
                        tracing::info!("NATS reached");
                        counted.made.fetch_add(1, Ordering::SeqCst);
                    }
                    Event::Disconnected => tracing::warn!("NATS lost: this node's own rooms go on"),
                    event => tracing::warn!(%event, "NATS"),
                }
                counted.changed.notify_one();
                std::future::ready(())
            })
            .connect(servers)
            .await
            .map_err(|error| problem(error.to_string()))?;
        let (outlet, outbound) = mpsc::channel(MOST_WAITING);
        let prefix = format!("rhytid.{}", &character_sha256[..8.min(character_sha256.len())]);
        Ok(Arc::new(Self {
            node: node_id(),
            address,
            replicas: usize::from(config.replicas.unwrap_or(1)),
            client,
            connections,
            joined: watch::Sender::new((0, Instant::now())),
            lack: Mutex::default(),
            started: Instant::now(),
            outbound: Mutex::new(Some(outbound)),
            outlet: Outlet { prefix: prefix.clone(), outbound: outlet },
            prefix,
            buckets: OnceLock::new(),
            held: Mutex::default(),
            entering: Mutex::default(),
            unheard: AtomicU32::new(0),
            is_cut: false.into(),
            is_leaving: false.into(),
            claiming: RwLock::new(()),
            interest: watch::Sender::new(()),
            homes: watch::Sender::new(()),
            nodes: Mutex::default(),
            leases: Mutex::default(),
            keeping: Keeping::default(),
            keeper: Mutex::default(),
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
    pub fn problem(&self) -> Option<String> {
        let words = match self.client.connection_state() {
            State::Connected if self.is_cut.load(Ordering::SeqCst) => "NATS does not answer",
            State::Connected => match &*lock(&self.lack) {
                Some(lack) => return Some(format!("NATS keeps no records: {lack}")),
                None if self.joined.borrow().0 == self.connection() => return None,
                None => "NATS has no JetStream yet",
            },
            _ => "NATS is not reached",
        };
        Some(words.to_owned())
    }

    /// Other nodes can be asked, as far as is known.
    fn can_talk(&self) -> bool {
        self.client.connection_state() == State::Connected && !self.is_cut.load(Ordering::SeqCst)
    }

    /// Notes why NATS keeps no records, or that it does.
    fn note_lack(&self, lack: Option<String>) {
        let mut noted = lock(&self.lack);
        if *noted != lack {
            match &lack {
                Some(lack) => tracing::warn!(lack, "NATS keeps no records: this node's own rooms go on"),
                None => tracing::info!("NATS keeps records again"),
            }
            *noted = lack;
        }
    }

    /// Which connection to NATS stands, or stood last.
    fn connection(&self) -> u64 {
        self.connections.made.load(Ordering::SeqCst)
    }

    /// The connection is so fresh that others may not be back yet.
    fn is_gathering(&self) -> bool {
        let (connection, since) = *self.joined.borrow();
        // The first one is as old as this node, and no sign that the others have lost theirs, unless NATS was away meanwhile.
        let may_be_lost = connection > 1 || since.saturating_duration_since(self.started) > FIRST_JOIN;
        may_be_lost && since.elapsed() < GATHERING
    }

    /// Waits until the node has joined, but not for long.
    pub async fn wait(&self) {
        let mut joined = self.joined.subscribe();
        if tokio::time::timeout(FIRST_JOIN, joined.wait_for(|(connection, _)| *connection > 0)).await.is_err() {
            tracing::warn!("NATS is not reached yet: this node is on its own");
        }
    }

    /// Rooms elsewhere, all or those of one name, by the node that told of them.
    pub fn elsewhere(&self, name: Option<&RoomName>) -> Vec<(String, RoomListing)> {
        let mut nodes = lock(&self.nodes);
        nodes.retain(|_, told| told.heard.elapsed() < FORGOTTEN);
        let rooms = nodes.iter().flat_map(|(node, told)| told.parts.iter().flatten().map(|room| (node.clone(), room.clone())));
        rooms.filter(|(_, room)| name.is_none_or(|name| name.as_str() == room.name)).collect()
    }

    /// All nodes that are heard of and this one, by id, each with its address.
    pub fn nodes(&self) -> std::collections::BTreeMap<String, String> {
        let nodes = lock(&self.nodes);
        let others = nodes.iter().filter(|(_, told)| told.heard.elapsed() < FORGOTTEN).map(|(node, told)| (node, &told.address));
        others.chain([(&self.node, &self.address)]).map(|(node, address)| (node.clone(), address.clone())).collect()
    }

    fn subject(&self, rest: &str) -> String {
        format!("{}.{rest}", self.prefix)
    }

    fn packets_of(&self, room: &RoomName) -> Subject {
        packets_of(&self.prefix, room)
    }

    /// Runs the node's part until the service ends.
    pub fn start(self: &Arc<Self>, rooms: Weak<Rooms>, shutdown: &watch::Receiver<bool>) {
        let mut tasks = JoinSet::new();
        if let Some(outbound) = lock(&self.outbound).take() {
            tasks.spawn(self.clone().send_packets(outbound));
        }
        tasks.spawn(self.clone().answer(rooms.clone()));
        tasks.spawn(self.clone().hear_of_nodes(rooms.clone()));
        tasks.spawn(self.clone().look_after(rooms.clone()));
        tasks.spawn(self.clone().look_at_records());
        tasks.spawn(feed::run(self.clone(), rooms));
        // Not cut off in the middle of what it has taken.
        *lock(&self.keeper) = Some(tokio::spawn(self.clone().keep_all(shutdown.clone())));
        let mut shutdown = shutdown.clone();
        tokio::spawn(async move {
            stopped(&mut shutdown).await;
            tasks.shutdown().await;
        });
    }

    async fn send_packets(self: Arc<Self>, mut outbound: mpsc::Receiver<Outbound>) {
        while let Some(Outbound { since, subject, message }) = outbound.recv().await {
            // Without a connection it would only wait: by then it is old.
            if since.elapsed() < OLD
                && self.client.connection_state() == State::Connected
                && let Err(error) = self.client.publish(subject.clone(), message).await
            {
                tracing::debug!(%subject, %error, "packet not sent to other nodes");
            }
        }
    }

    /// Answers what other nodes ask: whether one of them may be a room's home, and for a room's newest state.
    async fn answer(self: Arc<Self>, rooms: Weak<Rooms>) {
        let subject = self.subject(&format!("node.{}.*", self.node));
        let Ok(mut questions) = self.client.subscribe(subject).await else { return };
        while let Some(message) = questions.next().await {
            let (Some(rooms), Some(reply)) = (rooms.upgrade(), message.reply.clone()) else { continue };
            let answer: Bytes = match message.subject.rsplit('.').next() {
                Some("enter") => {
                    let Ok(question) = serde_json::from_slice::<EnterQuestion>(&message.payload) else { continue };
                    let answer = self.let_go(&rooms, &question);
                    serde_json::to_vec(&answer).expect("plain data can be written").into()
                }
                Some("state") => {
                    let Some(room) = std::str::from_utf8(&message.payload).ok().and_then(|name| RoomName::new(name).ok()) else {
                        continue;
                    };
                    wire::join(&rooms.newest(&room))
                }
                _ => continue,
            };
            if let Err(error) = self.client.publish(reply, answer).await {
                tracing::debug!(%error, "question of another node not answered");
            }
        }
    }

    /// Lets go of a room where its publishers allow it.
    fn let_go(&self, rooms: &Rooms, question: &EnterQuestion) -> EnterAnswer {
        let Ok(room) = RoomName::new(&question.room) else { return EnterAnswer::default() };
        let slots = rooms.slots(&room);
        let is_granted = question.takeover || rooms.is_free_for(&room, question.resume().as_ref());
        if is_granted {
            lock(&self.held).remove(&room);
            rooms.evict(&room, None);
        }
        EnterAnswer { is_granted, slots: slots.into_iter().map(|(slot, _)| slot).collect() }
    }

    async fn hear_of_nodes(self: Arc<Self>, rooms: Weak<Rooms>) {
        let Ok(mut listings) = self.client.subscribe(self.subject("listing")).await else { return };
        while let Some(message) = listings.next().await {
            let Ok(ListingHead { node }) = serde_json::from_slice(&message.payload) else {
                tracing::debug!("listing of nobody not read");
                continue;
            };
            if node == self.node {
                self.unheard.store(0, Ordering::SeqCst);
                self.is_cut.store(false, Ordering::SeqCst);
                continue;
            }
            {
                let mut nodes = lock(&self.nodes);
                if nodes.len() >= MOST_NODES {
                    nodes.retain(|_, told| told.heard.elapsed() < FORGOTTEN);
                }
                if nodes.len() >= MOST_NODES && !nodes.contains_key(&node) {
                    continue;
                }
            }
            let Some(told) = serde_json::from_slice::<NodeListing>(&message.payload).ok().filter(NodeListing::is_sound) else {
                tracing::debug!("listing of another node not read");
                continue;
            };
            let Some(rooms) = rooms.upgrade() else { return };
            rooms.want(told.is_partial, told.rooms.iter().filter(|room| room.is_wanted()).map(|room| room.name.as_str()));
            let mut nodes = lock(&self.nodes);
            let known = nodes.entry(told.node).or_insert_with(|| Told { heard: Instant::now(), address: String::new(), parts: Vec::new() });
            (known.heard, known.address) = (Instant::now(), told.address);
            known.parts.resize_with(told.of.clamp(1, MOST_LISTED / LISTED_AT_ONCE), Vec::new);
            if let Some(part) = known.parts.get_mut(told.part) {
                *part = told.rooms;
            }
        }
    }

    /// Every so often: buckets, leases, and what this node tells of itself.
    async fn look_after(self: Arc<Self>, rooms: Weak<Rooms>) {
        let mut round = tokio::time::interval(ROUND);
        round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut watching = JoinSet::new();
        loop {
            tokio::select! {
                _ = round.tick() => {}
                () = self.connections.changed.notified() => {}
            }
            let Some(rooms) = rooms.upgrade() else { return };
            if self.client.connection_state() != State::Connected {
                self.give_up_empty(&rooms);
                continue;
            }
            let connection = self.connection();
            let is_new = self.joined.borrow().0 != connection;
            if is_new {
                self.unheard.store(0, Ordering::SeqCst);
                self.is_cut.store(false, Ordering::SeqCst);
                // Also where they were there before: NATS may have come back without them.
                match self.make_buckets_in_time(&rooms).await {
                    Ok(buckets) => drop(self.buckets.set(buckets)),
                    Err(lack) => {
                        self.note_lack(Some(lack));
                        continue;
                    }
                }
                self.note_lack(None);
                // What it has of them may be older than what is held.
                lock(&self.held).values_mut().for_each(|held| held.revision = None);
            }
            while watching.try_join_next().is_some() {}
            if is_new || watching.is_empty() {
                watching.shutdown().await;
                watching.spawn(self.clone().watch_leases(Arc::downgrade(&rooms)));
            }
            if is_new {
                self.joined.send_replace((connection, Instant::now()));
                self.homes.send_replace(());
                tracing::info!(node = self.node, server = self.client.server_info().server_name, "joined the cluster");
            }
            if self.unheard.fetch_add(1, Ordering::SeqCst) >= DEAF {
                self.unheard.store(0, Ordering::SeqCst);
                if !self.is_cut.swap(true, Ordering::SeqCst) {
                    tracing::warn!("NATS does not answer: this node's own rooms go on");
                }
                if let Err(error) = self.client.force_reconnect().await {
                    tracing::debug!(%error, "cannot connect anew");
                }
                self.give_up_empty(&rooms);
                continue;
            }
            lock(&self.leases).forget(Instant::now());
            if !self.is_cut.load(Ordering::SeqCst) {
                self.renew(&rooms).await;
            }
            // Not for longer than a round, where nothing can be sent.
            let _ = tokio::time::timeout(ROUND, self.tell(&rooms)).await;
        }
    }

    /// Every so often: whether NATS keeps what it is given. A majority of its servers may be gone while this one's goes on.
    async fn look_at_records(self: Arc<Self>) {
        let mut round = tokio::time::interval(RECORDS_ROUND);
        round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut num_missed = 0;
        loop {
            round.tick().await;
            let connection = self.joined.borrow().0;
            let stands = || connection == self.connection() && self.client.connection_state() == State::Connected;
            let Some(buckets) = self.buckets.get().filter(|_| stands()) else { continue };
            let looked = match buckets.leases.stream.get_info().await {
                // Servers that have no leader answer with what each of them knows.
                Ok(info) if info.cluster.as_ref().is_some_and(|cluster| cluster.leader.as_ref().is_none_or(String::is_empty)) => {
                    Err(LEADERLESS.to_owned())
                }
                Ok(_) => Ok(()),
                Err(error) => Err(told_by(&error)),
            };
            num_missed = if looked.is_ok() { 0 } else { num_missed + 1 };
            // One that is slow once is not gone; and of another connection than the one that stands it says nothing.
            if stands() && num_missed != 1 {
                self.note_lack(looked.err());
            }
        }
    }

    /// The buckets, or why they are not to be had. Meanwhile other nodes are told of this one: what it shows of their rooms and they
    /// of its own needs no records.
    async fn make_buckets_in_time(&self, rooms: &Rooms) -> Result<Buckets, String> {
        let making = tokio::time::timeout(BUCKET_TIMEOUT, self.make_buckets());
        tokio::pin!(making);
        let made = loop {
            tokio::select! {
                made = making.as_mut() => break made,
                () = tokio::time::sleep(ROUND) => drop(tokio::time::timeout(ROUND, self.tell(rooms)).await),
            }
        };
        if !matches!(made, Ok(Ok(_))) {
            // Not for longer than a round, where nothing can be sent.
            let _ = tokio::time::timeout(ROUND, self.tell(rooms)).await;
        }
        let replicas = if self.replicas > 1 { format!(" (--cluster-replicas {})", self.replicas) } else { String::new() };
        made.unwrap_or_else(|_| Err(UNANSWERED.to_owned())).map_err(|lack| lack + &replicas)
    }

    /// Tells other nodes of this one's rooms.
    async fn tell(&self, rooms: &Rooms) {
        let mut listed = rooms.list();
        let is_partial = listed.len() > MOST_LISTED;
        listed.truncate(MOST_LISTED);
        let of = listed.len().div_ceil(LISTED_AT_ONCE).max(1);
        for part in 0..of {
            let rooms = listed.drain(..listed.len().min(LISTED_AT_ONCE)).collect();
            let told = NodeListing { node: self.node.clone(), address: self.address.clone(), part, of, is_partial, rooms };
            let text = serde_json::to_vec(&told).expect("plain data can be written");
            if let Err(error) = self.client.publish(self.subject("listing"), text.into()).await {
                tracing::debug!(%error, "listing not sent");
            }
        }
    }

    /// Makes the buckets, or finds that they are there. Each is the stream that a bucket is (ADR-8 of NATS's) and not made as a
    /// bucket: for that `async-nats` asks for more of the account than a server of version 2.9 says.
    async fn make_buckets(&self) -> Result<Buckets, String> {
        let jetstream = async_nats::jetstream::new(self.client.clone());
        let make = async |name: &str, max_message_size: i32, max_bytes: i64| {
            let bucket = format!("{}_{name}", self.prefix.replace('.', "_"));
            let config = stream::Config {
                name: format!("KV_{bucket}"),
                subjects: vec![format!("$KV.{bucket}.>")],
                max_messages_per_subject: 1,
                max_age: KEPT_FOR,
                max_message_size,
                max_bytes,
                num_replicas: self.replicas,
                discard: stream::DiscardPolicy::Old,
                allow_rollup: true,
                deny_delete: true,
                allow_direct: true,
                ..stream::Config::default()
            };
            let stream = jetstream.get_or_create_stream(config).await.map_err(|error| told_by(&error))?;
            let known = &stream.cached_info().config;
            if (known.max_bytes, known.max_message_size, known.max_age) != (max_bytes, max_message_size, KEPT_FOR) {
                // Another version has made it.
                let config = stream::Config { max_bytes, max_message_size, max_age: KEPT_FOR, ..known.clone() };
                match jetstream.update_stream(config).await {
                    Ok(_) => tracing::info!(bucket, before = known.max_bytes, max_bytes, "the bucket has other bounds now"),
                    Err(error) => tracing::warn!(bucket, error = told_by(&error), "the bucket's bounds stay as they were"),
                }
            }
            let num_replicas = stream.cached_info().config.num_replicas;
            if num_replicas != self.replicas {
                tracing::warn!(bucket, num_replicas, wanted = self.replicas, "the bucket is there already: `nats stream edit` changes it");
            }
            jetstream.get_key_value(bucket).await.map_err(|error| told_by(&error))
        };
        Ok(Buckets {
            leases: make("leases", MOST_LEASE_BYTES, ALL_LEASE_BYTES).await?,
            kept: make("kept", MOST_KEPT_BYTES, ALL_KEPT_BYTES).await?,
        })
    }
}

/// JetStream's servers are choosing who leads them, or have no majority for that.
const UNANSWERED: &str = "JetStream does not answer: too few of its servers may be there";
const LEADERLESS: &str = "JetStream has no leader: too few of its servers may be there";

/// What an error of JetStream's says, and what is behind it.
fn told_by(error: &dyn std::error::Error) -> String {
    let mut told = error.to_string();
    let mut behind = error.source();
    while let Some(error) = behind {
        let more = error.to_string();
        if !told.contains(&more) {
            told = format!("{told}: {more}");
        }
        behind = error.source();
    }
    if told.contains("timed out") { UNANSWERED.to_owned() } else { told }
}

/// An id that no other start has: 64 random bits from the standard library's own source.
fn node_id() -> String {
    use std::hash::{BuildHasher, Hasher};
    format!("{:016x}", std::collections::hash_map::RandomState::new().build_hasher().finish())
}

/// User and password in an address of NATS, or a token alone.
fn login(server: &str) -> Option<(String, Option<String>)> {
    let rest = server.split_once("://").map_or(server, |(_, rest)| rest);
    let (login, _) = rest.rsplit_once('@')?;
    Some(match login.split_once(':') {
        Some((user, password)) => (percent_decoded(user), Some(percent_decoded(password))),
        None => (percent_decoded(login), None),
    })
}

/// Text of a URL with its `%40` and the like (RFC 3986, 2.1) as they are meant.
fn percent_decoded(text: &str) -> String {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((&first, behind)) = rest.split_first() {
        let code = behind.get(..2).filter(|_| first == b'%').and_then(|two| u8::from_str_radix(std::str::from_utf8(two).ok()?, 16).ok());
        bytes.push(code.unwrap_or(first));
        rest = if code.is_some() { &behind[2..] } else { behind };
    }
    String::from_utf8_lossy(&bytes).into_owned()
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
        assert_eq!(login("nats://me:s%40c:r%e%zz@a:4222"), Some(("me".into(), Some("s@c:r%e%zz".into()))));
        assert_eq!((login("tls://word@a"), login("a:4222")), (Some(("word".into(), None)), None));
    }
}
