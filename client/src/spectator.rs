//! A viewer without a picture: link and playout together, and in plain words how things stand.

use crate::link::{CharacterSource, Link, LinkOptions, LinkState, LinkStats, ServerAddresses};
use crate::playout::{Playout, PlayoutState, PlayoutStats};
use crate::renderer::RenderFrame;
use rhytid_shared::trust::Trust;
use rhytid_shared::{Character, RoomName};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Whom to watch.
#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub struct WatchArgs {
    /// The server, or nodes of a cluster with commas between them: when one is lost, the next is asked
    #[arg(default_value = "ws://127.0.0.1:7878", value_name = "ws[s]://HOST[:PORT][,…]")]
    pub servers: ServerAddresses,
    /// The room
    #[arg(long, default_value = "demo", value_parser = RoomName::new)]
    pub room: RoomName,
    /// Whom to trust on wss://: the fingerprint that `serve --tls-self-signed` printed, or a PEM file of authorities; else the
    /// public ones
    #[arg(long, value_name = "FINGERPRINT|FILE.pem", value_parser = parse_trust, default_value = "", hide_default_value = true)]
    pub trust: Trust,
    /// What lets it in, where the server wants one
    #[command(flatten)]
    pub token: TokenArgs,
}

/// How a viewer is given its token.
#[derive(Debug, Clone, PartialEq, Eq, Default, clap::Args)]
pub struct TokenArgs {
    /// The token that lets it in, where the server wants one; else from the environment's RHYTID_TOKEN. Others on this machine can
    /// read the arguments of a command: rather use a file
    #[arg(long = "token", value_name = "TOKEN", conflicts_with = "from_file")]
    pub given: Option<String>,
    /// A file with the token
    #[arg(long = "token-file", value_name = "FILE", value_parser = read_token)]
    pub from_file: Option<String>,
}

impl TokenArgs {
    pub(crate) fn token(self) -> Option<String> {
        let token = self.from_file.or(self.given).or_else(|| std::env::var("RHYTID_TOKEN").ok());
        token.map(|token| token.trim().to_owned()).filter(|token| !token.is_empty())
    }
}

/// The token in a file, which is short and one word.
fn read_token(path: &str) -> Result<String, String> {
    let mut text = String::new();
    let file = std::fs::File::open(path).map_err(|error| error.to_string())?;
    std::io::Read::read_to_string(&mut std::io::Read::take(file, 4096), &mut text).map_err(|error| error.to_string())?;
    let token = text.trim();
    let is_word = !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_graphic());
    if is_word { Ok(token.to_owned()) } else { Err("it holds no token".into()) }
}

fn parse_trust(text: &str) -> Result<Trust, String> {
    Trust::from_argument(text, |path| std::fs::read(path))
}

/// Watches one room: takes what the link brings, keeps the playout, says what is the matter.
#[derive(Debug)]
pub struct Spectator {
    link: Link,
    playout: Playout,
    character: Arc<Character>,
    servers: ServerAddresses,
    room: RoomName,
    /// Zero of the playout's time.
    started_at: Instant,
    /// Why the server's character cannot be drawn.
    unusable: Option<String>,
}

/// How things stand, the most urgent first to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StatusKind {
    /// On the way to the server.
    Connecting,
    /// Connected; nobody publishes yet.
    Waiting,
    /// The face moves.
    Live,
    /// The tracker sees no face.
    FaceLost,
    /// Nothing comes any more; the face eases to neutral.
    Silent,
    /// Nothing has come for a while; the face is at rest.
    Idle,
    /// The server is not there; the link tries again.
    ServerGone,
    /// The server does not want this viewer.
    Refused,
    /// The server animates a character that cannot be drawn.
    Unusable,
}

/// How things stand, for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    /// For programs.
    pub kind: StatusKind,
    /// Two or three words.
    pub headline: &'static str,
    /// One sentence.
    pub detail: String,
}

impl Spectator {
    /// Starts watching. `character` is the one that is there already; `wake` is called on the link's thread whenever
    /// something came.
    pub fn open(watch: WatchArgs, character: Arc<Character>, wake: impl Fn() + Send + 'static) -> Self {
        let WatchArgs { servers, room, trust, token } = watch;
        let token = token.token();
        let known_sha256 = Some(character.sha256.clone());
        let options = LinkOptions { servers: servers.clone(), room: room.clone(), trust, token, known_sha256 };
        Self {
            link: Link::open(options, wake),
            playout: Playout::new(&character),
            character,
            servers,
            room,
            started_at: Instant::now(),
            unusable: None,
        }
    }

    /// Takes what has come. Where the server animates another character, `load` gets its `.glb` and makes it drawable.
    pub fn update(&mut self, mut load: impl FnMut(Vec<u8>) -> Result<Arc<Character>, String>) {
        let news = self.link.take_news();
        if let Some(connected) = news.connected {
            self.playout.reconnected(self.time(Instant::now()));
            if let CharacterSource::Fetched(glb) = connected.character {
                match load(glb) {
                    Ok(character) => {
                        self.playout = Playout::new(&character);
                        self.character = character;
                        self.unusable = None;
                    }
                    Err(problem) => self.unusable = Some(problem),
                }
            }
        }
        for arrival in news.frames {
            self.playout.push(&arrival.frame, self.time(arrival.received_at));
        }
    }

    /// The face to draw at `now`.
    pub fn sample(&mut self, now: Instant) -> &RenderFrame {
        let now = self.time(now);
        self.playout.sample(now)
    }

    /// How things stand at `now`, as of the last [`Spectator::sample`].
    pub fn status(&self, now: Instant) -> Status {
        let Self { servers, room, .. } = self;
        let status = |kind, headline, detail| Status { kind, headline, detail };
        match (self.link.state(), self.playout.state()) {
            (LinkState::Refused { message }, _) => status(StatusKind::Refused, "Refused", message),
            (LinkState::Connecting, _) => status(StatusKind::Connecting, "Connecting", format!("Looking for {servers}")),
            (LinkState::Lost { why, retry_at, attempts }, _) => {
                let left = retry_at.saturating_duration_since(now).as_secs_f32().ceil();
                let again = if attempts > 1 { format!("attempt {attempts} failed, trying again") } else { "trying again".into() };
                let next = if left > 0.0 { format!("{again} in {left} s") } else { again };
                status(StatusKind::ServerGone, "Server gone", format!("{servers}: {why}; {next}"))
            }
            (LinkState::Live, _) if self.unusable.is_some() => {
                status(StatusKind::Unusable, "Cannot draw this character", self.unusable.clone().unwrap_or_default())
            }
            (LinkState::Live, PlayoutState::Waiting) => {
                status(StatusKind::Waiting, "Waiting for a face", format!("Nobody publishes to room {room} of {servers} yet"))
            }
            (LinkState::Live, PlayoutState::Live) => status(StatusKind::Live, "Live", format!("Room {room} of {servers}")),
            (LinkState::Live, PlayoutState::FaceLost) => {
                status(StatusKind::FaceLost, "Face lost", "The tracker is there but sees no face".into())
            }
            (LinkState::Live, PlayoutState::Silent) => status(StatusKind::Silent, "Sender silent", "No frame has come for a moment".into()),
            (LinkState::Live, PlayoutState::Idle) => {
                status(StatusKind::Idle, "Sender gone", format!("Waiting for somebody to publish to room {room}"))
            }
        }
    }

    /// True while the next picture may differ from the last.
    pub fn is_moving(&self) -> bool {
        self.playout.is_moving()
    }

    /// What the link counted.
    pub fn link_stats(&self) -> LinkStats {
        self.link.stats()
    }

    /// What playout measured.
    pub fn playout_stats(&self) -> PlayoutStats {
        self.playout.stats()
    }

    /// The room watched.
    pub fn room(&self) -> &RoomName {
        &self.room
    }

    fn time(&self, at: Instant) -> Duration {
        at.saturating_duration_since(self.started_at)
    }
}
