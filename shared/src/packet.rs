//! Frame packets: the binary form in which solved frames travel to viewers.
//!
//! [`PacketKind`] says what the bytes are. What both ends can work out for themselves is not sent: the points of bones that
//! turn follow from their rotation, coefficients of poses that do not move a bone are 0, members of a group share theirs.

mod batch;
mod codes;
mod kriging;
mod layout;
mod quantise;
mod range_coder;
#[cfg(test)]
mod tests;

use crate::face::FaceFrame;
pub use batch::{BatchError, BatchReader, BatchWriter, MAX_BATCH};
use codes::{Codes, Models};
pub use layout::PacketLayout;
use range_coder::{Reader, Writer};

/// What kind of packet it is. The low three bits of a packet's first byte are flags, the high nibble is the version.
///
/// ```text
/// byte 0         0x10 | delta? 1 | face? 2 | expression weights? 4
/// key     varint session     counts the room's publishers, from 1
///         varint seq         counts the session's frames, from 0
///         varint captured    sender's clock, µs
///         varint interval    µs a frame, as the encoder saw it last; 0 where it saw none
/// delta   varint session
///         varint seq
///         varint distance    seq minus the key packet's, at least 1
///         varint lateness    zigzag: captured - (key's captured + distance * key's interval), µs
/// then the body, range-coded (`range_coder`), as differences: a key's from rest, a delta's from its key packet:
///         3 numbers a bone that does not turn by itself: displacement from rest, steps of 25 µm, within ±2047,
///           less what the bones before it and the slope of the face let expect (`kriging`)
///         1 rotation a bone that turns by itself: bit "another component is left out"; if so 2 bits which;
///           3 numbers, the components left (12 bits mid-tread over ±1/√2)
///         1 number a coefficient slot, 0 to 255, pose by pose: groups in their order, then bones in theirs,
///           each only where the pose moves the bone or a member; less the projection of the bones just read
///         1 number a wrinkle zone, 0 to 255; below 0, to -255, how far it is stretched
///         52 numbers of expression weights, 0 to 255, in ARKit's order, only with flag 4
///         the head: 1 rotation, 3 numbers of position, 16 bits over ±0.3 m
/// ```
/// A varint is little-endian base 128. A number is its bit length in unary under adaptive models, the bits below its first,
/// and its sign. Zero bytes at the end are left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketKind {
    /// Stands by itself.
    Key,
    /// Differences against the last key packet.
    Delta,
}

impl PacketKind {
    /// What `packet` says of itself in its first byte, where that is a packet's.
    pub fn of(packet: &[u8]) -> Option<Self> {
        let first = packet.first().filter(|first| *first & VERSION_MASK == VERSION && *first & FLAGS_UNUSED == 0)?;
        Some(if first & FLAG_DELTA == 0 { Self::Key } else { Self::Delta })
    }
}

/// The version nibble of byte 0.
const VERSION: u8 = 0x10;
const VERSION_MASK: u8 = 0xF0;
const FLAG_DELTA: u8 = 1;
const FLAG_FACE: u8 = 2;
const FLAG_SHAPES: u8 = 4;
/// Flags of later versions; a packet that has one is refused.
const FLAGS_UNUSED: u8 = 8;

/// A key packet stands in the stream at least this often, µs of the sender's clock: what a recording can be entered at.
const KEY_INTERVAL_MICROS: u64 = 2_000_000;

/// Why a packet could not be read, or a hello gave no layout for them.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PacketError {
    /// Another version, or no packet at all.
    #[error("first byte is {got:#04x}, expected a frame packet of version 1 (0x10 to 0x17)")]
    Version {
        /// The first byte; 0 for an empty packet.
        got: u8,
    },
    /// A delta whose key packet is not the one held; wait for the next key packet.
    #[error("packet {seq} of session {session} needs key packet {wanted}, which is not the one held")]
    NoKey {
        /// Session of the packet.
        session: u32,
        /// Sequence number of the packet.
        seq: u32,
        /// Sequence number of the key packet it needs.
        wanted: u32,
    },
    /// The bytes make no packet.
    #[error("packet is broken: {0}")]
    Broken(&'static str),
    /// A viewer's hello that gives no layout.
    #[error("character in the hello: {0}")]
    Hello(&'static str),
}

/// The key packet that deltas refer to.
#[derive(Debug, Clone)]
struct Key {
    session: u32,
    seq: u32,
    captured_at_micros: u64,
    interval_micros: u64,
    codes: Codes,
}

/// Turns solved frames into packets and decides which are key packets. The same frames give the same bytes.
#[derive(Debug, Clone)]
pub struct Encoder {
    layout: PacketLayout,
    rest: Codes,
    codes: Codes,
    key: Option<Key>,
    /// Length of the last key packet, bytes.
    key_length: usize,
    /// The shortest delta since then, and how many bytes more all others took together.
    shortest_delta: usize,
    excess: usize,
    /// Capture time of the frame before, for the interval.
    last_captured: Option<u64>,
}

impl Encoder {
    /// `layout` is a [`PacketLayout`] or a `&Character`.
    pub fn new(layout: impl Into<PacketLayout>) -> Self {
        let layout = layout.into();
        let rest = Codes::at_rest(&layout);
        Self { codes: rest.clone(), rest, layout, key: None, key_length: 0, shortest_delta: usize::MAX, excess: 0, last_captured: None }
    }

    /// Writes `frame` into `out`, which is emptied first. Panics where the frame's arrays are not of the character's lengths.
    pub fn encode(&mut self, frame: &FaceFrame, out: &mut Vec<u8>) -> PacketKind {
        self.codes.quantise(frame, &self.layout);
        let kind = if self.encode_delta(frame, out) {
            PacketKind::Delta
        } else {
            self.encode_key(frame, out);
            PacketKind::Key
        };
        self.last_captured = Some(frame.captured_at_micros);
        kind
    }

    /// Writes a delta packet, unless a key packet is due or better.
    fn encode_delta(&mut self, frame: &FaceFrame, out: &mut Vec<u8>) -> bool {
        let Some(key) = &self.key else { return false };
        let since_key = frame.captured_at_micros.checked_sub(key.captured_at_micros);
        let is_in_reach =
            key.session == frame.session && frame.seq > key.seq && since_key.is_some_and(|micros| micros < KEY_INTERVAL_MICROS);
        if !is_in_reach {
            return false;
        }
        write_delta(&Head::of(frame), key, &mut self.codes, &self.layout, out);
        // Deltas grow as the face moves away from its key packet. Once they have cost as much more as a new key packet costs,
        // that is sent ("rent or buy": never more than twice what the best choice in hindsight costs).
        let length = out.len();
        self.shortest_delta = self.shortest_delta.min(length);
        self.excess += length - self.shortest_delta;
        self.excess + length < self.key_length.max(self.shortest_delta + 1)
    }

    fn encode_key(&mut self, frame: &FaceFrame, out: &mut Vec<u8>) {
        let is_new = self.key.as_ref().is_none_or(|key| key.session != frame.session);
        let interval_micros = match self.last_captured {
            Some(last) if !is_new => frame.captured_at_micros.saturating_sub(last),
            _ => 0,
        };
        write_key(&Head::of(frame), interval_micros, &mut self.codes, &self.rest, &self.layout, out);
        self.key_length = out.len();
        (self.shortest_delta, self.excess) = (usize::MAX, 0);
        let codes = match self.key.take() {
            Some(key) => key.codes,
            None => self.rest.clone(),
        };
        let key = self.key.insert(Key {
            session: frame.session,
            seq: frame.seq,
            captured_at_micros: frame.captured_at_micros,
            interval_micros,
            codes,
        });
        key.codes.copy_from(&self.codes);
    }
}

/// What stands before a packet's body, besides what refers to its key packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Head {
    session: u32,
    seq: u32,
    captured_at_micros: u64,
}

impl Head {
    fn of(frame: &FaceFrame) -> Self {
        Self { session: frame.session, seq: frame.seq, captured_at_micros: frame.captured_at_micros }
    }
}

/// Writes the delta packet of `codes` into `out`, which is emptied first. `key` is of the same session and before it.
fn write_delta(head: &Head, key: &Key, codes: &mut Codes, layout: &PacketLayout, out: &mut Vec<u8>) {
    let distance = head.seq - key.seq;
    let expected = key.captured_at_micros.wrapping_add(key.interval_micros.wrapping_mul(u64::from(distance)));
    let lateness = head.captured_at_micros.wrapping_sub(expected) as i64;
    begin(FLAG_DELTA, codes, out);
    put_varint(u64::from(head.session), out);
    put_varint(u64::from(head.seq), out);
    put_varint(u64::from(distance), out);
    put_varint(((lateness << 1) ^ (lateness >> 63)) as u64, out);
    write_body(codes, &key.codes, Models::for_delta(), layout, out);
}

/// Writes the key packet of `codes` into `out`, which is emptied first.
fn write_key(head: &Head, interval_micros: u64, codes: &mut Codes, rest: &Codes, layout: &PacketLayout, out: &mut Vec<u8>) {
    begin(0, codes, out);
    put_varint(u64::from(head.session), out);
    put_varint(u64::from(head.seq), out);
    put_varint(head.captured_at_micros, out);
    put_varint(interval_micros, out);
    write_body(codes, rest, Models::for_key(), layout, out);
}

fn begin(kind: u8, codes: &Codes, out: &mut Vec<u8>) {
    out.clear();
    let face = if codes.face { FLAG_FACE } else { 0 };
    let shapes = if codes.has_shapes { FLAG_SHAPES } else { 0 };
    out.push(VERSION | kind | face | shapes);
}

/// Writing changes nothing in `codes`: one code serves both directions.
fn write_body(codes: &mut Codes, base: &Codes, mut models: Models, layout: &PacketLayout, out: &mut Vec<u8>) {
    let mut writer = Writer::new(out);
    codes.transfer(base, &mut models, layout, &mut writer).expect("quantised codes are in their range");
    writer.finish();
}

/// Reads packets. Holds the last key packet; never panics, and allocates nothing after its first frame, whatever the bytes.
#[derive(Debug, Clone)]
pub struct Decoder {
    layout: PacketLayout,
    rest: Codes,
    codes: Codes,
    key: Option<Key>,
}

impl Decoder {
    /// `layout` is a [`PacketLayout`] or a `&Character`.
    pub fn new(layout: impl Into<PacketLayout>) -> Self {
        let layout = layout.into();
        let rest = Codes::at_rest(&layout);
        Self { codes: rest.clone(), rest, layout, key: None }
    }

    /// What the decoder knows of the character.
    pub fn layout(&self) -> &PacketLayout {
        &self.layout
    }

    /// Reads `packet` into `frame`, whose buffers are brought to the right lengths. After an error `frame` and the key packet
    /// held are as they were.
    pub fn decode(&mut self, packet: &[u8], frame: &mut FaceFrame) -> Result<PacketKind, PacketError> {
        let (&first, mut rest) = packet.split_first().ok_or(PacketError::Version { got: 0 })?;
        if first & VERSION_MASK != VERSION || first & FLAGS_UNUSED != 0 {
            return Err(PacketError::Version { got: first });
        }
        self.codes.face = first & FLAG_FACE != 0;
        self.codes.has_shapes = first & FLAG_SHAPES != 0;
        let session = take_u32(&mut rest)?;
        let seq = take_u32(&mut rest)?;
        let (kind, captured_at_micros);
        if first & FLAG_DELTA == 0 {
            kind = PacketKind::Key;
            captured_at_micros = take_varint(&mut rest)?;
            let interval_micros = take_varint(&mut rest)?;
            read_body(&mut self.codes, &self.rest, Models::for_key(), &self.layout, rest)?;
            let codes = match self.key.take() {
                Some(key) => key.codes,
                None => self.rest.clone(),
            };
            let key = self.key.insert(Key { session, seq, captured_at_micros, interval_micros, codes });
            key.codes.copy_from(&self.codes);
        } else {
            kind = PacketKind::Delta;
            let distance = take_u32(&mut rest)?;
            let lateness = take_varint(&mut rest)?;
            let lateness = (lateness >> 1) as i64 ^ -((lateness & 1) as i64);
            let wanted = seq
                .checked_sub(distance)
                .filter(|_| distance > 0)
                .ok_or(PacketError::Broken("its distance to the key packet makes no sense"))?;
            let key = self.key.as_ref().filter(|key| key.session == session && key.seq == wanted).ok_or(PacketError::NoKey {
                session,
                seq,
                wanted,
            })?;
            let expected = key.captured_at_micros.wrapping_add(key.interval_micros.wrapping_mul(u64::from(distance)));
            captured_at_micros = expected.wrapping_add(lateness as u64);
            read_body(&mut self.codes, &key.codes, Models::for_delta(), &self.layout, rest)?;
        }
        frame.session = session;
        frame.seq = seq;
        frame.captured_at_micros = captured_at_micros;
        self.codes.restore(frame, &self.layout);
        Ok(kind)
    }
}

fn read_body(codes: &mut Codes, base: &Codes, mut models: Models, layout: &PacketLayout, body: &[u8]) -> Result<(), PacketError> {
    let mut reader = Reader::new(body);
    codes.transfer(base, &mut models, layout, &mut reader)?;
    if reader.is_at_end() { Ok(()) } else { Err(PacketError::Broken("bytes are left over")) }
}

fn put_varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn take_varint(bytes: &mut &[u8]) -> Result<u64, PacketError> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let (&byte, rest) = bytes.split_first().ok_or(PacketError::Broken("it ends inside its head"))?;
        *bytes = rest;
        let part = u64::from(byte & 0x7F);
        if part << shift >> shift != part {
            break;
        }
        value |= part << shift;
        if byte & 0x80 == 0 {
            return Ok(value);
        }
    }
    Err(PacketError::Broken("a varint is longer than 64 bits"))
}

fn take_u32(bytes: &mut &[u8]) -> Result<u32, PacketError> {
    u32::try_from(take_varint(bytes)?).map_err(|_| PacketError::Broken("session, seq or distance is over 32 bits"))
}
