//! Reading a recording. The bytes are anybody's: every length is checked against the file before anything is held, a chunk has at
//! most [`MAX_CHUNK`] bytes in either form, and what is broken is one error that says where.

use super::format::{Entry, MAX_CHUNK, PROFILE, SessionEvent, Topic, VERSION};
use super::record::Record;
use mcap::MAGIC;
use mcap::records::op;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use rhytid_shared::packet::{BatchError, BatchReader, PacketError, PacketLayout};
use rhytid_shared::view::CharacterHello;
use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Cursor, Read, Seek, SeekFrom};
use std::path::Path;

/// A record's opcode and length.
const RECORD_HEAD: u64 = 9;
/// A finished file's last record, and what ends the file behind it.
const FOOTER: u64 = RECORD_HEAD + 20 + MAGIC.len() as u64;
/// Bytes that are read of an index at a time.
const INDEX_PART: usize = 64 << 10;
/// Longest record outside chunks that is looked at, bytes: an index of a chunk has less than 100 and 16 a message.
const MAX_RECORD: usize = 16 << 20;
/// Most chunks: some three months, and 100 MB of their index.
const MAX_CHUNKS: usize = 10_000_000;
/// Chunks that a batch of packets may go back to before its recording is called broken: a key packet stands in the stream every two
/// seconds of the sender's time, which may run four times as fast as the server's.
const MAX_BACK: usize = 64;

/// Why a recording could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The file could not be opened or read.
    #[error("cannot read recording {path}: {source}")]
    Io {
        /// The file as it was named.
        path: String,
        /// What the system said.
        source: io::Error,
    },
    /// The file is no recording, or broken.
    #[error("recording {path}: {problem}")]
    Broken {
        /// The file as it was named.
        path: String,
        /// What is wrong with it.
        problem: String,
    },
}

/// Where a chunk stands, and from when to when its messages reached the server, Unix clock, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChunkPlace {
    /// Offset of its record in the file.
    pub offset: u64,
    /// Length of its record, bytes.
    pub length: u64,
    /// Earliest `log_time`.
    pub start: u64,
    /// Latest `log_time`.
    pub end: u64,
}

/// What a recording is read from.
pub(super) trait Bytes: Read + Seek + Send {}

impl<T: Read + Seek + Send> Bytes for T {}

/// An open recording.
pub struct Recording {
    source: Source,
    chunks: Vec<ChunkPlace>,
    /// So many of the first chunks have been looked through for channels: those stand where they were first used, and only a finished
    /// file lists them at its end as well.
    num_known: usize,
    room: String,
    server: String,
    character: CharacterHello,
    layout: PacketLayout,
    clock: u64,
    /// Where whole chunks end, if the file was not finished.
    cut_at: Option<u64>,
}

impl Recording {
    /// Opens a file and reads its index; of a file that was not finished, what stands in it whole.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::open_as(path, path.display().to_string())
    }

    /// The same of a file that is called `shown` in errors.
    pub(super) fn open_as(path: &Path, shown: String) -> Result<Self, ReadError> {
        let io = |source| ReadError::Io { path: shown.clone(), source };
        let file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        Self::read(Box::new(file), length, shown)
    }

    /// The same of a file's bytes, which are called `name` in errors.
    pub fn from_bytes(bytes: Vec<u8>, name: String) -> Result<Self, ReadError> {
        let length = bytes.len() as u64;
        Self::read(Box::new(Cursor::new(bytes)), length, name)
    }

    fn read(mut file: Box<dyn Bytes>, length: u64, path: String) -> Result<Self, ReadError> {
        let shown = path.clone();
        let io = |source| ReadError::Io { path: shown.clone(), source };
        let broken = |problem: String| ReadError::Broken { path: shown.clone(), problem };
        let mut magic = [0; MAGIC.len()];
        if length < MAGIC.len() as u64 || file.read_exact(&mut magic).is_err() || magic != *MAGIC {
            return Err(broken("it is no MCAP file".into()));
        }
        let (mut chunks, channels, cut_at) = match read_index(&mut *file, length) {
            Some(index) => (index.chunks, index.channels, None),
            None => {
                let (chunks, end) = scan(&mut *file, length).map_err(io)?;
                (chunks, HashMap::new(), Some(end))
            }
        };
        if chunks.len() > MAX_CHUNKS {
            return Err(broken(format!("it has {} chunks, expected up to {MAX_CHUNKS}", chunks.len())));
        }
        chunks.sort_by_key(|chunk: &ChunkPlace| chunk.offset);
        let mut source = Source { file, path, length, channels };
        let first = match chunks.first() {
            Some(chunk) => source.read(chunk).map_err(Unread::into_error)?.into_iter().next(),
            None => None,
        };
        let first = first.filter(|first| first.topic == Topic::Session);
        let first = first.ok_or_else(|| broken(format!("its first message is none of a {PROFILE} recording")))?;
        match serde_json::from_slice(&first.data) {
            Ok(SessionEvent::Recording { version: VERSION, room, server, character, clock }) => {
                let layout = PacketLayout::try_from(&*character).map_err(|error: PacketError| broken(error.to_string()))?;
                let num_known = if cut_at.is_some() { 1 } else { chunks.len() };
                Ok(Self { source, chunks, num_known, room, server, character: *character, layout, clock, cut_at })
            }
            Ok(SessionEvent::Recording { version, .. }) => Err(broken(format!("it is of version {version}, expected {VERSION}"))),
            Ok(_) => Err(broken("its first message says nothing about it".into())),
            Err(error) => Err(broken(format!("its first message: {error}"))),
        }
    }

    /// The file as it was named.
    pub fn path(&self) -> &str {
        &self.source.path
    }

    /// The room.
    pub fn room(&self) -> &str {
        &self.room
    }

    /// Version of the program that wrote it.
    pub fn server(&self) -> &str {
        &self.server
    }

    /// The character that the packets move.
    pub fn character(&self) -> &CharacterHello {
        &self.character
    }

    /// What is needed to read packets.
    pub fn layout(&self) -> &PacketLayout {
        &self.layout
    }

    /// The room's clock at `log_time`, ns: by which its sources were merged.
    pub(super) fn room_nanos(&self, log_time: u64) -> u64 {
        log_time.saturating_sub(self.clock)
    }

    /// Chunks in their order.
    pub fn chunks(&self) -> &[ChunkPlace] {
        &self.chunks
    }

    /// Length of the file when it was opened, bytes.
    pub(super) fn num_bytes(&self) -> u64 {
        self.source.length
    }

    /// Bytes that make no whole chunk at the end of a file that was not finished; nothing for one that was.
    pub fn cut_off(&self) -> Option<u64> {
        self.cut_at.map(|end| self.source.length - end)
    }

    /// When it begins, Unix clock, ns.
    pub fn start(&self) -> u64 {
        self.chunks.iter().map(|chunk| chunk.start).min().unwrap_or(0)
    }

    /// How long it is, seconds.
    pub fn seconds(&self) -> f64 {
        let end = self.chunks.iter().map(|chunk| chunk.end).max().unwrap_or(0);
        end.saturating_sub(self.start()) as f64 / 1e9
    }

    /// The messages of chunk `index`, in their order.
    pub fn read_chunk(&mut self, index: usize) -> Result<Vec<Entry>, ReadError> {
        let chunk = self.chunks[index];
        let read = self.source.read(&chunk);
        if index == self.num_known {
            self.num_known += 1;
        }
        match read {
            Err(Unread::Channel(_)) if self.num_known < index => {
                // Said in a chunk between, which nobody has read yet. Those that are damaged say so when they are read.
                for chunk in &self.chunks[self.num_known..index] {
                    drop(self.source.read(chunk));
                }
                self.num_known = index;
                self.read_chunk(index)
            }
            read => read.map_err(Unread::into_error),
        }
    }

    /// Index of the first chunk from which packets can be read so that the first of those at `from` (Unix clock, ns) or later are
    /// among them.
    pub fn chunk_before(&mut self, from: u64) -> Result<usize, ReadError> {
        // A batch is of the time of its first packet and stands behind its messages.
        let mut index = self.chunks.partition_point(|chunk| chunk.end < from).min(self.chunks.len().saturating_sub(1));
        for _ in 0..MAX_BACK {
            let is_enough =
                |entry: &Entry| entry.topic == Topic::Packets && BatchReader::starts_anew(&entry.data) && entry.log_time <= from;
            if index == 0 || self.read_chunk(index)?.iter().any(is_enough) {
                return Ok(index);
            }
            index -= 1;
        }
        Ok(index)
    }

    /// An error about this file.
    pub fn broken(&self, problem: impl Into<String>) -> ReadError {
        ReadError::Broken { path: self.source.path.clone(), problem: problem.into() }
    }

    /// An error about a batch of packets that reached the server at `log_time`.
    pub fn broken_batch(&self, log_time: u64, error: &BatchError) -> ReadError {
        self.broken(format!("packets at {:.3} s: {error}", log_time.saturating_sub(self.start()) as f64 / 1e9))
    }
}

/// A file, and what its channels are.
struct Source {
    file: Box<dyn Bytes>,
    path: String,
    length: u64,
    /// By id; nothing for channels that are not ours.
    channels: HashMap<u16, Option<Topic>>,
}

/// Why a chunk could not be read.
enum Unread {
    /// It has messages of a channel that has not been seen.
    Channel(ReadError),
    Other(ReadError),
}

impl Unread {
    fn into_error(self) -> ReadError {
        let (Self::Channel(error) | Self::Other(error)) = self;
        error
    }
}

impl From<ReadError> for Unread {
    fn from(error: ReadError) -> Self {
        Self::Other(error)
    }
}

impl Source {
    fn read(&mut self, chunk: &ChunkPlace) -> Result<Vec<Entry>, Unread> {
        let broken = |problem: String| ReadError::Broken { path: self.path.clone(), problem };
        let end = chunk.offset.checked_add(chunk.length).filter(|end| *end <= self.length);
        if end.is_none() || chunk.length > MAX_CHUNK as u64 || chunk.length < RECORD_HEAD {
            let problem = format!("chunk at byte {} has {} bytes, expected up to {MAX_CHUNK} in the file", chunk.offset, chunk.length);
            return Err(broken(problem).into());
        }
        let mut bytes = vec![0; chunk.length as usize];
        self.file
            .seek(SeekFrom::Start(chunk.offset))
            .and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(|source| ReadError::Io { path: self.path.clone(), source })?;
        let at = |error: String| ReadError::Broken { path: self.path.clone(), problem: format!("chunk at byte {}: {error}", chunk.offset) };
        let mut entries = Vec::new();
        let (head, body) = bytes.split_at(RECORD_HEAD as usize);
        if head[1..] != (body.len() as u64).to_le_bytes() {
            return Err(at(format!("its record has not the {} bytes that the index says", chunk.length)).into());
        }
        match Record::parse(head[0], body) {
            // Uncompressed chunks have lengths of their own that nobody checks.
            Ok(Record::Chunk { compression: "zstd" }) => {}
            Ok(Record::Chunk { compression }) => {
                return Err(at(format!("it is compressed by {compression:?}, expected \"zstd\"")).into());
            }
            Ok(_) => return Err(at("it is no chunk".into()).into()),
            Err(error) => return Err(at(error.to_string()).into()),
        }
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(MAX_CHUNK);
        let mut reader = LinearReader::new_with_options(options);
        let mut rest = &bytes[..];
        while let Some(event) = reader.next_event() {
            match event.map_err(|error| at(error.to_string()))? {
                LinearReadEvent::ReadRequest(wanted) => {
                    let num = wanted.min(rest.len());
                    reader.insert(num).copy_from_slice(&rest[..num]);
                    reader.notify_read(num);
                    rest = &rest[num..];
                }
                LinearReadEvent::Record { opcode, data } => match Record::parse(opcode, data) {
                    Ok(Record::Channel { id, topic }) => {
                        self.channels.insert(id, Topic::parse(topic));
                    }
                    Ok(Record::Message { channel, log_time, publish_time, data }) => {
                        let topic =
                            self.channels.get(&channel).ok_or_else(|| Unread::Channel(at(format!("channel {channel} is not there"))))?;
                        if let Some(topic) = topic {
                            entries.push(Entry { topic: topic.clone(), log_time, publish_time, data: data.to_vec() });
                        }
                    }
                    Ok(_) => {}
                    Err(error) => return Err(at(error.to_string()).into()),
                },
            }
        }
        Ok(entries)
    }
}

/// What the end of a finished file says.
#[derive(Default)]
struct Index {
    chunks: Vec<ChunkPlace>,
    /// By id; nothing for channels that are not ours.
    channels: HashMap<u16, Option<Topic>>,
}

/// The index at the end of a finished file; nothing where that is damaged or was never written.
fn read_index(file: &mut dyn Bytes, length: u64) -> Option<Index> {
    let footer_at = length.checked_sub(FOOTER)?;
    let mut footer = [0; FOOTER as usize];
    file.seek(SeekFrom::Start(footer_at)).ok()?;
    file.read_exact(&mut footer).ok()?;
    let (head, body) = footer.split_at(RECORD_HEAD as usize);
    let begin = u64::from_le_bytes(*body.first_chunk().expect("it is longer"));
    if head[0] != op::FOOTER || !body.ends_with(MAGIC) || !(MAGIC.len() as u64..footer_at).contains(&begin) {
        return None;
    }
    file.seek(SeekFrom::Start(begin)).ok()?;
    let options = LinearReaderOptions::default().with_skip_start_magic(true).with_emit_chunks(true).with_record_length_limit(MAX_RECORD);
    let mut reader = LinearReader::new_with_options(options);
    let mut index = Index::default();
    while let Some(event) = reader.next_event() {
        match event.ok()? {
            LinearReadEvent::ReadRequest(_) => {
                let num = file.read(reader.insert(INDEX_PART)).ok()?;
                reader.notify_read(num);
            }
            LinearReadEvent::Record { opcode, data } => match Record::parse(opcode, data).ok()? {
                Record::Channel { id, topic } => {
                    index.channels.insert(id, Topic::parse(topic));
                }
                // One more than is allowed is enough to refuse it.
                Record::ChunkIndex(place) if index.chunks.len() <= MAX_CHUNKS => index.chunks.push(place),
                _ => {}
            },
        }
    }
    Some(index)
}

/// Finds the chunks of a file that has no index, by the heads of its records; and where the last whole record ends.
pub(super) fn scan(file: &mut dyn Bytes, length: u64) -> io::Result<(Vec<ChunkPlace>, u64)> {
    let (mut at, mut chunks) = (MAGIC.len() as u64, Vec::new());
    let mut head = [0; RECORD_HEAD as usize];
    while at + RECORD_HEAD <= length && chunks.len() < MAX_CHUNKS {
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut head)?;
        let record = u64::from_le_bytes(head[1..].try_into().expect("eight bytes"));
        let Some(end) = at.checked_add(RECORD_HEAD).and_then(|begin| begin.checked_add(record)).filter(|end| *end <= length) else { break };
        match head[0] {
            // What comes then is an index, or the end.
            op::DATA_END | op::FOOTER | 0 => break,
            op::CHUNK => {
                // A chunk's record begins with its two times.
                let mut times = [[0; 8]; 2];
                if record < 16 {
                    break;
                }
                for time in &mut times {
                    file.read_exact(time)?;
                }
                let [start, end_time] = times.map(u64::from_le_bytes);
                chunks.push(ChunkPlace { offset: at, length: end - at, start, end: end_time });
            }
            _ => {}
        }
        at = end;
    }
    Ok((chunks, at))
}

#[cfg(test)]
mod tests {
    use super::super::writer::RecordingWriter;
    use super::*;
    use rhytid_shared::view::ViewHello;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    /// Bytes that say how many of them were read.
    struct Counted {
        bytes: Cursor<Vec<u8>>,
        num_read: Arc<AtomicU64>,
    }

    impl Read for Counted {
        fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
            let num = self.bytes.read(out)?;
            self.num_read.fetch_add(num as u64, Ordering::Relaxed);
            Ok(num)
        }
    }

    impl Seek for Counted {
        fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
            self.bytes.seek(to)
        }
    }

    /// A file that was cut, of chunks with a message each, which does not compress; from `second_from` on of another channel.
    fn cut_file(num_chunks: u64, second_from: u64) -> Vec<u8> {
        let (character, _) = crate::load_character(None).unwrap();
        let mut bytes = Vec::new();
        let mut writer = RecordingWriter::to(&mut bytes, PacketLayout::from(&*character)).unwrap();
        let hello = ViewHello::new("", &character, String::new());
        let (room, server, character) = ("a".into(), "test".into(), Box::new(hello.character));
        writer.event(1, &SessionEvent::Recording { version: VERSION, room, server, character, clock: 0 }).unwrap();
        let mut seed = 1u64;
        for index in 0..num_chunks {
            let noise: Vec<u8> = std::iter::repeat_with(|| {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (seed >> 56) as u8
            })
            .take(20_000)
            .collect();
            let slot = if index < second_from { "first" } else { "second" };
            writer.message(&Topic::Binary(slot.into()), 2 + index, None, &noise).unwrap();
            writer.flush().unwrap();
        }
        writer.finish().unwrap();
        // Of its index.
        bytes.truncate(bytes.len() - 5_000);
        bytes
    }

    #[test]
    fn opening_a_cut_file_reads_little_of_it() {
        let bytes = cut_file(100, 50);
        let (length, num_read) = (bytes.len() as u64, Arc::<AtomicU64>::default());
        let counted = Counted { bytes: Cursor::new(bytes), num_read: num_read.clone() };
        let mut recording = Recording::read(Box::new(counted), length, "cut".into()).unwrap();
        let num_opened = num_read.swap(0, Ordering::Relaxed);
        assert!(num_opened < length / 10, "{num_opened} of {length} bytes");
        // A channel that stands in a chunk between is found, once for all.
        let topic = |entries: Vec<Entry>| entries.last().map(|entry| entry.topic.clone());
        assert_eq!(topic(recording.read_chunk(80).unwrap()), Some(Topic::Binary("second".into())));
        num_read.store(0, Ordering::Relaxed);
        for index in [90, 3, 80, 49, 50] {
            let slot = if index < 50 { "first" } else { "second" };
            assert_eq!(topic(recording.read_chunk(index).unwrap()), Some(Topic::Binary(slot.into())), "{index}");
        }
        let num_again = num_read.load(Ordering::Relaxed);
        assert!(num_again < length / 10, "{num_again} of {length} bytes");
    }
}
