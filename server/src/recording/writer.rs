//! Writes one recording from front to back.
//!
//! At least every [`FLUSH`] its chunk is closed and handed to the system: a killed process loses what came since, a stopped machine
//! what came since the last `fdatasync`.

use super::format::{Entry, PROFILE, SessionEvent, Topic};
use super::recorder::{Item, RecordError};
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, McapError, WriteOptions, Writer};
use rhytid_shared::packet::{BatchWriter, MAX_BATCH, PacketKind, PacketLayout};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio_tungstenite::tungstenite::Bytes;

/// A chunk is open no longer than this: with the time to write it, less than the second that may be lost.
const FLUSH: Duration = Duration::from_millis(700);
/// From then on a key packet ends the chunk: one that begins with a key packet can be read by itself.
const FLUSH_AT_KEY: Duration = Duration::from_millis(500);
/// Largest chunk before compression, bytes: what a reader must hold.
const CHUNK: u64 = 1 << 20;

/// Of the Unix clock.
pub(super) fn unix_nanos() -> u64 {
    nanos(SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default())
}

pub(super) fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX / 2)
}

/// A file that says how much has gone into it.
struct Counting<W> {
    inner: W,
    num_bytes: Arc<AtomicU64>,
}

impl<W: Write> Write for Counting<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let num = self.inner.write(bytes)?;
        self.num_bytes.fetch_add(num as u64, Ordering::Relaxed);
        Ok(num)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

/// Writes one recording into `W`.
pub struct RecordingWriter<W: Write> {
    writer: Writer<NoSeek<BufWriter<Counting<W>>>>,
    /// For `fdatasync`.
    file: Option<File>,
    channels: BTreeMap<Topic, u16>,
    sequences: BTreeMap<u16, u32>,
    packets: Vec<(u64, Bytes)>,
    batches: BatchWriter,
    batch: Vec<u8>,
    /// When the open chunk was begun.
    open_since: Option<Instant>,
    num_bytes: Arc<AtomicU64>,
    pub(super) most_bytes: u64,
    pub(super) last_time: u64,
    last_t: u64,
}

impl RecordingWriter<File> {
    pub(super) fn new(file: File, layout: PacketLayout, most_bytes: u64) -> Result<Self, RecordError> {
        let handle = file.try_clone().map_err(McapError::Io)?;
        let mut writer = Self::to(file, layout)?;
        (writer.file, writer.most_bytes) = (Some(handle), most_bytes);
        Ok(writer)
    }

    /// Brings to the disk what has been flushed.
    pub(super) fn sync(&mut self) -> Result<(), McapError> {
        if let Some(file) = &self.file {
            file.sync_data()?;
        }
        Ok(())
    }
}

impl<W: Write> RecordingWriter<W> {
    /// Begins a recording of packets of `layout` in `inner`, which is written from front to back.
    pub fn to(inner: W, layout: PacketLayout) -> Result<Self, RecordError> {
        let num_bytes = Arc::<AtomicU64>::default();
        let counting = Counting { inner, num_bytes: num_bytes.clone() };
        let writer = WriteOptions::new()
            .profile(PROFILE)
            .library(concat!("rhytid-server ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            // In this thread: a chunk is a few KB.
            .compression_threads(0)
            .chunk_size(Some(CHUNK))
            // Chunks are written whole: a file cut anywhere ends behind a whole chunk or inside one.
            .disable_seeking(true)
            .create(NoSeek::new(BufWriter::with_capacity(64 << 10, counting)))?;
        Ok(Self {
            writer,
            file: None,
            channels: BTreeMap::new(),
            sequences: BTreeMap::new(),
            packets: Vec::new(),
            batches: BatchWriter::new(layout),
            batch: Vec::new(),
            open_since: None,
            num_bytes,
            most_bytes: u64::MAX,
            last_time: 0,
            last_t: 0,
        })
    }

    /// Bytes written so far; without the open chunk.
    pub fn num_bytes(&self) -> u64 {
        self.num_bytes.load(Ordering::Relaxed)
    }

    /// How long the open chunk may stay open.
    pub(super) fn due_in(&self) -> Duration {
        self.open_since.map_or(FLUSH, |since| FLUSH.saturating_sub(since.elapsed()))
    }

    pub(crate) fn put(&mut self, at: u64, item: Item) -> Result<(), McapError> {
        match item {
            Item::Event(event) => self.event(at, &event),
            Item::Text { slot, t, text } => self.message(&Topic::Text(slot.to_string()), at, t, text.as_bytes()),
            Item::Binary { slot, t, bytes } => self.message(&Topic::Binary(slot.to_string()), at, t, &bytes),
            Item::Control { slot, text } => self.message(&Topic::Control(slot.to_string()), at, None, text.as_bytes()),
            Item::Refused { slot, bytes } => self.message(&Topic::Refused(slot.to_string()), at, None, &bytes),
            Item::Packet(bytes) => self.put_packet(at, bytes),
        }
    }

    /// Keeps a packet for the next batch; a chunk that is old enough is closed before a key packet.
    pub(super) fn put_packet(&mut self, at: u64, bytes: Bytes) -> Result<(), McapError> {
        let is_key = PacketKind::of(&bytes) == Some(PacketKind::Key);
        let is_old = self.open_since.is_some_and(|since| since.elapsed() >= FLUSH_AT_KEY);
        if (is_key && is_old) || self.packets.len() >= MAX_BATCH {
            self.flush()?;
        }
        self.packet(at, bytes);
        Ok(())
    }

    /// Closes the chunk where it has been open long enough.
    pub(super) fn flush_if_due(&mut self) -> Result<(), McapError> {
        if self.due_in().is_zero() { self.flush() } else { Ok(()) }
    }

    /// Writes an event as of `at`, Unix clock, ns.
    pub fn event(&mut self, at: u64, event: &SessionEvent) -> Result<(), McapError> {
        let text = serde_json::to_vec(event).expect("plain data can be written");
        self.message(&Topic::Session, at, None, &text)
    }

    /// Writes a message as of `at`, Unix clock, ns, of time `t` on its sender's clock, seconds. Earlier times than before count as the
    /// time before.
    pub fn message(&mut self, topic: &Topic, at: u64, t: Option<f64>, data: &[u8]) -> Result<(), McapError> {
        let at = self.tell(at);
        if let Some(t) = t {
            self.last_t = (t * 1e9) as u64;
        }
        self.write(topic, at, self.last_t, data)
    }

    /// Writes a message of another recording as it stands there.
    pub(super) fn copy(&mut self, entry: &Entry) -> Result<(), McapError> {
        let at = self.tell(entry.log_time);
        self.last_t = entry.publish_time;
        // A batch is of the time of its first packet, which its messages have passed.
        let at = if entry.topic == Topic::Packets { entry.log_time } else { at };
        self.write(&entry.topic, at, entry.publish_time, &entry.data)
    }

    /// Keeps a packet for the next batch.
    pub fn packet(&mut self, at: u64, bytes: Bytes) {
        let at = self.tell(at);
        self.packets.push((at, bytes));
    }

    fn tell(&mut self, at: u64) -> u64 {
        self.last_time = self.last_time.max(at);
        self.open_since.get_or_insert_with(Instant::now);
        self.last_time
    }

    fn write(&mut self, topic: &Topic, log_time: u64, publish_time: u64, data: &[u8]) -> Result<(), McapError> {
        let channel_id = match self.channels.get(topic) {
            Some(id) => *id,
            None => {
                let encoding = topic.encoding();
                let schema = match encoding {
                    // Without a schema, viewers of MCAP files show no JSON.
                    "json" => self.writer.add_schema(&schema_name(topic), "jsonschema", br#"{"type":"object"}"#)?,
                    _ => 0,
                };
                let id = self.writer.add_channel(schema, &topic.name(), encoding, &BTreeMap::new())?;
                self.channels.insert(topic.clone(), id);
                id
            }
        };
        let sequence = self.sequences.entry(channel_id).or_default();
        let header = MessageHeader { channel_id, sequence: *sequence, log_time, publish_time };
        *sequence = sequence.wrapping_add(1);
        self.writer.write_to_known_channel(&header, data)
    }

    /// Writes the packets kept, closes the chunk and hands it to the system.
    pub fn flush(&mut self) -> Result<(), McapError> {
        self.pack()?;
        self.writer.flush()?;
        self.open_since = None;
        Ok(())
    }

    fn pack(&mut self) -> Result<(), McapError> {
        let Some((first, _)) = self.packets.first() else { return Ok(()) };
        let log_time = *first;
        let mut batch = std::mem::take(&mut self.batch);
        let packets = self.packets.iter().map(|(at, bytes)| (at / 1000, &**bytes));
        self.batches.pack(packets, &mut batch).map_err(|error| McapError::Io(io::Error::other(error)))?;
        self.packets.clear();
        let written = self.write(&Topic::Packets, log_time, self.last_t, &batch);
        self.batch = batch;
        written
    }

    /// Writes the rest, and the index by which a reader finds its way; gives the number of bytes in all.
    pub fn finish(mut self) -> Result<u64, McapError> {
        self.pack()?;
        self.writer.finish()?;
        self.writer.into_inner().into_inner().flush()?;
        if let Some(file) = &self.file {
            file.sync_all()?;
        }
        Ok(self.num_bytes.load(Ordering::Relaxed))
    }
}

fn schema_name(topic: &Topic) -> String {
    match topic {
        Topic::Session => "rhytid.session".into(),
        _ => "rhytid.publish".into(),
    }
}
