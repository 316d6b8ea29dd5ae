//! An adaptive binary range coder. Every packet starts from the same state, so each can be read by itself.
//!
//! The coder narrows a 32-bit interval bit by bit ("range coding", Martin 1979, in its carry-propagating byte form);
//! the model of a bit is a probability that learns fast at first and slower later.

/// Probabilities are in 1/4096.
const PROBABILITY_BITS: u32 = 12;
const HALF: u16 = 1 << (PROBABILITY_BITS - 1);
/// The interval is kept above this by moving bytes out.
const SMALLEST_RANGE: u32 = 1 << 24;
/// The slowest a model learns: by 1/2^5 of its error a bit.
const SLOWEST: u8 = 5;

/// What is expected of one kind of bit.
#[derive(Debug, Clone, Copy)]
pub(super) struct Model {
    /// Probability of a 0, in 1/4096, never 0 or 1.
    zero: u16,
    /// The next step is 1/2^rate of the error.
    rate: u8,
}

impl Model {
    /// A model that expects a 0 with `zero` / 256, `1..=255`.
    pub const fn expecting(zero: u8) -> Self {
        Self { zero: (zero as u16) << (PROBABILITY_BITS - 8), rate: 2 }
    }

    fn learn(&mut self, bit: bool) {
        // Both bounds keep the probability inside 1..4095 for ever: the step is a fraction of the way to the end.
        if bit {
            self.zero -= (self.zero - 1) >> self.rate;
        } else {
            self.zero += ((1 << PROBABILITY_BITS) - 1 - self.zero) >> self.rate;
        }
        self.rate = (self.rate + 1).min(SLOWEST);
    }
}

/// Writes or reads bits by their models: the same code describes a packet in both directions.
pub(super) trait Coder {
    /// Writes `bit`, or reads one and returns it.
    fn bit(&mut self, bit: bool, model: &mut Model) -> bool;
    /// The same for a bit that is as likely 0 as 1.
    fn even_bit(&mut self, bit: bool) -> bool;
}

/// Writes into a packet.
pub(super) struct Writer<'a> {
    out: &'a mut Vec<u8>,
    /// Length of the packet's head, which stays as it is.
    head: usize,
    low: u32,
    range: u32,
}

impl<'a> Writer<'a> {
    pub fn new(out: &'a mut Vec<u8>) -> Self {
        Self { head: out.len(), out, low: 0, range: u32::MAX }
    }

    fn narrow(&mut self, bit: bool, zero: u32) {
        if bit {
            let (low, overflows) = self.low.overflowing_add(zero);
            self.low = low;
            self.range -= zero;
            if overflows {
                carry(self.out, self.head);
            }
        } else {
            self.range = zero;
        }
        while self.range < SMALLEST_RANGE {
            self.out.push((self.low >> 24) as u8);
            self.low <<= 8;
            self.range <<= 8;
        }
    }

    /// Ends the packet. The reader takes what is missing as zeros, so one byte is enough, and zeros at the end fall away.
    pub fn finish(self) {
        let (low, overflows) = self.low.overflowing_add(SMALLEST_RANGE - 1);
        if overflows {
            carry(self.out, self.head);
        }
        self.out.push((low >> 24) as u8);
        while self.out.len() > self.head && self.out.last() == Some(&0) {
            self.out.pop();
        }
    }
}

/// Adds one to the number that the bytes behind the head make.
fn carry(out: &mut [u8], head: usize) {
    for byte in out[head..].iter_mut().rev() {
        *byte = byte.wrapping_add(1);
        if *byte != 0 {
            return;
        }
    }
}

impl Coder for Writer<'_> {
    fn bit(&mut self, bit: bool, model: &mut Model) -> bool {
        self.narrow(bit, (self.range >> PROBABILITY_BITS) * u32::from(model.zero));
        model.learn(bit);
        bit
    }

    fn even_bit(&mut self, bit: bool) -> bool {
        self.narrow(bit, (self.range >> PROBABILITY_BITS) * u32::from(HALF));
        bit
    }
}

/// Reads from a packet.
pub(super) struct Reader<'a> {
    bytes: std::slice::Iter<'a, u8>,
    code: u32,
    range: u32,
}

impl<'a> Reader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut reader = Self { bytes: bytes.iter(), code: 0, range: u32::MAX };
        for _ in 0..4 {
            reader.code = (reader.code << 8) | reader.next_byte();
        }
        reader
    }

    /// True where every byte was needed.
    pub fn is_at_end(&self) -> bool {
        self.bytes.as_slice().is_empty()
    }

    fn next_byte(&mut self) -> u32 {
        self.bytes.next().copied().map_or(0, u32::from)
    }

    fn narrow(&mut self, zero: u32) -> bool {
        let bit = self.code >= zero;
        if bit {
            self.code -= zero;
            self.range -= zero;
        } else {
            self.range = zero;
        }
        while self.range < SMALLEST_RANGE {
            self.code = (self.code << 8) | self.next_byte();
            self.range <<= 8;
        }
        bit
    }
}

impl Coder for Reader<'_> {
    fn bit(&mut self, _: bool, model: &mut Model) -> bool {
        let bit = self.narrow((self.range >> PROBABILITY_BITS) * u32::from(model.zero));
        model.learn(bit);
        bit
    }

    fn even_bit(&mut self, _: bool) -> bool {
        self.narrow((self.range >> PROBABILITY_BITS) * u32::from(HALF))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bits of a small generator; `one_in` of them are 1.
    fn bits(count: usize, one_in: u32) -> Vec<bool> {
        let mut state = 12345u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 16).is_multiple_of(one_in)
        };
        (0..count).map(|_| next()).collect()
    }

    #[test]
    fn bits_come_back_and_rare_ones_are_cheap() {
        for (count, one_in, most_bytes) in [(0, 2, 0), (1, 2, 1), (4000, 2, 540), (4000, 50, 90), (4000, 4000, 20)] {
            let bits = bits(count, one_in);
            let mut out = vec![0xFF, 0xFF];
            let mut writer = Writer::new(&mut out);
            let mut model = Model::expecting(128);
            for (i, bit) in bits.iter().enumerate() {
                if i % 7 == 3 {
                    writer.even_bit(i % 2 == 0);
                }
                writer.bit(*bit, &mut model);
            }
            writer.finish();
            let even = count / 7 / 8 + 1;
            assert!(out.len() <= 2 + most_bytes + even, "{count} bits, one in {one_in}: {} bytes", out.len());
            assert_eq!(out[..2], [0xFF, 0xFF], "the head stays as it is");
            let mut reader = Reader::new(&out[2..]);
            let mut model = Model::expecting(128);
            for (i, bit) in bits.iter().enumerate() {
                if i % 7 == 3 {
                    assert_eq!(reader.even_bit(false), i % 2 == 0);
                }
                assert_eq!(reader.bit(false, &mut model), *bit, "bit {i} of {count}");
            }
            assert!(reader.is_at_end());
        }
    }
}
