//! The client's end of a WebSocket, no more of it than the measuring needs: heads of frames are read, payloads are skipped.
//! A whole implementation would cost the generator as much as the server, and its delay would count as the server's.

/// Bytes of a binary payload that are looked at: the head of a packet.
const PACKET_HEAD: usize = 16;
/// Bytes of a text or a close that are looked at: enough for an error.
const TEXT_HEAD: usize = 512;

pub(super) const TEXT: u8 = 1;
pub(super) const BINARY: u8 = 2;
pub(super) const CLOSE: u8 = 8;
pub(super) const PING: u8 = 9;
pub(super) const PONG: u8 = 10;

/// One frame from the server.
pub(super) struct Frame<'a> {
    pub opcode: u8,
    /// The payload's first bytes.
    pub head: &'a [u8],
    /// Bytes of the whole payload.
    pub len: usize,
}

/// Cuts a stream into frames.
#[derive(Default)]
pub(super) struct FrameReader {
    /// The beginning of a frame whose head has not come whole.
    carry: Vec<u8>,
    /// Bytes of a payload still to come that nobody wants.
    skip: usize,
}

impl FrameReader {
    /// Gives `each` the frames that `bytes` complete, as far as they are looked at.
    pub fn read(&mut self, bytes: &[u8], mut each: impl FnMut(Frame<'_>)) {
        if self.carry.is_empty() {
            let rest = self.cut(bytes, &mut each);
            self.carry.extend_from_slice(rest);
        } else {
            let mut all = std::mem::take(&mut self.carry);
            all.extend_from_slice(bytes);
            let num_rest = self.cut(&all, &mut each).len();
            all.drain(..all.len() - num_rest);
            self.carry = all;
        }
    }

    /// What is left of `bytes` is the beginning of a frame.
    fn cut<'a>(&mut self, mut bytes: &'a [u8], each: &mut impl FnMut(Frame<'_>)) -> &'a [u8] {
        loop {
            let num_skipped = self.skip.min(bytes.len());
            bytes = &bytes[num_skipped..];
            self.skip -= num_skipped;
            let Some((opcode, len, num_head)) = frame_head(bytes) else { return bytes };
            let payload = &bytes[num_head..];
            let wanted = len.min(match opcode {
                BINARY => PACKET_HEAD,
                _ => TEXT_HEAD,
            });
            if payload.len() < wanted {
                return bytes;
            }
            each(Frame { opcode, head: &payload[..wanted], len });
            self.skip = len - wanted;
            bytes = &payload[wanted..];
        }
    }
}

/// Opcode, bytes of payload, bytes of head of an unmasked frame (RFC 6455, 5.2).
fn frame_head(bytes: &[u8]) -> Option<(u8, usize, usize)> {
    let opcode = bytes.first()? & 0x0F;
    Some(match bytes.get(1)? & 0x7F {
        126 => (opcode, u16::from_be_bytes(bytes.get(2..4)?.try_into().ok()?) as usize, 4),
        127 => (opcode, usize::try_from(u64::from_be_bytes(bytes.get(2..10)?.try_into().ok()?)).ok()?, 10),
        len => (opcode, len as usize, 2),
    })
}

/// Appends a client's frame: masked, as the protocol wants it, with zeros, which leave the payload as it is.
pub(super) fn put_frame(opcode: u8, payload: &[&[u8]], out: &mut Vec<u8>) {
    let len: usize = payload.iter().map(|part| part.len()).sum();
    out.push(0x80 | opcode);
    match len {
        0..=125 => out.push(0x80 | len as u8),
        126..=0xFFFF => {
            out.push(0x80 | 126);
            out.extend((len as u16).to_be_bytes());
        }
        _ => {
            out.push(0x80 | 127);
            out.extend((len as u64).to_be_bytes());
        }
    }
    out.extend([0; 4]);
    for part in payload {
        out.extend_from_slice(part);
    }
}

/// Number of the frame in its session, from the head of a packet.
pub(super) fn packet_seq(head: &[u8]) -> Option<usize> {
    let mut bytes = head.get(1..)?.iter();
    let mut varint = || {
        let mut value = 0usize;
        for shift in (0..35).step_by(7) {
            let byte = *bytes.next()?;
            value |= usize::from(byte & 0x7F) << shift;
            if byte & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    };
    let _session = varint()?;
    varint()
}

/// The head of a packet as far as [`packet_seq`] reads it.
pub(super) fn put_packet_head(seq: usize, out: &mut Vec<u8>) {
    out.extend([0x10, 1]);
    let mut value = seq;
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::framed::put_server_frame;

    #[test]
    fn frames_are_found_however_the_stream_is_cut() {
        let mut packet = Vec::new();
        put_packet_head(300, &mut packet);
        packet.extend([9; 90]);
        let mut stream = Vec::new();
        put_server_frame(TEXT, &[b'x'; 70_000], &mut stream);
        put_server_frame(PING, b"hi", &mut stream);
        for _ in 0..3 {
            put_server_frame(BINARY, &packet, &mut stream);
        }
        for step in [1, 2, 3, 7, 100, 5000, 100_000] {
            let mut reader = FrameReader::default();
            let mut seen = Vec::new();
            for part in stream.chunks(step) {
                reader.read(part, |frame| seen.push((frame.opcode, frame.len, packet_seq(frame.head).filter(|_| frame.opcode == BINARY))));
            }
            let packet = (BINARY, 94, Some(300));
            assert_eq!(seen, [(TEXT, 70_000, None), (PING, 2, None), packet, packet, packet], "in steps of {step}");
            assert!(reader.carry.is_empty() && reader.skip == 0);
        }
    }

    #[test]
    fn head_is_the_encoders() {
        use rhytid_shared::packet::Encoder;
        use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, FaceFrame};
        let character = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
        let (mut encoder, mut face, mut packet) = (Encoder::new(&character), FaceFrame::at_rest(&character), Vec::new());
        for seq in [0, 1, 127, 128, 20_000] {
            (face.session, face.seq, face.captured_at_micros) = (1, seq, u64::from(seq) * 16_667);
            encoder.encode(&face, &mut packet);
            assert_eq!(packet_seq(&packet), Some(seq as usize));
        }
    }
}
