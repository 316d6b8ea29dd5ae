//! What a user may set: the listening address, the character, every limit and every time-out.

use crate::cluster::ClusterConfig;
use crate::recording::RecordConfig;
use crate::service::Play;
use crate::solve::SolveConfig;
use crate::token::{self, Keys};
use crate::trackers::spec::{ListenSpec, VmcOutSpec};
use rhytid_shared::limits::MAX_MESSAGE_BYTES;
use serde::Deserialize;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Most ports for trackers, and most addresses that get VMC.
const MOST_PORTS: usize = 64;

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ServerConfigError {
    /// The file could not be read.
    #[error("cannot read config {path}: {source}")]
    Io {
        /// The file as it was named.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no TOML, or has a field that is none.
    #[error("config {path}, line {line}: {problem}")]
    Toml {
        /// The file as it was named.
        path: String,
        /// Counted from 1.
        line: usize,
        /// What is wrong with it, in one line.
        problem: String,
    },
    /// A value outside its range.
    #[error("config field {field} is {got}, expected {expected}")]
    Range {
        /// Path of the field.
        field: &'static str,
        /// Its value.
        got: String,
        /// The range.
        expected: &'static str,
    },
    /// Everybody could do everything.
    #[error(
        "others can reach this address, so it must be said who may do what: give --token-key FILE (rhytid-server token --new-key FILE \
         makes one), or --insecure where everybody may do everything"
    )]
    Open,
    /// Everybody could send datagrams to it.
    #[error(
        "tokens are demanded, but others can reach {protocol}={address}, and datagrams bear none: say which addresses they may come \
         from with option allow=IP, or give --insecure"
    )]
    OpenPort {
        /// What it listens for.
        protocol: &'static str,
        /// Where.
        address: SocketAddr,
    },
    /// The keys of the tokens cannot be had.
    #[error(transparent)]
    Token(#[from] token::TokenError),
    /// A setting of the solve makes no sense.
    #[error(transparent)]
    Solve(#[from] crate::solve::ConfigError),
}

/// Everything the service can be told.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ServerConfig {
    /// Address and port; port 0 takes a free one. Loopback unless the user says otherwise.
    pub listen: String,
    /// The character's `.glb`; the built-in one where there is none.
    pub character: Option<PathBuf>,
    /// Ports that listen for trackers, each `PROTOCOL=ADDRESS:PORT[,option=value…]`.
    pub listen_udp: Vec<ListenSpec>,
    /// Where rooms' faces are sent as VMC, each `ADDRESS:PORT[,room=NAME]`.
    pub vmc_out: Vec<VmcOutSpec>,
    /// Folder of performers' profiles, read when the service starts and written when a fit ends.
    pub profiles: Option<PathBuf>,
    /// Other nodes.
    pub cluster: ClusterConfig,
    /// How much of everything.
    pub limits: Limits,
    /// How long for everything.
    pub timeouts: Timeouts,
    /// Who may come from a browser.
    pub access: Access,
    /// Recordings.
    pub record: RecordConfig,
    /// A recording that is played from the start; not in files.
    #[serde(skip)]
    pub play: Option<Play>,
    /// Encryption.
    pub tls: Tls,
    /// The solve.
    pub solve: SolveConfig,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:7878".into(),
            character: None,
            listen_udp: Vec::new(),
            vmc_out: Vec::new(),
            profiles: None,
            cluster: ClusterConfig::default(),
            limits: Limits::default(),
            timeouts: Timeouts::default(),
            access: Access::default(),
            record: RecordConfig::default(),
            play: None,
            tls: Tls::default(),
            solve: SolveConfig::default(),
        }
    }
}

/// How much of everything the service takes.
#[derive(Debug, Clone, PartialEq, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Rooms at a time.
    #[arg(id = "max-rooms", long = "max-rooms", default_value_t = Self::default().rooms, value_name = "N")]
    pub rooms: usize,
    /// Viewers in one room.
    #[arg(id = "max-viewers", long = "max-viewers", default_value_t = Self::default().viewers_per_room, value_name = "N")]
    pub viewers_per_room: usize,
    /// Bytes in one message of a publisher.
    #[arg(id = "max-message", long = "max-message", default_value_t = Self::default().message_bytes, value_name = "BYTES")]
    pub message_bytes: usize,
    /// Messages a second from one publisher; a faster one is slowed down.
    #[arg(id = "max-fps", long = "max-fps", default_value_t = Self::default().frames_per_second, value_name = "N")]
    pub frames_per_second: u32,
    /// Bad frames in a row that end a publisher's session.
    #[arg(id = "max-bad-frames", long = "max-bad-frames", default_value_t = Self::default().bad_frames_in_a_row, value_name = "N")]
    pub bad_frames_in_a_row: u32,
    /// Connections altogether, each a file descriptor and about 5 KiB.
    #[arg(id = "max-connections-in-all", long = "max-connections-in-all", default_value_t = Self::default().connections, value_name = "N")]
    pub connections: usize,
    /// Connections from one address, or one /64 of IPv6; does not hold for loopback.
    #[arg(id = "max-connections", long = "max-connections", default_value_t = Self::default().connections_per_address, value_name = "N")]
    pub connections_per_address: usize,
    /// New connections a second from one address, after a burst of four seconds' worth; does not hold for loopback.
    #[arg(id = "max-connection-rate", long = "max-connection-rate", default_value_t = Self::default().connections_per_second, value_name = "N")]
    pub connections_per_second: u32,
    /// Messages a second from all publishers of one address; faster ones are slowed down. Does not hold for loopback.
    #[arg(id = "max-address-fps", long = "max-address-fps", default_value_t = Self::default().frames_per_second_per_address, value_name = "N")]
    pub frames_per_second_per_address: u32,
    /// Requests over HTTP a second from one address, after a burst of four seconds' worth; faster ones are slowed down. Does not hold
    /// for loopback.
    #[arg(id = "max-request-rate", long = "max-request-rate", default_value_t = Self::default().requests_per_second_per_address, value_name = "N")]
    pub requests_per_second_per_address: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            rooms: 1024,
            viewers_per_room: 4096,
            message_bytes: MAX_MESSAGE_BYTES,
            // Five percent of a core, and 16 times a fast face camera.
            frames_per_second: 1000,
            bad_frames_in_a_row: 100,
            // Under a hundred megabytes of viewers.
            connections: 16_384,
            // A class behind one router.
            connections_per_address: 256,
            // A page that loads and its sockets, several times over.
            connections_per_second: 16,
            // A studio of sixty faces.
            frames_per_second_per_address: 4000,
            // A class whose pages all look every second who is there.
            requests_per_second_per_address: 256,
        }
    }
}

/// How long the service waits, seconds.
#[derive(Debug, Clone, PartialEq, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct Timeouts {
    /// For a request's head, and for a publisher's hello.
    #[arg(id = "hello-timeout", long = "hello-timeout", default_value_t = Self::default().hello, value_name = "SECONDS")]
    pub hello: f64,
    /// Between pings of a publisher, and of a viewer that gets no packets.
    #[arg(id = "ping-interval", long = "ping-interval", default_value_t = Self::default().ping, value_name = "SECONDS")]
    pub ping: f64,
    /// Without a sign of life from a publisher (frames or pongs).
    #[arg(id = "publisher-timeout", long = "publisher-timeout", default_value_t = Self::default().publisher_idle, value_name = "SECONDS")]
    pub publisher_idle: f64,
    /// Without a pong from a viewer; a laptop that slept for a minute is still there afterwards.
    #[arg(id = "viewer-timeout", long = "viewer-timeout", default_value_t = Self::default().viewer_idle, value_name = "SECONDS")]
    pub viewer_idle: f64,
    /// For a write to get anywhere, on a socket or in an answer over HTTP.
    #[arg(id = "write-timeout", long = "write-timeout", default_value_t = Self::default().write, value_name = "SECONDS")]
    pub write: f64,
    /// That a room stays without publisher and viewers.
    #[arg(id = "room-timeout", long = "room-timeout", default_value_t = Self::default().room_idle, value_name = "SECONDS")]
    pub room_idle: f64,
    /// That a replay stands still, stopped or at its end, before it leaves its room; one that the server was started with stays.
    #[arg(id = "replay-timeout", long = "replay-timeout", default_value_t = Self::default().replay_idle, value_name = "SECONDS")]
    pub replay_idle: f64,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self { hello: 10.0, ping: 5.0, publisher_idle: 15.0, viewer_idle: 90.0, write: 75.0, room_idle: 60.0, replay_idle: 600.0 }
    }
}

/// Who may come, and from where in a browser. Programs that send no `Origin` are not asked for it.
#[derive(Debug, Clone, PartialEq, Default, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct Access {
    /// Host names under which this server may be asked for, besides localhost and IP addresses (repeat for several).
    #[arg(long = "allow-host", value_name = "HOST")]
    pub hosts: Vec<String>,
    /// Origins of other sites whose pages may use and read it, e.g. `https://example.org` (repeat for several).
    #[arg(long = "allow-origin", value_name = "ORIGIN")]
    pub origins: Vec<String>,
    /// Demand tokens signed with a key of this file (`rhytid-server token` makes both); read again when it changes.
    #[arg(long = "token-key", value_name = "FILE")]
    pub token_key: Option<PathBuf>,
    /// Listen for other machines without tokens, or take tokens without TLS.
    #[arg(long = "insecure")]
    pub insecure: bool,
}

/// Encryption. Without any of it the server speaks plain HTTP. A phone's camera and a browser's WebGPU need it, except on
/// loopback.
#[derive(Debug, Clone, PartialEq, Eq, Default, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct Tls {
    /// Serve https and wss with this certificate (PEM, its chain behind it); read again when it changes.
    #[arg(id = "tls-cert", long = "tls-cert", value_name = "FILE.pem", requires = "tls-key")]
    pub cert: Option<PathBuf>,
    /// The private key of --tls-cert (PEM).
    #[arg(id = "tls-key", long = "tls-key", value_name = "FILE.pem", requires = "tls-cert")]
    pub key: Option<PathBuf>,
    /// Serve https and wss with a certificate made at the start, and print its fingerprint.
    #[arg(id = "tls-self-signed", long = "tls-self-signed", conflicts_with = "tls-cert")]
    pub self_signed: bool,
}

impl ServerConfig {
    /// Reads a TOML file; fields it does not name keep their defaults.
    pub fn from_file(path: &Path) -> Result<Self, ServerConfigError> {
        let shown = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| ServerConfigError::Io { path: shown.clone(), source })?;
        Self::from_toml(&text, &shown)
    }

    /// Reads the text of a file that errors call `shown`.
    pub(crate) fn from_toml(text: &str, shown: &str) -> Result<Self, ServerConfigError> {
        toml::from_str(text).map_err(|error: toml::de::Error| ServerConfigError::Toml {
            path: shown.to_owned(),
            line: 1 + text.bytes().take(error.span().map_or(0, |span| span.start)).filter(|byte| *byte == b'\n').count(),
            problem: error.message().lines().collect::<Vec<_>>().join(", "),
        })
    }

    /// Checks that a server on `address` knows who may do what: off loopback it needs keys of tokens, or to be told that it
    /// does not.
    pub fn check_access(&self, address: SocketAddr) -> Result<(), ServerConfigError> {
        self.keys(address).map(drop)
    }

    /// The keys of the tokens, where a server on `address` demands them. Datagrams bear none, so then it must be said where they
    /// may come from.
    pub(crate) fn keys(&self, address: SocketAddr) -> Result<Option<Keys>, ServerConfigError> {
        let access = &self.access;
        let keys = token::demand(access.token_key.as_deref(), access.insecure, address.ip().is_loopback())?;
        let is_open = |port: &&ListenSpec| port.allow.is_empty() && !port.address.ip().is_loopback();
        match self.listen_udp.iter().find(is_open) {
            Some(port) if keys.is_some() && !access.insecure => {
                Err(ServerConfigError::OpenPort { protocol: port.protocol_name(), address: port.address })
            }
            _ => Ok(keys),
        }
    }

    /// Checks every value.
    pub fn validate(&self) -> Result<(), ServerConfigError> {
        let limits = &self.limits;
        for (field, got, most) in [
            ("limits.rooms", limits.rooms, 1_000_000),
            ("limits.viewers_per_room", limits.viewers_per_room, 1_000_000),
            ("limits.frames_per_second", limits.frames_per_second as usize, 1_000_000),
            ("limits.bad_frames_in_a_row", limits.bad_frames_in_a_row as usize, 1_000_000),
            ("limits.connections", limits.connections, 1_000_000),
            ("limits.connections_per_address", limits.connections_per_address, 1_000_000),
            ("limits.connections_per_second", limits.connections_per_second as usize, 1_000_000),
            ("limits.frames_per_second_per_address", limits.frames_per_second_per_address as usize, 1_000_000),
            ("limits.requests_per_second_per_address", limits.requests_per_second_per_address as usize, 1_000_000),
        ] {
            if got == 0 || got > most {
                return Err(ServerConfigError::Range { field, got: got.to_string(), expected: "1 to 1000000" });
            }
        }
        if !(1024..=16 << 20).contains(&limits.message_bytes) {
            return Err(ServerConfigError::Range {
                field: "limits.message_bytes",
                got: limits.message_bytes.to_string(),
                expected: "1024 to 16777216",
            });
        }
        let record = &self.record;
        if !(1..=4096).contains(&record.recordings) {
            let got = record.recordings.to_string();
            return Err(ServerConfigError::Range { field: "record.recordings", got, expected: "1 to 4096" });
        }
        if !(1 << 20..=1 << 44).contains(&record.file_bytes) {
            let got = record.file_bytes.to_string();
            return Err(ServerConfigError::Range { field: "record.file_bytes", got, expected: "1048576 to 17592186044416" });
        }
        if let Some(dir) = record.dir.as_ref().filter(|dir| !dir.is_dir()) {
            let got = dir.display().to_string();
            return Err(ServerConfigError::Range { field: "record.dir", got, expected: "a folder that exists" });
        }
        for (field, got) in [("listen_udp", self.listen_udp.len()), ("vmc_out", self.vmc_out.len())] {
            // Each is a socket and a task.
            if got > MOST_PORTS {
                return Err(ServerConfigError::Range { field, got: format!("a list of {got}"), expected: "at most 64" });
            }
        }
        let timeouts = &self.timeouts;
        for (field, got) in [
            ("timeouts.hello", timeouts.hello),
            ("timeouts.ping", timeouts.ping),
            ("timeouts.publisher_idle", timeouts.publisher_idle),
            ("timeouts.viewer_idle", timeouts.viewer_idle),
            ("timeouts.write", timeouts.write),
            ("timeouts.room_idle", timeouts.room_idle),
            ("timeouts.replay_idle", timeouts.replay_idle),
        ] {
            if !(0.01..=86_400.0).contains(&got) {
                return Err(ServerConfigError::Range { field, got: got.to_string(), expected: "0.01 to 86400 seconds" });
            }
        }
        crate::tls::validate(&self.tls)?;
        Ok(self.solve.validate()?)
    }
}

/// A time-out from the configuration, where it has been checked.
pub(crate) fn seconds(value: f64) -> Duration {
    Duration::from_secs_f64(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_names_only_what_it_changes() {
        let config: ServerConfig =
            toml::from_str("listen = \"0.0.0.0:80\"\n[limits]\nrooms = 3\n[timeouts]\nhello = 0.5\n[access]\nhosts = [\"a.example\"]")
                .unwrap();
        assert_eq!((config.limits.rooms, config.limits.viewers_per_room, config.timeouts.hello), (3, 4096, 0.5));
        assert_eq!((config.listen.as_str(), config.access.hosts.len()), ("0.0.0.0:80", 1));
        config.validate().unwrap();
    }

    #[test]
    fn wrong_settings_are_named() {
        let says = |text: &str| match toml::from_str::<ServerConfig>(text) {
            Ok(config) => config.validate().unwrap_err().to_string(),
            Err(error) => error.to_string(),
        };
        assert!(says("[limits]\nroms = 3").contains("unknown field `roms`"), "{}", says("[limits]\nroms = 3"));
        assert!(says("[limits]\nrooms = 0").contains("limits.rooms is 0, expected 1 to"));
        assert!(says("[limits]\nmessage_bytes = 3").contains("limits.message_bytes is 3"));
        assert!(says("listen_udp = [\"kinect=127.0.0.1:1\"]").contains("protocol is \"kinect\""));
        assert!(says("[timeouts]\nping = -1.0").contains("timeouts.ping is -1"));
        assert!(says("[timeouts]\nping = nan").contains("timeouts.ping is NaN"));
        let missing = ServerConfig::from_file(Path::new("no/such.toml")).unwrap_err().to_string();
        assert!(missing.contains("no/such.toml"), "{missing}");
    }
}
