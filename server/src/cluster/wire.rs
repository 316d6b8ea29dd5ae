//! What travels between nodes: a room's state packets, and small JSON questions and answers.

use crate::room::RoomListing;
use rhytid_shared::{Calibration, Profile, Resume};
use serde::{Deserialize, Serialize};
use tokio_tungstenite::tungstenite::Bytes;

/// Where a state stands in its room: later ones have a greater `(epoch, index)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct StateHead {
    /// Of the lease under which it was sent: greater in every later one.
    pub epoch: u64,
    /// Counts the states of the room at its home.
    pub index: u64,
    /// Index of the key packet that a delta needs; the state's own where it is one.
    pub key_index: u64,
}

impl StateHead {
    /// Bytes before the packet.
    pub const LENGTH: usize = 24;

    /// The message of a packet: three u64, little endian, and the packet as viewers get it.
    pub fn message(self, packet: &[u8]) -> Bytes {
        let mut bytes = Vec::with_capacity(Self::LENGTH + packet.len());
        for number in [self.epoch, self.index, self.key_index] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(packet);
        bytes.into()
    }

    /// Takes a message apart; `None` where it is none.
    pub fn read(message: &Bytes) -> Option<(Self, Bytes)> {
        let number = |at: usize| Some(u64::from_le_bytes(message.get(at..at + 8)?.try_into().ok()?));
        let head = Self { epoch: number(0)?, index: number(8)?, key_index: number(16)? };
        (message.len() > Self::LENGTH).then(|| (head, message.slice(Self::LENGTH..)))
    }
}

/// Several messages in one, for who comes late: the key packet and the newest delta.
pub(crate) fn join(messages: &[Bytes]) -> Bytes {
    let mut bytes = Vec::new();
    for message in messages {
        bytes.extend_from_slice(&(message.len() as u32).to_le_bytes());
        bytes.extend_from_slice(message);
    }
    bytes.into()
}

/// Takes [`join`]ed messages apart, as many as are whole.
pub(crate) fn split(mut bytes: Bytes) -> Vec<Bytes> {
    let mut messages = Vec::new();
    while let Some(length) = bytes.get(..4).and_then(|four| four.try_into().ok()).map(u32::from_le_bytes) {
        let end = 4 + length as usize;
        if bytes.len() < end {
            break;
        }
        messages.push(bytes.slice(4..end));
        bytes = bytes.slice(end..);
    }
    messages
}

/// Whose a room is: its lease.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) struct Lease {
    /// The home's id; empty where nobody publishes.
    pub node: String,
    /// Where the home is reached by publishers.
    pub address: String,
    /// Greater with every home.
    pub epoch: u64,
    /// No session of the room has a greater number, at any node.
    pub sessions: u32,
}

impl Lease {
    /// Reads a record; `None` where no node has written it: no clock tells of so late an epoch, and there would be none behind it.
    pub fn read(text: &[u8]) -> Option<Self> {
        serde_json::from_slice(text).ok().filter(|lease: &Self| lease.epoch <= LAST_EPOCH)
    }

    /// The epoch of the next home, where its clock tells `now` in milliseconds since 1970.
    pub fn next_epoch(&self, now: u64) -> u64 {
        now.max(self.epoch.saturating_add(1)).min(LAST_EPOCH)
    }
}

/// Milliseconds since 1970, and some 36 million years later.
const LAST_EPOCH: u64 = 1 << 60;

/// Asks a room's home to let it go.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct EnterQuestion {
    /// The room.
    pub room: String,
    /// A publisher wants to have it, whoever has it now.
    pub takeover: bool,
    /// A publisher wants to have back what it had in this session.
    pub resume: Option<u32>,
    /// With this key, which that session was told.
    pub resume_key: Option<String>,
}

impl EnterQuestion {
    /// What a publisher wants to have back.
    pub fn resume(&self) -> Option<Resume> {
        Some(Resume { session: self.resume?, key: self.resume_key.clone() })
    }
}

/// What a home says to that.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct EnterAnswer {
    /// It is no longer the home.
    pub is_granted: bool,
    /// Slots that are, or were, taken.
    pub slots: Vec<String>,
}

/// A performer's neutral face, settings and ranges, as a room keeps them for one who comes back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Kept {
    /// The tracker that they belong to.
    pub tracker: String,
    /// Its neutral face.
    pub calibration: Calibration,
    /// Settings and ranges.
    pub profile: Option<Profile>,
}

/// What a node tells of itself every half second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct NodeListing {
    /// Its id.
    pub node: String,
    /// Where it is reached.
    pub address: String,
    /// Which part of its list this is, from 0, and of how many.
    pub part: usize,
    pub of: usize,
    /// It has more rooms than its list: any of them may be watched there.
    #[serde(default)]
    pub is_partial: bool,
    /// Its rooms, at most [`LISTED_AT_ONCE`].
    pub rooms: Vec<RoomListing>,
}

/// The head of a [`NodeListing`]: whose it is.
#[derive(Deserialize)]
pub(crate) struct ListingHead {
    /// Its id.
    pub node: String,
}

impl NodeListing {
    /// A node may have written it: nobody else's list is held.
    pub fn is_sound(&self) -> bool {
        self.node.len() <= MOST_NODE_BYTES && self.address.len() <= MOST_ADDRESS_BYTES && self.rooms.len() <= LISTED_AT_ONCE
    }
}

/// Longest id of a node; nodes give themselves 16 characters.
const MOST_NODE_BYTES: usize = 64;
/// Longest address of a node, as of a URL that browsers take.
const MOST_ADDRESS_BYTES: usize = 2048;
/// Rooms that a node tells of.
pub(crate) const MOST_LISTED: usize = 1000;
/// Rooms in one message: NATS takes a megabyte, and a room of eight sources with long names is about 3 KB.
pub(crate) const LISTED_AT_ONCE: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn lease_of_no_clock_is_not_read() {
        let text = |epoch: u64| format!(r#"{{"node":"a","address":"b","epoch":{epoch},"sessions":1}}"#).into_bytes();
        assert_eq!(Lease::read(&text(7)).unwrap().next_epoch(5), 8);
        assert_eq!(Lease::read(&text(7)).unwrap().next_epoch(9), 9);
        assert_eq!((Lease::read(&text(LAST_EPOCH + 1)), Lease::read(&text(u64::MAX)), Lease::read(b"junk")), (None, None, None));
        let last = Lease::read(&text(LAST_EPOCH)).unwrap();
        assert_eq!(last.next_epoch(5), LAST_EPOCH, "which others can still read");
    }

    #[test]
    fn listing_longer_than_nodes_write_is_not_sound() {
        let room = r#"{"name":"a","viewers":0,"session":0,"publisher":null,"sources":[],"frame":null,"neutral":null,"recording":null}"#;
        let listing = |node: &str, num_rooms: usize| NodeListing {
            node: node.into(),
            address: String::new(),
            part: 0,
            of: 1,
            is_partial: false,
            rooms: vec![serde_json::from_str(room).unwrap(); num_rooms],
        };
        assert!(listing("a", LISTED_AT_ONCE).is_sound());
        assert!(!listing("a", LISTED_AT_ONCE + 1).is_sound());
        assert!(!listing(&"a".repeat(65), 1).is_sound());
    }

    proptest! {
        #[test]
        fn what_is_sent_is_read(epoch: u64, index: u64, key_index: u64, packet in proptest::collection::vec(any::<u8>(), 1..200)) {
            let head = StateHead { epoch, index, key_index };
            let message = head.message(&packet);
            prop_assert_eq!(StateHead::read(&message), Some((head, Bytes::from(packet))));
            prop_assert_eq!(split(join(&[message.clone(), message.clone()])), vec![message.clone(), message]);
        }

        #[test]
        fn anything_can_be_read(bytes in proptest::collection::vec(any::<u8>(), 0..100)) {
            let bytes = Bytes::from(bytes);
            let _ = StateHead::read(&bytes);
            let _ = split(bytes);
        }
    }
}
