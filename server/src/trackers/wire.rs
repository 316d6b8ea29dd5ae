//! Reading a datagram's fields one after the other.

use super::Refusal;

/// The rest of a datagram.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wire<'a>(pub &'a [u8]);

impl<'a> Wire<'a> {
    /// The next `count` bytes.
    pub fn bytes(&mut self, count: usize) -> Result<&'a [u8], Refusal> {
        let (taken, rest) = self.0.split_at_checked(count).ok_or(Refusal::Truncated)?;
        self.0 = rest;
        Ok(taken)
    }

    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], Refusal> {
        let (taken, rest) = self.0.split_first_chunk::<N>().ok_or(Refusal::Truncated)?;
        self.0 = rest;
        Ok(*taken)
    }

    pub fn u8(&mut self) -> Result<u8, Refusal> {
        Ok(self.array::<1>()?[0])
    }

    pub fn i32_be(&mut self) -> Result<i32, Refusal> {
        self.array().map(i32::from_be_bytes)
    }

    pub fn f32_be(&mut self) -> Result<f32, Refusal> {
        finite(f32::from_be_bytes(self.array()?))
    }

    pub fn f32_le(&mut self) -> Result<f32, Refusal> {
        finite(f32::from_le_bytes(self.array()?))
    }

    pub fn u16_le(&mut self) -> Result<u16, Refusal> {
        self.array().map(u16::from_le_bytes)
    }

    pub fn u32_le(&mut self) -> Result<u32, Refusal> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn u64_le(&mut self) -> Result<u64, Refusal> {
        self.array().map(u64::from_le_bytes)
    }

    /// Nothing may follow.
    pub fn end(self) -> Result<(), Refusal> {
        if self.0.is_empty() { Ok(()) } else { Err(Refusal::WrongLength) }
    }
}

pub(super) fn finite(value: f32) -> Result<f32, Refusal> {
    if value.is_finite() { Ok(value) } else { Err(Refusal::NotFinite) }
}
