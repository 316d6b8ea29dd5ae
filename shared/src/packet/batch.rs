//! Packets in bulk, for keeping: the same packets to the byte in about half of it.
//!
//! A packet on its way is made to be read after any loss, so it is a difference from its key packet, and its models start from
//! nothing. Kept packets are read in order: each is the difference from the one before it, with models that go on learning.
//! What a packet says besides its codes (its kind, its number, its time) is kept, too, and the packet is written anew from both.
//! Each is compared with the original where it is kept; one that would not come back the same is kept as it is.

use super::codes::{Codes, Models, Numbers};
use super::range_coder::{Coder, Model, Reader, Writer};
use super::{Decoder, Head, PacketError, PacketKind, PacketLayout, put_varint, take_varint, write_delta, write_key};
use crate::face::FaceFrame;

/// Most packets in a batch: four seconds of the fastest publisher that a server takes by default.
pub const MAX_BATCH: usize = 4096;
/// Longest packet kept, bytes: many times what 64 bones and 8 poses can take.
const MAX_PACKET: usize = u16::MAX as usize;

/// The version nibble of byte 0, and what else stands in it.
const VERSION: u8 = 0x20;
const FLAG_ANEW: u8 = 1;

/// Why packets could not be kept, or a batch not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BatchError {
    /// Too many packets, or too long a one.
    #[error("a batch holds up to {MAX_BATCH} packets of up to {MAX_PACKET} bytes")]
    TooLarge,
    /// Another version, or no batch at all.
    #[error("first byte is {got:#04x}, expected a batch of packets of version 1 (0x20 or 0x21)")]
    Version {
        /// The first byte; 0 for an empty batch.
        got: u8,
    },
    /// The batch goes on from one that was not read; read from one that starts anew.
    #[error("batch {got} goes on from batch {}, the one before it here is {}", got.wrapping_sub(1), before.map_or("none".to_owned(), |before| before.to_string()))]
    Gap {
        /// Number of the batch.
        got: u32,
        /// Number of the one read last.
        before: Option<u32>,
    },
    /// The bytes make no batch.
    #[error("batch of packets is broken: {0}")]
    Broken(&'static str),
}

impl From<PacketError> for BatchError {
    fn from(error: PacketError) -> Self {
        Self::Broken(match error {
            PacketError::Broken(problem) => problem,
            PacketError::NoKey { .. } => "a packet's key packet is not the one before it",
            PacketError::Version { .. } | PacketError::Hello(_) => "a packet is of another version",
        })
    }
}

/// What both ends know after each packet.
#[derive(Debug, Clone)]
struct State {
    decoder: Decoder,
    /// The codes of the packet read last.
    previous: Codes,
    head: Head,
    /// µs from the packet before to the last one, by the sender's clock and by arrival.
    interval: u64,
    arrived: u64,
    arrival_interval: u64,
    scratch: FaceFrame,
}

impl State {
    fn new(layout: PacketLayout) -> Self {
        let decoder = Decoder::new(layout);
        Self {
            previous: decoder.rest.clone(),
            scratch: decoder.layout.frame_at_rest(),
            head: Head { session: 0, seq: u32::MAX, captured_at_micros: 0 },
            interval: 0,
            arrived: 0,
            arrival_interval: 0,
            decoder,
        }
    }

    /// Forgets everything.
    fn reset(&mut self) {
        self.decoder.key = None;
        self.previous.copy_from(&self.decoder.rest);
        self.head = Head { session: 0, seq: u32::MAX, captured_at_micros: 0 };
        (self.interval, self.arrived, self.arrival_interval) = (0, 0, 0);
    }

    /// Reads `packet` into the decoder's codes; what kind it is, unless it cannot be read.
    fn decode(&mut self, packet: &[u8]) -> Option<(PacketKind, Head)> {
        let kind = self.decoder.decode(packet, &mut self.scratch).ok()?;
        Some((kind, Head::of(&self.scratch)))
    }

    /// Takes the codes just decoded as those of the packet before the next.
    fn go_on(&mut self, head: Head) {
        self.previous.copy_from(&self.decoder.codes);
        self.interval = head.captured_at_micros.wrapping_sub(self.head.captured_at_micros);
        self.head = head;
    }

    /// Writes the packet of `codes` into `out`; false where its key packet is not the one held.
    fn write(&mut self, kind: PacketKind, head: &Head, interval: u64, codes: &mut Codes, out: &mut Vec<u8>) -> bool {
        let Decoder { layout, rest, key, .. } = &self.decoder;
        match kind {
            PacketKind::Key => write_key(head, interval, codes, rest, layout, out),
            PacketKind::Delta => {
                let Some(key) = key.as_ref().filter(|key| key.session == head.session && key.seq < head.seq) else { return false };
                write_delta(head, key, codes, layout, out);
            }
        }
        true
    }

    /// Writes or reads when the packet arrived.
    fn transfer_arrival(&mut self, arrived: u64, models: &mut BatchModels, coder: &mut impl Coder) -> u64 {
        let expected = self.arrived.wrapping_add(self.arrival_interval);
        let arrived = expected.wrapping_add(models.arrival.transfer(arrived.wrapping_sub(expected) as i64, coder) as u64);
        self.arrival_interval = arrived.wrapping_sub(self.arrived);
        self.arrived = arrived;
        arrived
    }
}

/// What is expected of a packet's own fields, besides its codes.
struct BatchModels {
    codes: Models,
    is_verbatim: Model,
    is_key: Model,
    has_face: Model,
    has_shapes: Model,
    is_next: Model,
    arrival: Wide,
    captured: Wide,
    interval: Wide,
}

impl BatchModels {
    fn new() -> Self {
        Self {
            codes: Models::for_batch(),
            is_verbatim: Model::expecting(254),
            is_key: Model::expecting(230),
            has_face: Model::expecting(10),
            has_shapes: Model::expecting(128),
            is_next: Model::expecting(2),
            arrival: Wide::expecting(8),
            captured: Wide::expecting(4),
            interval: Wide::expecting(0),
        }
    }

    /// Writes or reads all but the codes of a packet after `state`: its kind, its head, and µs a frame where it is a key.
    fn transfer(
        &mut self,
        state: &State,
        (kind, head, interval): (PacketKind, Head, u64),
        codes: &mut Codes,
        coder: &mut impl Coder,
    ) -> (PacketKind, Head, u64) {
        let kind = if coder.bit(kind == PacketKind::Key, &mut self.is_key) { PacketKind::Key } else { PacketKind::Delta };
        codes.face = coder.bit(codes.face, &mut self.has_face);
        codes.has_shapes = coder.bit(codes.has_shapes, &mut self.has_shapes);
        let next = (state.head.session, state.head.seq.wrapping_add(1));
        let (session, seq) = if coder.bit((head.session, head.seq) == next, &mut self.is_next) {
            next
        } else {
            (even_bits(u64::from(head.session), 32, coder) as u32, even_bits(u64::from(head.seq), 32, coder) as u32)
        };
        let expected = state.head.captured_at_micros.wrapping_add(state.interval);
        let late = self.captured.transfer(head.captured_at_micros.wrapping_sub(expected) as i64, coder);
        let captured_at_micros = expected.wrapping_add(late as u64);
        let mut written_interval = 0;
        if kind == PacketKind::Key {
            let expected = captured_at_micros.wrapping_sub(state.head.captured_at_micros);
            written_interval = expected.wrapping_add(self.interval.transfer(interval.wrapping_sub(expected) as i64, coder) as u64);
        }
        (kind, Head { session, seq, captured_at_micros }, written_interval)
    }
}

/// Whole numbers that are mostly small and may be anything.
struct Wide {
    is_large: Model,
    numbers: Numbers,
}

impl Wide {
    /// Numbers of about `length` bits.
    fn expecting(length: i32) -> Self {
        Self { is_large: Model::expecting(240), numbers: Numbers::expecting(length) }
    }

    fn transfer(&mut self, value: i64, coder: &mut impl Coder) -> i64 {
        if coder.bit(value.unsigned_abs() >= 1 << 16, &mut self.is_large) {
            even_bits(value as u64, 64, coder) as i64
        } else {
            i64::from(self.numbers.transfer(value as i32, coder))
        }
    }
}

fn even_bits(value: u64, num: u32, coder: &mut impl Coder) -> u64 {
    (0..num).rev().fold(0, |read, at| read << 1 | u64::from(coder.even_bit(value >> at & 1 != 0)))
}

/// Keeps packets in batches.
///
/// ```text
/// byte 0   0x20 | starts anew? 1
/// varint   number of the batch, from 0
/// varint   packets
/// then, range-coded with models that last over the batch, for each packet:
///          bit "as it is"; if so 16 bits of length and its bytes
///          else bits key? face? expression weights? "number follows the one before"; if not 32 bits of session and of seq;
///          captured, µs, less what the two before let expect; of a key also its µs a frame, less what the one before tells;
///          its codes as in a packet's body, less those of the packet before (of rest at the start)
///          arrival, µs, less what the two before let expect
/// ```
/// A batch that starts anew needs no other; each other one needs those before it up to one that does. A difference in time is a bit
/// "large" and 64 bits, or a number as in a packet's body.
#[derive(Debug, Clone)]
pub struct BatchWriter {
    state: State,
    num_batches: u32,
    packet: Vec<u8>,
}

impl BatchWriter {
    /// `layout` is a [`PacketLayout`] or a `&Character`.
    pub fn new(layout: impl Into<PacketLayout>) -> Self {
        Self { state: State::new(layout.into()), num_batches: 0, packet: Vec::new() }
    }

    /// Writes `packets`, each with the time of its arrival in µs, into `out`, which is emptied first. The batch starts anew where its
    /// first packet is a key packet: a writer that wants such batches cuts there.
    pub fn pack<'a>(&mut self, packets: impl ExactSizeIterator<Item = (u64, &'a [u8])>, out: &mut Vec<u8>) -> Result<(), BatchError> {
        if packets.len() > MAX_BATCH {
            return Err(BatchError::TooLarge);
        }
        let mut packets = packets.peekable();
        let is_key = packets.peek().is_some_and(|(_, packet)| PacketKind::of(packet) == Some(PacketKind::Key));
        let starts_anew = is_key || self.num_batches == 0;
        if starts_anew {
            self.state.reset();
        }
        out.clear();
        out.push(VERSION | if starts_anew { FLAG_ANEW } else { 0 });
        put_varint(u64::from(self.num_batches), out);
        put_varint(packets.len() as u64, out);
        self.num_batches = self.num_batches.wrapping_add(1);
        let mut coder = Writer::new(out);
        let mut models = BatchModels::new();
        for (arrived, packet) in packets {
            if packet.len() > MAX_PACKET {
                return Err(BatchError::TooLarge);
            }
            self.put(packet, &mut models, &mut coder);
            self.state.transfer_arrival(arrived, &mut models, &mut coder);
        }
        coder.finish();
        Ok(())
    }

    fn put(&mut self, packet: &[u8], models: &mut BatchModels, coder: &mut Writer<'_>) {
        let state = &mut self.state;
        let decoded = state.decode(packet);
        let mut codes = state.decoder.codes.clone();
        let same = decoded.and_then(|(kind, head)| {
            let interval = state.decoder.key.as_ref().map_or(0, |key| key.interval_micros);
            let is_same = state.write(kind, &head, interval, &mut codes, &mut self.packet) && self.packet == packet;
            is_same.then_some((kind, head, interval))
        });
        coder.bit(same.is_none(), &mut models.is_verbatim);
        match same {
            Some(said) => {
                models.transfer(state, said, &mut codes, coder);
                codes.transfer(&state.previous, &mut models.codes, &state.decoder.layout, coder).expect("decoded codes are in their range");
            }
            None => {
                even_bits(packet.len() as u64, 16, coder);
                for byte in packet {
                    even_bits(u64::from(*byte), 8, coder);
                }
            }
        }
        if let Some((_, head)) = decoded {
            state.go_on(head);
        }
    }
}

/// Reads batches. Never panics and never allocates more than a batch's packets, whatever the bytes.
#[derive(Debug, Clone)]
pub struct BatchReader {
    state: State,
    before: Option<u32>,
    packet: Vec<u8>,
}

impl BatchReader {
    /// `layout` is a [`PacketLayout`] or a `&Character`.
    pub fn new(layout: impl Into<PacketLayout>) -> Self {
        Self { state: State::new(layout.into()), before: None, packet: Vec::new() }
    }

    /// True where `batch` can be read without those before it.
    pub fn starts_anew(batch: &[u8]) -> bool {
        batch.first() == Some(&(VERSION | FLAG_ANEW))
    }

    /// Gives every packet of `batch`, with the time of its arrival in µs, in order. After an error only a batch that starts anew can be
    /// read.
    pub fn unpack(&mut self, batch: &[u8], mut each: impl FnMut(u64, &[u8])) -> Result<(), BatchError> {
        let (&first, mut rest) = batch.split_first().ok_or(BatchError::Version { got: 0 })?;
        if first & !FLAG_ANEW != VERSION {
            return Err(BatchError::Version { got: first });
        }
        let number = u32::try_from(take_varint(&mut rest)?).map_err(|_| BatchError::Broken("its number is over 32 bits"))?;
        let num_packets = usize::try_from(take_varint(&mut rest)?).ok().filter(|num| *num <= MAX_BATCH).ok_or(BatchError::TooLarge)?;
        let before = self.before.take();
        if first & FLAG_ANEW != 0 {
            self.state.reset();
        } else if before.is_none_or(|before| before.wrapping_add(1) != number) {
            return Err(BatchError::Gap { got: number, before });
        }
        let mut coder = Reader::new(rest);
        let mut models = BatchModels::new();
        for _ in 0..num_packets {
            self.get(&mut models, &mut coder)?;
            let arrived = self.state.transfer_arrival(0, &mut models, &mut coder);
            each(arrived, &self.packet);
        }
        if !coder.is_at_end() {
            return Err(BatchError::Broken("bytes are left over"));
        }
        self.before = Some(number);
        Ok(())
    }

    /// Reads one packet into `self.packet`.
    fn get(&mut self, models: &mut BatchModels, coder: &mut Reader<'_>) -> Result<(), BatchError> {
        let state = &mut self.state;
        if coder.bit(false, &mut models.is_verbatim) {
            let length = even_bits(0, 16, coder) as usize;
            self.packet.clear();
            self.packet.extend((0..length).map(|_| even_bits(0, 8, coder) as u8));
        } else {
            let nothing = (PacketKind::Delta, Head { session: 0, seq: 0, captured_at_micros: 0 }, 0);
            let mut codes = state.previous.clone();
            let (kind, head, interval) = models.transfer(state, nothing, &mut codes, coder);
            codes.transfer(&state.previous, &mut models.codes, &state.decoder.layout, coder)?;
            if !state.write(kind, &head, interval, &mut codes, &mut self.packet) {
                return Err(BatchError::Broken("a packet's key packet is not the one before it"));
            }
        }
        if let Some((_, head)) = state.decode(&self.packet) {
            state.go_on(head);
        }
        Ok(())
    }
}
