//! The fields by which recordings are read from MCAP's records, whose bytes are anybody's. The `mcap` crate's own parser (0.26) takes
//! the length of a string from the file and reserves as much before it looks whether that is there, 4 GiB for a record of 40 bytes,
//! and panics at an attachment that is cut; both were found by fuzzing.

use super::reader::ChunkPlace;
use mcap::records::op;

/// A record, as far as it matters.
#[derive(Debug, PartialEq)]
pub(super) enum Record<'a> {
    Channel {
        id: u16,
        topic: &'a str,
    },
    /// Times on the Unix clock, ns.
    Message {
        channel: u16,
        log_time: u64,
        publish_time: u64,
        data: &'a [u8],
    },
    Chunk {
        compression: &'a str,
    },
    ChunkIndex(ChunkPlace),
    /// Of a kind that says nothing here.
    Other,
}

/// A record that has less than its kind must have.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("a record of {bytes} bytes (kind {opcode}) is cut or damaged")]
pub(super) struct Cut {
    opcode: u8,
    bytes: usize,
}

impl<'a> Record<'a> {
    /// Reads the record of kind `opcode` whose bytes behind the head are `body`.
    pub(super) fn parse(opcode: u8, body: &'a [u8]) -> Result<Self, Cut> {
        let mut fields = Fields(body);
        let record = match opcode {
            op::CHANNEL => fields.channel(),
            op::MESSAGE => fields.message(),
            op::CHUNK => fields.chunk(),
            op::CHUNK_INDEX => fields.chunk_index(),
            _ => Some(Self::Other),
        };
        record.ok_or(Cut { opcode, bytes: body.len() })
    }
}

/// What has not been read of a record. Numbers are little endian.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (bytes, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*bytes)
    }

    fn u16(&mut self) -> Option<u16> {
        self.bytes().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.bytes().map(u64::from_le_bytes)
    }

    /// A length and as many bytes of text.
    fn text(&mut self) -> Option<&'a str> {
        let length = self.u32()?;
        let (text, rest) = self.0.split_at_checked(length.try_into().ok()?)?;
        self.0 = rest;
        std::str::from_utf8(text).ok()
    }

    /// Number, schema, topic; what messages are written in and notes follow.
    fn channel(&mut self) -> Option<Record<'a>> {
        let (id, _schema) = (self.u16()?, self.u16()?);
        Some(Record::Channel { id, topic: self.text()? })
    }

    /// Channel, number in its sequence, two times, the rest.
    fn message(&mut self) -> Option<Record<'a>> {
        let (channel, _sequence) = (self.u16()?, self.u32()?);
        let [log_time, publish_time] = [self.u64()?, self.u64()?];
        Some(Record::Message { channel, log_time, publish_time, data: self.0 })
    }

    /// Two times, bytes when decompressed and their checksum, compression; records follow.
    fn chunk(&mut self) -> Option<Record<'a>> {
        let _ = (self.u64()?, self.u64()?, self.u64()?, self.u32()?);
        Some(Record::Chunk { compression: self.text()? })
    }

    /// Two times and where it stands; what is in it follows.
    fn chunk_index(&mut self) -> Option<Record<'a>> {
        let [start, end, offset, length] = [self.u64()?, self.u64()?, self.u64()?, self.u64()?];
        Some(Record::ChunkIndex(ChunkPlace { offset, length, start, end }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_is_read_as_it_was_written_and_no_beginning_of_it_is() {
        let channel = [&[7, 0, 1, 0, 5, 0, 0, 0][..], b"/chat", &[0; 8]].concat();
        let message = [&[7, 0, 9, 0, 0, 0][..], &3u64.to_le_bytes(), &4u64.to_le_bytes(), b"data"].concat();
        let chunk = [&[0; 28][..], &[4, 0, 0, 0], b"zstd", &[0; 8]].concat();
        let index: Vec<u8> = [5u64, 6, 7, 8].iter().flat_map(|number| number.to_le_bytes()).collect();
        let place = ChunkPlace { start: 5, end: 6, offset: 7, length: 8 };
        let message_read = Record::Message { channel: 7, log_time: 3, publish_time: 4, data: b"data" };
        let expected = [
            (op::CHANNEL, channel, 13, Record::Channel { id: 7, topic: "/chat" }),
            (op::MESSAGE, message, 22, message_read),
            (op::CHUNK, chunk, 36, Record::Chunk { compression: "zstd" }),
            (op::CHUNK_INDEX, index, 32, Record::ChunkIndex(place)),
        ];
        for (opcode, bytes, least, record) in expected {
            assert_eq!(Record::parse(opcode, &bytes), Ok(record));
            assert!((least..bytes.len()).all(|length| Record::parse(opcode, &bytes[..length]).is_ok()));
            assert!((0..least).all(|length| Record::parse(opcode, &bytes[..length]) == Err(Cut { opcode, bytes: length })));
        }
        assert_eq!(Record::parse(op::ATTACHMENT, &[0; 32]), Ok(Record::Other));
    }

    #[test]
    fn a_length_beyond_the_record_is_refused() {
        for length in [4, 5, u32::MAX] {
            let channel = [&[7, 0, 1, 0][..], &length.to_le_bytes(), b"abc"].concat();
            assert!(Record::parse(op::CHANNEL, &channel).is_err());
        }
        let no_text = [&[7, 0, 1, 0, 2, 0, 0, 0][..], &[0xff, 0xfe]].concat();
        assert!(Record::parse(op::CHANNEL, &no_text).is_err());
    }
}
