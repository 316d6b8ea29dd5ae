//! The service as a whole: connections in, tasks out, and an orderly end.

use crate::cluster::{Cluster, ClusterError};
use crate::config::{Limits, ServerConfig, ServerConfigError, seconds};
use crate::http::router;
use crate::metrics::Metrics;
use crate::profiles::{ProfileError, Profiles};
use crate::recording::{PlayError, PlayRequest, Players, RecordError, Recorder, RecorderStatus};
use crate::room::{Room, Rooms};
use crate::socket::{ErrorMessage, say_and_close};
use crate::stream::{TimedStream, Wire};
use crate::tls::{self, Identity, TlsError};
use crate::token::{Checker, Keys};
use crate::trackers::listen::{self, Port, Trackers};
use crate::trackers::vmc_out::{self, VmcOut};
use axum::extract::Request;
use hyper_util::rt::{TokioIo, TokioTimer};
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::view::{CharacterHello, ViewHello};
use rhytid_shared::{Character, CharacterError, DEFAULT_CHARACTER_GLB};
use std::collections::HashMap;
use std::convert::Infallible;
use std::future::Future;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc, watch};
use tokio_rustls::TlsAcceptor;
use tokio_tungstenite::tungstenite::Bytes;
use tower_service::Service as _;

/// How long sockets may take to close when the service ends.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);
/// How often empty rooms are looked for.
const SWEEP_INTERVAL: Duration = Duration::from_secs(1);
/// Bytes the kernel holds for a peer before its sender waits: a second of packets.
const UNSENT_BYTES: u32 = 4096;
/// Largest head of a request, and hyper's smallest buffer.
const MAX_REQUEST_HEAD: usize = 16 << 10;
/// Connections over a limit that are told so at a time; in a flood the rest are cut without a word.
const MOST_REFUSALS: usize = 64;
/// How long a burst of connections or messages from one address may be: so much as is allowed in this time.
const BURST: Duration = Duration::from_secs(4);
/// Addresses that are kept in mind at a time, some 100 bytes each.
const MOST_ADDRESSES: usize = 1 << 16;
/// A pause where the process has no file descriptor left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Why the service could not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// A setting makes no sense.
    #[error(transparent)]
    Config(#[from] ServerConfigError),
    /// The character file could not be read.
    #[error("cannot read character {path}: {source}")]
    CharacterFile {
        /// The file as it was named.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The character file is none.
    #[error("character {path}: {source}")]
    Character {
        /// The file as it was named.
        path: String,
        /// What is wrong with it.
        source: CharacterError,
    },
    /// The recording could not be played.
    #[error(transparent)]
    Play(PlayError),
    /// The cluster cannot be joined.
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    /// The folder of profiles cannot be used.
    #[error(transparent)]
    Profiles(#[from] ProfileError),
    /// There is no certificate.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The address could not be listened on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address as it was given.
        address: String,
        /// What the system said.
        source: std::io::Error,
    },
}

/// A recording that is played from the start.
#[derive(Debug, Clone, PartialEq)]
pub struct Play {
    /// The recording.
    pub file: std::path::PathBuf,
    /// The room.
    pub room: rhytid_shared::RoomName,
    /// How.
    pub request: PlayRequest,
}

/// Where a connection comes from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer(pub SocketAddr);

/// What all tasks share.
pub(crate) struct Hub {
    pub config: ServerConfig,
    pub character: Arc<Character>,
    pub glb: Bytes,
    /// Path of the character's file on this server.
    pub character_url: String,
    pub hello_character: CharacterHello,
    pub layout: PacketLayout,
    pub rooms: Arc<Rooms>,
    pub recorder: Arc<Recorder>,
    pub players: Players,
    /// This node among others.
    pub cluster: Option<Arc<Cluster>>,
    pub trackers: Trackers,
    pub profiles: Arc<Profiles>,
    pub metrics: Arc<Metrics>,
    pub listens_on_loopback: bool,
    /// Connections are under TLS.
    pub is_encrypted: bool,
    /// What tokens are checked with, where they are demanded.
    pub tokens: Option<Checker>,
    /// True once the service ends.
    pub shutdown: watch::Receiver<bool>,
    /// Every task holds the hub, so this is dropped with the last of them, for which the service waits.
    _tasks: mpsc::Sender<Infallible>,
    connections: Mutex<Connections>,
    refusals: Arc<Semaphore>,
}

/// Begins a recording of `room`, which ends with the room or when it is told to. Done once its file is there.
pub(crate) async fn record(hub: &Hub, room: &Room) -> Result<RecorderStatus, RecordError> {
    let made = room.record_with(&hub.recorder)?;
    // A disk may take its time to make a file.
    let made = tokio::task::spawn_blocking(move || made.recv()).await;
    if let Ok(Ok(Err(error))) = made {
        return Err(error);
    }
    room.recording().ok_or(RecordError::NoFolder)
}

/// Done when the service ends.
pub(crate) async fn stopped(shutdown: &mut watch::Receiver<bool>) {
    // An error means that the service is gone altogether.
    let _ = shutdown.wait_for(|stops| *stops).await;
}

/// Reads a character's file, or takes the built-in one.
pub fn load_character(path: Option<&std::path::Path>) -> Result<(Arc<Character>, Vec<u8>), ServerError> {
    let (shown, glb) = match path {
        Some(path) => {
            let shown = path.display().to_string();
            let glb = std::fs::read(path).map_err(|source| ServerError::CharacterFile { path: shown.clone(), source })?;
            (shown, glb)
        }
        None => ("(built in)".to_owned(), DEFAULT_CHARACTER_GLB.to_vec()),
    };
    let character = Character::from_glb(&glb).map_err(|source| ServerError::Character { path: shown, source })?;
    Ok((Arc::new(character), glb))
}

/// Binds `address` for [`run`].
pub async fn bind(address: &str) -> Result<TcpListener, ServerError> {
    TcpListener::bind(address).await.map_err(|source| ServerError::Listen { address: address.to_owned(), source })
}

/// Serves a character, with the `.glb` it was read from, on `listener` until `shutdown` is done, then closes every socket with
/// a reason. With an `identity` every connection is encrypted.
pub async fn run(
    listener: TcpListener,
    config: ServerConfig,
    (character, glb): (Arc<Character>, Vec<u8>),
    mut identity: Option<Identity>,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServerError> {
    config.validate()?;
    let address = listener.local_addr().map_err(|source| ServerError::Listen { address: config.listen.clone(), source })?;
    let mut keys = config.keys(address)?;
    let (mut ports, mut outs) = (Vec::new(), Vec::new());
    for spec in &config.listen_udp {
        ports.push(Port::bind(spec).await?);
    }
    for spec in &config.vmc_out {
        outs.push(VmcOut::bind(spec).await?);
    }
    let profiles = Profiles::load(config.profiles.as_deref())?;
    let metrics = Arc::new(Metrics::new());
    let cluster = match &config.cluster.nats {
        Some(url) => {
            let scheme = if identity.is_some() { "wss" } else { "ws" };
            if config.cluster.advertise.is_none() && address.ip().is_unspecified() {
                tracing::warn!(%address, "other nodes cannot send publishers here: say --cluster-advertise");
            }
            let advertised = config.cluster.advertise.clone().unwrap_or_else(|| format!("{scheme}://{address}"));
            Some(Cluster::join(&config.cluster, url, advertised, &character.sha256).await?)
        }
        None => None,
    };
    let others = cluster.as_ref().map(|cluster| cluster.others());
    let limits = &config.limits;
    let (stop, stops) = watch::channel(false);
    let (tasks, mut tasks_end) = mpsc::channel(1);
    let recorder = Arc::new(Recorder::new(config.record.clone(), &character, metrics.clone(), tasks.clone()));
    let rooms = Arc::new(Rooms::new(character.clone(), limits.rooms, limits.viewers_per_room, metrics.clone(), recorder.clone(), others));
    let character_url = format!("/characters/{}.glb", file_name(&character.name));
    let hello_character = ViewHello::new("", &character, character_url.clone()).character;
    let layout = PacketLayout::from(&*character);
    let hub = Arc::new(Hub {
        players: Players::default(),
        rooms: rooms.clone(),
        recorder,
        cluster: cluster.clone(),
        hello_character,
        layout,
        trackers: Trackers::default(),
        profiles: Arc::new(profiles),
        listens_on_loopback: address.ip().is_loopback(),
        is_encrypted: identity.is_some(),
        tokens: keys.as_ref().map(Keys::checker),
        character,
        glb: glb.into(),
        character_url,
        metrics,
        shutdown: stops,
        _tasks: tasks,
        connections: Mutex::default(),
        refusals: Arc::new(Semaphore::new(MOST_REFUSALS)),
        config,
    });
    let app = router(hub.clone());
    // In the background: whoever watches is answered at once, and the first publisher does not wait for what all share.
    tokio::task::spawn_blocking({
        let hub = Arc::downgrade(&hub);
        move || hub.upgrade().iter().for_each(|hub| crate::solve::prepare(&hub.character, &hub.config.solve))
    });
    tracing::info!(%address, character = hub.character.name, "serving");
    if let Some(cluster) = &cluster {
        cluster.start(Arc::downgrade(&rooms), &hub.shutdown);
        cluster.wait().await;
    }
    if let Some(Play { file, room, request }) = hub.config.play.clone() {
        hub.players.start(&hub, &room, file, request, None, |_| true).await.map_err(ServerError::Play)?;
    }
    listen::start(&hub, ports);
    vmc_out::start(&hub, outs);
    tokio::pin!(shutdown);
    let acceptor = identity.as_ref().map(Identity::acceptor);
    let mut reload = tokio::time::interval(tls::RELOAD_INTERVAL);
    let mut sweep = tokio::time::interval(SWEEP_INTERVAL.min(seconds(hub.config.timeouts.room_idle)));
    loop {
        tokio::select! {
            () = &mut shutdown => break,
            _ = sweep.tick() => {
                hub.rooms.sweep(seconds(hub.config.timeouts.room_idle));
                hub.connections().forget(Instant::now());
            }
            _ = reload.tick() => {
                identity.iter_mut().for_each(Identity::reload);
                keys.iter_mut().for_each(Keys::reload);
            }
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => accept(&hub, stream, peer, &app, acceptor.as_ref()),
                Err(error) => {
                    tracing::warn!(%error, "cannot accept a connection");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            },
        }
    }
    tracing::info!("shutting down");
    drop(listener);
    if let Some(cluster) = &cluster {
        cluster.leave(&rooms).await;
    }
    drop(rooms);
    // Receivers live in the hub, so this cannot fail.
    let _ = stop.send(true);
    hub.rooms.wake_viewers();
    drop((app, hub));
    if tokio::time::timeout(SHUTDOWN_TIMEOUT, tasks_end.recv()).await.is_err() {
        tracing::warn!("some sockets did not close in time");
    }
    if let Some(cluster) = &cluster {
        cluster.keep_rest().await;
    }
    Ok(())
}

/// Serves one connection in a task of its own, unless there are too many.
fn accept(hub: &Arc<Hub>, stream: TcpStream, peer: SocketAddr, app: &axum::Router, acceptor: Option<&TlsAcceptor>) {
    prepare(&stream);
    let place = match Place::take(hub, peer.ip()) {
        Ok(place) => place,
        Err(error) => return refuse(hub, stream, peer, &error, acceptor.is_some()),
    };
    let (hub, app, acceptor) = (hub.clone(), app.clone(), acceptor.cloned());
    tokio::spawn(async move {
        let place = Arc::new(place);
        let wire = match &acceptor {
            None => Wire::Plain(stream),
            // In a box of its own: what a handshake needs would stay with the task for as long as the connection lives.
            Some(acceptor) => match Box::pin(tls::shake_hands(&hub, acceptor, stream, peer)).await {
                Some(wire) => wire,
                None => return,
            },
        };
        // Every request learns where it comes from, and a WebSocket keeps the connection's place.
        let service = hyper::service::service_fn(move |request: hyper::Request<hyper::body::Incoming>| {
            let mut request: Request = request.map(axum::body::Body::new);
            request.extensions_mut().insert(Peer(peer));
            request.extensions_mut().insert(place.clone());
            let (mut app, place) = (app.clone(), place.clone());
            async move {
                // Nothing else is read from the connection meanwhile.
                if let Some(due) = place.take_request(Instant::now()) {
                    tokio::time::sleep_until(due.into()).await;
                }
                app.call(request).await
            }
        });
        let connection = hyper::server::conn::http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(seconds(hub.config.timeouts.hello))
            .max_buf_size(MAX_REQUEST_HEAD)
            .serve_connection(TokioIo::new(TimedStream::new(wire, seconds(hub.config.timeouts.write))), service)
            .with_upgrades();
        tokio::pin!(connection);
        let mut shutdown = hub.shutdown.clone();
        let result = tokio::select! {
            result = connection.as_mut() => result,
            () = stopped(&mut shutdown) => {
                connection.as_mut().graceful_shutdown();
                connection.await
            }
        };
        if let Err(error) = result {
            tracing::debug!(%peer, %error, "connection ended");
        }
    });
}

/// Tells a connection that there are too many, in a task of its own where there is room for one. An encrypted one is cut: a
/// handshake costs more than the word is worth.
fn refuse(hub: &Hub, stream: TcpStream, peer: SocketAddr, error: &ErrorMessage, is_encrypted: bool) {
    hub.metrics.end(error.code);
    tracing::debug!(%peer, message = error.message, "connection refused");
    if is_encrypted {
        return;
    }
    let Ok(permit) = hub.refusals.clone().try_acquire_owned() else { return };
    let body = serde_json::to_string(error).expect("plain data can be written");
    let answer = format!(
        "HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    );
    tokio::spawn(async move {
        say_and_close(Wire::Plain(stream), answer.as_bytes()).await;
        drop(permit);
    });
}

/// Small packets at once, and no more of them in the kernel than a second's worth.
fn prepare(stream: &TcpStream) {
    let socket = socket2::SockRef::from(stream);
    if let Err(error) = socket.set_tcp_nodelay(true) {
        tracing::debug!(%error, "cannot set TCP_NODELAY");
    }
    #[cfg(any(target_os = "linux", target_os = "android"))]
    if let Err(error) = socket.set_tcp_notsent_lowat(UNSENT_BYTES) {
        tracing::debug!(%error, "cannot set TCP_NOTSENT_LOWAT");
    }
    #[cfg(not(any(target_os = "linux", target_os = "android")))]
    if let Err(error) = socket.set_send_buffer_size(UNSENT_BYTES as usize) {
        tracing::debug!(%error, "cannot set SO_SNDBUF");
    }
}

/// Connections at a time, altogether and by address.
#[derive(Debug, Default)]
struct Connections {
    total: usize,
    by_address: HashMap<IpAddr, Host>,
}

/// What an address has, and what it may have soon.
#[derive(Debug, Default)]
struct Host {
    connections: usize,
    arrivals: Allowance,
    messages: Allowance,
    requests: Allowance,
}

/// So many a second, after a burst of [`BURST`].
#[derive(Debug, Default)]
pub(crate) struct Allowance {
    /// When what came so far would have come at the allowed rate.
    due: Option<Instant>,
}

impl Allowance {
    /// Counts one; gives when it would have come at the allowed rate, where that is later than now.
    fn take(&mut self, per_second: u32, now: Instant) -> Option<Instant> {
        // The first one begins a whole burst.
        let earliest = now.checked_sub(BURST).unwrap_or(now);
        let due = self.due.unwrap_or(earliest).max(earliest) + Duration::from_secs(1) / per_second;
        self.due = Some(due);
        (due > now).then_some(due)
    }

    /// Counts one where the rate allows it now.
    pub fn take_if_free(&mut self, per_second: u32, now: Instant) -> bool {
        let is_free = self.due.is_none_or(|due| due <= now);
        if is_free {
            self.take(per_second, now);
        }
        is_free
    }

    /// Nothing of it needs to be kept in mind.
    fn is_whole(&self, now: Instant) -> bool {
        self.due.is_none_or(|due| due + BURST <= now)
    }
}

impl Connections {
    /// Counts one more of `address`, unless that is too many.
    fn take(&mut self, address: Option<IpAddr>, limits: &Limits, now: Instant) -> Result<(), ErrorMessage> {
        let refuse = |who: &str, most: usize| {
            Err(ErrorMessage::new("too_many_connections", format!("{who} has {most} connections already, which is its limit")))
        };
        if self.total >= limits.connections {
            return refuse("the server", limits.connections);
        }
        if let Some(address) = address {
            if self.by_address.len() >= MOST_ADDRESSES && !self.by_address.contains_key(&address) {
                return Err(ErrorMessage::new("too_many_connections", "the server has to do with too many addresses"));
            }
            let host = self.by_address.entry(address).or_default();
            if host.connections >= limits.connections_per_address {
                return refuse("this address", limits.connections_per_address);
            }
            let most = limits.connections_per_second;
            if !host.arrivals.take_if_free(most, now) {
                let message = format!("this address makes more than {most} connections a second, which is its limit");
                return Err(ErrorMessage::new("too_many_handshakes", message));
            }
            host.connections += 1;
        }
        self.total += 1;
        Ok(())
    }

    /// Counts a message of a publisher, or of who commands one; gives the time before which no other shall be read.
    fn take_message(&mut self, address: Option<IpAddr>, limits: &Limits, now: Instant) -> Option<Instant> {
        let host = self.by_address.get_mut(&address?)?;
        host.messages.take(limits.frames_per_second_per_address, now)
    }

    /// Counts a request; gives the time before which it shall not be answered.
    fn take_request(&mut self, address: Option<IpAddr>, limits: &Limits, now: Instant) -> Option<Instant> {
        let host = self.by_address.get_mut(&address?)?;
        host.requests.take(limits.requests_per_second_per_address, now)
    }

    fn give_back(&mut self, address: Option<IpAddr>) {
        self.total -= 1;
        if let Some(host) = address.and_then(|address| self.by_address.get_mut(&address)) {
            host.connections -= 1;
        }
    }

    /// Forgets addresses that have gone.
    fn forget(&mut self, now: Instant) {
        self.by_address.retain(|_, host| host.connections > 0 || !host.arrivals.is_whole(now));
    }
}

/// The address that a connection counts for. Loopback counts for none; a host with IPv6 has a whole /64 to itself, from which it
/// may take an address for each connection (RFC 4291, 2.5.4).
fn counted_as(address: IpAddr) -> Option<IpAddr> {
    match address.to_canonical() {
        address if address.is_loopback() => None,
        IpAddr::V6(address) => Some(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)).into()),
        address => Some(address),
    }
}

/// A connection's place among all; given back on drop.
pub(crate) struct Place {
    hub: Arc<Hub>,
    address: Option<IpAddr>,
}

impl Place {
    fn take(hub: &Arc<Hub>, address: IpAddr) -> Result<Self, ErrorMessage> {
        let address = counted_as(address);
        hub.connections().take(address, &hub.config.limits, Instant::now())?;
        hub.metrics.connections.inc();
        Ok(Self { hub: hub.clone(), address })
    }

    /// Counts a request; gives the time before which it shall not be answered.
    fn take_request(&self, now: Instant) -> Option<Instant> {
        self.address?;
        self.hub.connections().take_request(self.address, &self.hub.config.limits, now)
    }

    /// Counts a message of a publisher, or of who commands one; gives the time before which no other shall be read.
    pub fn take_message(&self, now: Instant) -> Option<Instant> {
        // Loopback, which is not limited, costs no lock.
        self.address?;
        self.hub.connections().take_message(self.address, &self.hub.config.limits, now)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.hub.connections().give_back(self.address);
        self.hub.metrics.connections.dec();
    }
}

impl Hub {
    fn connections(&self) -> MutexGuard<'_, Connections> {
        // Counts are whole at each step, also where a holder has panicked.
        self.connections.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A character's name as part of a URL.
fn file_name(name: &str) -> String {
    let name: String = name.chars().take(64).map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    let name = name.trim_matches('-');
    if name.is_empty() { "character".to_owned() } else { name.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_are_limited_altogether_and_by_address() {
        let limits = Limits { connections: 4, connections_per_address: 2, ..Limits::default() };
        let mut connections = Connections::default();
        let of = |text: &str| counted_as(text.parse().unwrap());
        let now = Instant::now();
        let mut take = |text: &str| connections.take(of(text), &limits, now).map_err(|error| error.message);
        let full = Err("this address has 2 connections already, which is its limit".to_owned());
        assert_eq!(take("192.0.2.1"), Ok(()));
        assert_eq!(take("::ffff:192.0.2.1"), Ok(()), "IPv4 in IPv6's clothes");
        assert_eq!(take("192.0.2.1"), full);
        assert_eq!(take("2001:db8::1"), Ok(()));
        assert_eq!(take("2001:db8::ffff:2"), Ok(()));
        assert_eq!(take("192.0.2.7"), Err("the server has 4 connections already, which is its limit".to_owned()));
        connections.give_back(of("192.0.2.1"));
        let now = Instant::now();
        let mut take = |text: &str| connections.take(of(text), &limits, now).map_err(|error| error.message);
        assert_eq!(take("2001:db8::3"), full, "one /64 is one host");
        assert_eq!(take("2001:db8:0:1::1"), Ok(()));
        connections.give_back(of("192.0.2.1"));
        connections.forget(now + 2 * BURST);
        assert!(!connections.by_address.contains_key(&of("192.0.2.1").unwrap()), "nothing is kept of who has gone");
    }

    #[test]
    fn loopback_counts_for_no_address() {
        let limits = Limits { connections: 3, connections_per_address: 1, ..Limits::default() };
        let mut connections = Connections::default();
        for address in ["127.0.0.1", "127.0.0.1", "::1"] {
            connections.take(counted_as(address.parse().unwrap()), &limits, Instant::now()).unwrap();
        }
        assert!(connections.take(None, &limits, Instant::now()).is_err(), "but altogether");
    }

    #[test]
    fn address_that_connects_again_and_again_is_held_to_its_rate() {
        let limits = Limits { connections_per_second: 10, ..Limits::default() };
        let mut connections = Connections::default();
        let start = Instant::now() + Duration::from_secs(60);
        let address = counted_as("192.0.2.1".parse().unwrap());
        // A hundred a second for ten seconds.
        let mut num_taken = 0;
        for k in 0..1000 {
            let now = start + Duration::from_millis(10) * k;
            if connections.take(address, &limits, now).is_ok() {
                num_taken += 1;
                connections.give_back(address);
                connections.forget(now);
            }
        }
        assert!((135..=145).contains(&num_taken), "{num_taken}: a burst of 40, then 10 a second");
        let other = counted_as("192.0.2.2".parse().unwrap());
        assert!(connections.take(other, &limits, start + Duration::from_secs(10)).is_ok(), "others are not held");
    }

    #[test]
    fn publishers_of_one_address_share_its_rate() {
        let limits = Limits { frames_per_second_per_address: 100, ..Limits::default() };
        let mut connections = Connections::default();
        let address = counted_as("192.0.2.1".parse().unwrap());
        let mut now = Instant::now() + Duration::from_secs(60);
        connections.take(address, &limits, now).unwrap();
        let start = now;
        for _ in 0..1000 {
            now = connections.take_message(address, &limits, now).unwrap_or(now);
        }
        assert!((now - start).as_secs_f64() > 5.5, "{:?}", now - start);
        assert_eq!(connections.take_message(None, &limits, now), None, "loopback");
    }

    #[test]
    fn requests_of_one_address_are_slowed_down_whatever_connection_they_come_by() {
        let limits = Limits { requests_per_second_per_address: 10, ..Limits::default() };
        let mut connections = Connections::default();
        let address = counted_as("192.0.2.1".parse().unwrap());
        let start = Instant::now() + Duration::from_secs(60);
        connections.take(address, &limits, start).unwrap();
        let num_free = (0..100).take_while(|_| connections.take_request(address, &limits, start).is_none()).count();
        assert_eq!(num_free, 40, "a page that loads waits for nothing");
        let mut now = start;
        for _ in 0..100 {
            now = connections.take_request(address, &limits, now).unwrap_or(now);
        }
        assert!((9.9..10.3).contains(&(now - start).as_secs_f64()), "{:?}", now - start);
        assert_eq!(connections.take_request(None, &limits, now), None, "loopback");
    }
}
