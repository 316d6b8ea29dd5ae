//! What stands in a recording.
//!
//! An MCAP file (profile `rhytid`) of zstd chunks, each closed at least once a second, with these channels:
//!
//! ```text
//! /session            JSON, one `SessionEvent` a message: the recording's first message, and whatever the server put in
//! /publish/SLOT       a publisher's messages that the server took, verbatim: JSON text (hello, frames, calibrate, settings, …)
//! /publish/SLOT/bin   the same for binary messages
//! /control/SLOT       commands to a publisher's solve that others gave and that were taken, verbatim: JSON text
//! /refused/SLOT       messages that the server refused, verbatim, text or not: they moved nothing
//! /packets            the packets that went out, in batches (`rhytid_shared::packet::BatchWriter`), each up to a second
//! ```
//! A message's `log_time` is when it reached the server (Unix clock, ns, never going back within a file; of a batch, its first
//! packet's), its `publish_time` the sender's `t` in ns where it has one. Messages of all channels stand in the order in which
//! the server took them, which is that in which a room's sources were merged, save that a batch of packets follows the messages
//! they were made of.

use crate::solve::{Calibration, SolveConfig};
use rhytid_shared::Profile;
use rhytid_shared::view::CharacterHello;
use serde::{Deserialize, Serialize};

/// What the MCAP header says the file is.
pub const PROFILE: &str = "rhytid";
/// Version of everything here; another one is refused.
pub const VERSION: u32 = 1;
/// Most bytes of a chunk, compressed or not: the writer's 1 MiB and the largest message a server may be told to take.
pub(super) const MAX_CHUNK: usize = 32 << 20;

/// A channel of a recording.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// `/session`.
    Session,
    /// `/packets`.
    Packets,
    /// `/publish/SLOT`, text.
    Text(String),
    /// `/publish/SLOT/bin`.
    Binary(String),
    /// `/control/SLOT`.
    Control(String),
    /// `/refused/SLOT`.
    Refused(String),
}

impl Topic {
    /// The name in the file.
    pub fn name(&self) -> String {
        match self {
            Self::Session => "/session".into(),
            Self::Packets => "/packets".into(),
            Self::Text(slot) => format!("/publish/{slot}"),
            Self::Binary(slot) => format!("/publish/{slot}/bin"),
            Self::Control(slot) => format!("/control/{slot}"),
            Self::Refused(slot) => format!("/refused/{slot}"),
        }
    }

    /// The topic of a name; nothing for channels that others have added.
    pub fn parse(name: &str) -> Option<Self> {
        match name {
            "/session" => return Some(Self::Session),
            "/packets" => return Some(Self::Packets),
            _ => {}
        }
        if let Some(slot) = name.strip_prefix("/refused/") {
            return Some(Self::Refused(slot.into()));
        }
        if let Some(slot) = name.strip_prefix("/control/") {
            return Some(Self::Control(slot.into()));
        }
        let slot = name.strip_prefix("/publish/")?;
        Some(match slot.strip_suffix("/bin") {
            Some(slot) => Self::Binary(slot.into()),
            None => Self::Text(slot.into()),
        })
    }

    /// MCAP's message encoding.
    pub(super) fn encoding(&self) -> &'static str {
        match self {
            Self::Session | Self::Text(_) | Self::Control(_) => "json",
            Self::Packets => "rhytid.packets.v1",
            Self::Binary(_) => "rhytid.publish.v1",
            Self::Refused(_) => "application/octet-stream",
        }
    }
}

/// A message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Its channel.
    pub topic: Topic,
    /// When it reached the server, Unix clock, ns.
    pub log_time: u64,
    /// The sender's `t`, ns; 0 where it has none.
    pub publish_time: u64,
    /// The message as it came, or as the topic says.
    pub data: Vec<u8>,
}

/// What the server says in a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum SessionEvent {
    /// The first message of a file.
    Recording {
        /// [`VERSION`].
        version: u32,
        /// The room.
        room: String,
        /// Version of the program that wrote it.
        server: String,
        /// The character, as viewers learn it: all that is needed to read packets. Its `url` counts for nothing here.
        character: Box<CharacterHello>,
        /// Of `log_time`, what is 0 on the clock by which the room merges its sources, ns; 0 in a viewer's recording.
        #[serde(default)]
        clock: u64,
    },
    /// A publisher has claimed its slot. Its hello follows as its first message.
    Start {
        /// Number of the session in its room, as packets carry it.
        session: u32,
        /// The publisher's slot.
        slot: String,
        /// What it calls itself.
        source: String,
        /// True where it cannot be solved again: it had begun before the recording, or it plays a recording itself.
        under_way: bool,
        /// The neutral face that the session began with, where the room had kept one.
        kept_neutral: Option<Box<Calibration>>,
        /// The profile of the performer that the session began with, whoever named it.
        profile: Option<Box<Profile>>,
        /// The server's settings of the solve; nothing where it cannot be solved again.
        solve: Option<Box<SolveConfig>>,
    },
    /// The profile that the next message names.
    Profile {
        /// The session's number.
        session: u32,
        /// The profile.
        profile: Box<Profile>,
    },
    /// A session has come to a neutral face.
    Neutral {
        /// Its number.
        session: u32,
        /// The neutral.
        calibration: Box<Calibration>,
    },
    /// The publisher is gone.
    End {
        /// Its number.
        session: u32,
        /// Frames it gave.
        frames: u64,
    },
    /// The disk was too slow, or who records as a viewer was without a connection: messages are missing here. Sessions
    /// that were running cannot be solved again from here on.
    Gap {
        /// How many; 0 where nobody knows.
        messages: u64,
    },
    /// The recording was ended.
    Stop {
        /// Why.
        reason: String,
    },
    /// An event of a later version.
    #[serde(other)]
    Unknown,
}
