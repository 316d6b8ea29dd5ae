//! Frame packets: the binary form in which a solved frame travels to viewers. Signatures; the codec follows.

use crate::character::Character;
use crate::face::FaceFrame;
use crate::view::CharacterHello;
use glam::Vec3;

/// What kind of packet it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketKind {
    /// Stands by itself.
    Key,
    /// Differences against the last key packet.
    Delta,
}

/// What both ends must know of a character to read its packets.
#[derive(Debug, Clone, PartialEq)]
pub struct PacketLayout {
    /// `n` evaluated points at rest.
    pub rest: Vec<Vec3>,
}

impl From<&Character> for PacketLayout {
    fn from(_character: &Character) -> Self {
        unimplemented!()
    }
}

impl TryFrom<&CharacterHello> for PacketLayout {
    type Error = PacketError;
    fn try_from(_hello: &CharacterHello) -> Result<Self, PacketError> {
        unimplemented!()
    }
}

impl PacketLayout {
    /// The character at rest, in buffers of the right size for [`Decoder::decode`].
    pub fn frame_at_rest(&self) -> FaceFrame {
        unimplemented!()
    }
}

/// Why a packet could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PacketError {
    /// Too short, or another version.
    #[error("not a frame packet of version 1")]
    Version,
    /// A delta whose key packet is not the one held; wait for the next key packet.
    #[error("delta refers to key packet {wanted} of session {session}, which was not received")]
    NoKey {
        /// Session of the packet.
        session: u32,
        /// Sequence number of the key packet it needs.
        wanted: u32,
    },
    /// The bytes make no packet.
    #[error("packet is broken: {0}")]
    Broken(&'static str),
}

/// Turns solved frames into packets. Owns when to send a key packet.
#[derive(Debug, Clone)]
pub struct Encoder {}

impl Encoder {
    /// `PacketLayout` or `&Character`.
    pub fn new(_layout: impl Into<PacketLayout>) -> Self {
        unimplemented!()
    }

    /// Writes one packet into `out` (cleared first).
    pub fn encode(&mut self, _frame: &FaceFrame, _out: &mut Vec<u8>) -> PacketKind {
        unimplemented!()
    }
}

/// Reads packets. Holds the last key packet; never panics and never allocates after construction, whatever the bytes.
#[derive(Debug, Clone)]
pub struct Decoder {}

impl Decoder {
    /// `PacketLayout` or `&Character`.
    pub fn new(_layout: impl Into<PacketLayout>) -> Self {
        unimplemented!()
    }

    /// Reads `packet` into `frame`, which keeps its old value where an error is returned.
    pub fn decode(&mut self, _packet: &[u8], _frame: &mut FaceFrame) -> Result<PacketKind, PacketError> {
        unimplemented!()
    }
}
