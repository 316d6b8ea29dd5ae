//! The service as a whole: connections in, tasks out, and an orderly end.

use crate::config::{ServerConfig, ServerConfigError, seconds};
use crate::http::router;
use crate::metrics::Metrics;
use crate::room::Rooms;
use axum::extract::Request;
use hyper_util::rt::{TokioIo, TokioTimer};
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::view::{CharacterHello, ViewHello};
use rhytid_shared::{Character, CharacterError, DEFAULT_CHARACTER_GLB};
use std::collections::HashMap;
use std::convert::Infallible;
use std::future::Future;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
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
    /// The address could not be listened on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address as it was given.
        address: String,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Where a connection comes from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer(#[allow(dead_code, reason = "logged with its Debug form")] pub SocketAddr);

/// What all tasks share.
pub(crate) struct Hub {
    pub config: ServerConfig,
    pub character: Arc<Character>,
    pub glb: Bytes,
    /// Path of the character's file on this server.
    pub character_url: String,
    pub hello_character: CharacterHello,
    pub layout: PacketLayout,
    pub rooms: Rooms,
    pub metrics: Arc<Metrics>,
    pub listens_on_loopback: bool,
    /// True once the service ends.
    pub shutdown: watch::Receiver<bool>,
    /// Every task holds the hub, so this is dropped with the last of them, for which the service waits.
    _tasks: mpsc::Sender<Infallible>,
    connections: Mutex<HashMap<IpAddr, usize>>,
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

/// Serves on `listener` until `shutdown` is done, then closes every socket with a reason.
pub async fn run(listener: TcpListener, config: ServerConfig, shutdown: impl Future<Output = ()>) -> Result<(), ServerError> {
    config.validate()?;
    let address = listener.local_addr().map_err(|source| ServerError::Listen { address: config.listen.clone(), source })?;
    let (character, glb) = load_character(config.character.as_deref())?;
    let metrics = Arc::new(Metrics::new());
    let (stop, stops) = watch::channel(false);
    let (tasks, mut tasks_end) = mpsc::channel(1);
    let character_url = format!("/characters/{}.glb", file_name(&character.name));
    let hub = Arc::new(Hub {
        hello_character: ViewHello::new("", &character, character_url.clone()).character,
        layout: PacketLayout::from(&*character),
        rooms: Rooms::new(config.limits.rooms, config.limits.viewers_per_room, metrics.clone()),
        listens_on_loopback: address.ip().is_loopback(),
        character,
        glb: glb.into(),
        character_url,
        metrics,
        shutdown: stops,
        _tasks: tasks,
        connections: Mutex::default(),
        config,
    });
    let app = router(hub.clone());
    tracing::info!(%address, character = hub.character.name, "serving");
    tokio::pin!(shutdown);
    let mut sweep = tokio::time::interval(SWEEP_INTERVAL.min(seconds(hub.config.timeouts.room_idle)));
    loop {
        tokio::select! {
            () = &mut shutdown => break,
            _ = sweep.tick() => hub.rooms.sweep(seconds(hub.config.timeouts.room_idle)),
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => accept(&hub, stream, peer, &app),
                Err(error) => {
                    tracing::warn!(%error, "cannot accept a connection");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            },
        }
    }
    tracing::info!("shutting down");
    drop(listener);
    // Receivers live in the hub, so this cannot fail.
    let _ = stop.send(true);
    drop((app, hub));
    if tokio::time::timeout(SHUTDOWN_TIMEOUT, tasks_end.recv()).await.is_err() {
        tracing::warn!("some sockets did not close in time");
    }
    Ok(())
}

/// Serves one connection in a task of its own, unless its address has too many.
fn accept(hub: &Arc<Hub>, stream: TcpStream, peer: SocketAddr, app: &axum::Router) {
    let Some(place) = Place::take(hub, peer.ip().to_canonical()) else {
        hub.metrics.end("too_many_connections");
        return tracing::debug!(%peer, "too many connections from this address");
    };
    prepare(&stream);
    let (hub, app) = (hub.clone(), app.clone());
    tokio::spawn(async move {
        let place = Arc::new(place);
        // Every request learns where it comes from, and a WebSocket keeps the connection's place.
        let service = hyper::service::service_fn(move |request: hyper::Request<hyper::body::Incoming>| {
            let mut request: Request = request.map(axum::body::Body::new);
            request.extensions_mut().insert(Peer(peer));
            request.extensions_mut().insert(place.clone());
            app.clone().call(request)
        });
        let connection = hyper::server::conn::http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(seconds(hub.config.timeouts.hello))
            .max_buf_size(MAX_REQUEST_HEAD)
            .serve_connection(TokioIo::new(stream), service)
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

/// A connection's place among those of its address; given back on drop.
pub(crate) struct Place {
    hub: Arc<Hub>,
    /// `None` for loopback, whose connections are not counted.
    address: Option<IpAddr>,
}

impl Place {
    fn take(hub: &Arc<Hub>, address: IpAddr) -> Option<Self> {
        if address.is_loopback() {
            return Some(Self { hub: hub.clone(), address: None });
        }
        let mut connections = hub.connections.lock().unwrap_or_else(PoisonError::into_inner);
        let count = connections.entry(address).or_default();
        if *count >= hub.config.limits.connections_per_address {
            return None;
        }
        *count += 1;
        Some(Self { hub: hub.clone(), address: Some(address) })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let Some(address) = self.address else { return };
        let mut connections = self.hub.connections.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = connections.get_mut(&address) {
            *count -= 1;
            if *count == 0 {
                connections.remove(&address);
            }
        }
    }
}

/// A character's name as part of a URL.
fn file_name(name: &str) -> String {
    let name: String = name.chars().take(64).map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    let name = name.trim_matches('-');
    if name.is_empty() { "character".to_owned() } else { name.to_owned() }
}
