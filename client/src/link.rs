//! Link: a viewer's connection to a server. One blocking thread reads the socket and decodes packets; the picture's
//! thread takes what has come. The connection comes back by itself when it is lost.

mod address;
mod backoff;
mod connection;
mod fetch;
mod inbox;
#[cfg(test)]
mod tests;
mod wire;

pub use address::{AddressError, ServerAddress, ServerAddresses};
pub(crate) use fetch::agent;
pub use inbox::{FrameArrival, LinkNews};

use backoff::Backoff;
use connection::Ended;
use inbox::Inbox;
use rhytid_shared::RoomName;
use rhytid_shared::trust::Trust;
use rhytid_shared::view::ViewHello;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What to watch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkOptions {
    /// Where; where there are several, the next one is tried at once when a connection is lost.
    pub servers: ServerAddresses,
    /// Which room.
    pub room: RoomName,
    /// Whom to trust where the server is encrypted.
    pub trust: Trust,
    /// What lets it in, where the server wants to know. Sent over TLS or to this machine only.
    pub token: Option<String>,
    /// SHA-256 (lower-case hex) of the character that is there already and need not be fetched.
    pub known_sha256: Option<String>,
}

/// How the connection stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkState {
    /// On the way for the first time.
    Connecting,
    /// Connected; the hello has come.
    Live,
    /// Not reachable or gone; the link tries again by itself.
    Lost {
        /// What happened, for people.
        why: String,
        /// When it tries again.
        retry_at: Instant,
        /// Attempts that failed since the connection last stood.
        attempts: u32,
    },
    /// The server does not want this viewer, and would not want it the next time either. The link has ended.
    Refused {
        /// What the server said, for people.
        message: String,
    },
}

/// What the link counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkStats {
    /// Frame packets received.
    pub packets: u64,
    /// Bytes of frame packets (payload; TCP and WebSocket headers come on top).
    pub bytes: u64,
    /// Packets that could not be decoded, and messages that make no sense.
    pub garbage: u64,
    /// Frames dropped because nobody took them in time; the oldest go first.
    pub overflowed: u64,
    /// Connections made.
    pub connects: u64,
    /// There and back, by ping.
    pub round_trip: Option<Duration>,
}

/// A character that a hello named, and where it is.
#[derive(Debug, Clone, PartialEq)]
pub enum CharacterSource {
    /// The one [`LinkOptions::known_sha256`] names, or the one fetched before.
    Known,
    /// The `.glb`, fetched; its SHA-256 is the hello's.
    Fetched(Vec<u8>),
}

/// A connection was made (again). Whatever was known of sessions before is void.
#[derive(Debug, Clone, PartialEq)]
pub struct Connected {
    /// The server's hello.
    pub hello: ViewHello,
    /// Its character.
    pub character: CharacterSource,
}

/// A running link. Dropping it closes the socket.
#[derive(Debug)]
pub struct Link {
    inbox: Arc<Inbox>,
    thread: Option<JoinHandle<()>>,
}

/// How long dropping a link may take: a thread that is just connecting is left to end by itself.
const PATIENCE: Duration = Duration::from_millis(300);

impl Link {
    /// Starts connecting. `wake` is called, on the link's thread, whenever there is something new.
    pub fn open(options: LinkOptions, wake: impl Fn() + Send + 'static) -> Self {
        let inbox = Arc::new(Inbox::new());
        let thread = std::thread::Builder::new()
            .name("rhytid-link".into())
            .spawn({
                let inbox = Arc::clone(&inbox);
                move || run(options, &inbox, &wake)
            })
            .expect("a thread can be started when the program has just begun");
        Self { inbox, thread: Some(thread) }
    }

    /// Takes everything that has come since the last call.
    pub fn take_news(&mut self) -> LinkNews {
        self.inbox.take()
    }

    /// How the connection stands.
    pub fn state(&self) -> LinkState {
        self.inbox.state()
    }

    /// What was counted so far.
    pub fn stats(&self) -> LinkStats {
        self.inbox.stats()
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.inbox.stop();
        let Some(thread) = self.thread.take() else { return };
        let until = Instant::now() + PATIENCE;
        while !thread.is_finished() && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

fn run(mut options: LinkOptions, inbox: &Inbox, wake: &dyn Fn()) {
    let (mut backoff, mut fetch_backoff) = (Backoff::of_connections(), Backoff::of_fetches());
    let num_servers = options.servers.all().len();
    let (mut at, mut num_in_vain) = (0, 0);
    while !inbox.is_stopped() {
        let started_at = Instant::now();
        let connects = inbox.stats().connects;
        let server = options.servers.all()[at].clone();
        let ended = connection::watch(&mut options, &server, inbox, wake);
        at = (at + 1) % num_servers;
        if inbox.stats().connects > connects {
            fetch_backoff = Backoff::of_fetches();
            num_in_vain = 0;
        }
        num_in_vain += 1;
        let state = match ended {
            Ended::Stopped => return,
            Ended::Refused(message) => {
                tracing::warn!(server = %server, room = %options.room, message, "refused");
                LinkState::Refused { message }
            }
            Ended::Lost(why) => {
                // Another node may be there while this one is not; a pause comes when none was.
                let pause = if num_in_vain < num_servers { Duration::ZERO } else { backoff.next_pause(started_at.elapsed()) };
                tracing::debug!(server = %server, why, ?pause, "connection lost");
                LinkState::Lost { why, retry_at: Instant::now() + pause, attempts: backoff.failures() }
            }
            Ended::NoCharacter(why) => {
                // However long the transfer took, it was no good connection.
                let pause = fetch_backoff.next_pause(Duration::ZERO);
                tracing::warn!(server = %server, why, ?pause, "no character");
                LinkState::Lost { why, retry_at: Instant::now() + pause, attempts: fetch_backoff.failures() }
            }
        };
        let retry_at = match &state {
            LinkState::Lost { retry_at, .. } => Some(*retry_at),
            _ => None,
        };
        inbox.set_state(state);
        wake();
        match retry_at {
            Some(at) => inbox.sleep_until(at),
            None => return,
        }
    }
}
