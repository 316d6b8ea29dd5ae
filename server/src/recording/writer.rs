//! Writing a recording beside the live stream.
//!
//! A room hands its messages to a bounded queue and goes on; a thread of the recording's own takes them from there. What does not
//! fit is left out and counted, and the file says where. A file that cannot be written any more is given up with an error; the
//! stream does not notice.
//!
//! At least every [`FLUSH`] the thread closes its chunk and hands it to the system: a killed process loses what came since, a
//! stopped machine what came since the last `fdatasync`, every [`SYNC`].

use super::format::{Entry, PROFILE, SessionEvent, Topic, VERSION};
use crate::metrics::Metrics;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, McapError, WriteOptions, Writer};
use rhytid_shared::packet::{BatchWriter, MAX_BATCH, PacketKind, PacketLayout};
use rhytid_shared::view::{CharacterHello, ViewHello};
use rhytid_shared::{Character, RoomName};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::sync::mpsc;
use tokio_tungstenite::tungstenite::{Bytes, Utf8Bytes};

/// A chunk is open no longer than this: with the time to write it, less than the second that may be lost.
const FLUSH: Duration = Duration::from_millis(700);
/// From then on a key packet ends the chunk: one that begins with a key packet can be read by itself.
const FLUSH_AT_KEY: Duration = Duration::from_millis(500);
/// How often the system is told to bring the file to the disk.
const SYNC: Duration = Duration::from_secs(5);
/// Largest chunk before compression, bytes: what a reader must hold.
const CHUNK: u64 = 1 << 20;
/// Messages that may wait: several seconds of a publisher at the fastest rate that a server takes by default.
const QUEUE: usize = 8192;
/// Bytes that may wait: a second and more of the largest messages at 60 Hz, ten of 478 points as text.
const QUEUE_BYTES: usize = 16 << 20;

/// Which rooms are recorded, and how much.
#[derive(Debug, Clone, PartialEq, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct RecordConfig {
    /// Record rooms into this folder, which must exist: each from its first publisher on, a file a room.
    #[arg(id = "record", long = "record", value_name = "DIR")]
    pub dir: Option<PathBuf>,
    /// Record only these rooms by themselves (comma-separated); others when they are asked to, over HTTP. `none` records none by
    /// itself.
    #[arg(id = "record-rooms", long = "record-rooms", value_name = "ROOMS", value_delimiter = ',', requires = "record")]
    pub rooms: Vec<String>,
    /// Recordings at a time; each is a thread, a file and up to 20 MB.
    #[arg(id = "max-recordings", long = "max-recordings", default_value_t = Self::default().recordings, value_name = "N")]
    pub recordings: usize,
    /// Bytes of one file. A fuller one is closed, and the room's next publisher begins another.
    #[arg(id = "max-recording", long = "max-recording", default_value_t = Self::default().file_bytes, value_name = "BYTES")]
    pub file_bytes: u64,
}

impl Default for RecordConfig {
    fn default() -> Self {
        // 64: what one disk keeps up with. 4 GiB: some 40 hours of landmarks, and a file that every file system holds.
        Self { dir: None, rooms: Vec::new(), recordings: 64, file_bytes: (4 << 30) - 1 }
    }
}

impl RecordConfig {
    /// True where `room` is recorded without being asked to.
    fn is_automatic(&self, room: &RoomName) -> bool {
        self.dir.is_some() && (self.rooms.is_empty() || self.rooms.iter().any(|name| name == room.as_str()))
    }
}

/// Why no recording was begun.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The server was started without a folder for them.
    #[error("this server keeps no recordings; start it with --record DIR")]
    NoFolder,
    /// There are too many.
    #[error("the server makes {most} recordings already, which is its limit")]
    TooMany {
        /// The limit.
        most: usize,
    },
    /// The room is being recorded.
    #[error("the room is being recorded already")]
    Running,
    /// The file could not be made.
    #[error("cannot make {path}: {source}")]
    Create {
        /// The file.
        path: String,
        /// What the system said.
        source: io::Error,
    },
    /// The file could not be written.
    #[error("cannot write: {0}")]
    Write(#[from] McapError),
}

/// Something to be recorded.
#[derive(Debug)]
pub(crate) enum Item {
    Event(SessionEvent),
    /// A text message that was taken; the sender's time, seconds, where it has one.
    Text {
        slot: Arc<str>,
        t: Option<f64>,
        text: Utf8Bytes,
    },
    /// A binary message that was taken.
    Binary {
        slot: Arc<str>,
        t: Option<f64>,
        bytes: Bytes,
    },
    /// A command that somebody else gave.
    Control {
        slot: Arc<str>,
        text: Utf8Bytes,
    },
    /// A message that was refused.
    Refused {
        slot: Arc<str>,
        bytes: Bytes,
    },
    /// A packet that went out.
    Packet(Bytes),
}

impl Item {
    fn num_bytes(&self) -> usize {
        match self {
            // Hellos of characters and neutrals: a few KB, seldom.
            Self::Event(_) => 4096,
            Self::Text { text, .. } | Self::Control { text, .. } => text.len(),
            Self::Binary { bytes, .. } | Self::Refused { bytes, .. } | Self::Packet(bytes) => bytes.len(),
        }
    }
}

/// A recording as the listing shows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct RecorderStatus {
    /// Name of the file in the server's folder.
    pub file: String,
    pub seconds: f64,
    /// Bytes on disk.
    pub bytes: u64,
    /// Messages left out because the disk was too slow.
    pub dropped: u64,
    /// Why it has ended, where it has.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// Begins recordings.
pub(crate) struct Recorder {
    config: RecordConfig,
    character: CharacterHello,
    layout: PacketLayout,
    metrics: Arc<Metrics>,
    num_running: Arc<AtomicUsize>,
    /// The service waits for whoever holds one.
    tasks: mpsc::Sender<Infallible>,
}

impl Recorder {
    /// `url` of the character's file is none here: a recording outlives it.
    pub fn new(config: RecordConfig, character: &Character, metrics: Arc<Metrics>, tasks: mpsc::Sender<Infallible>) -> Self {
        let layout = PacketLayout::from(character);
        let character = ViewHello::new("", character, String::new()).character;
        Self { config, character, layout, metrics, num_running: Arc::default(), tasks }
    }

    /// The folder of recordings.
    pub fn dir(&self) -> Option<&Path> {
        self.config.dir.as_deref()
    }

    pub fn is_automatic(&self, room: &RoomName) -> bool {
        self.config.is_automatic(room)
    }

    /// Begins a recording of `room`, whose clock counts from `since`; the file is made by a thread of its own, which tells once that is
    /// done.
    pub fn start(&self, room: &RoomName, since: Instant) -> Result<(Arc<Sink>, Made), RecordError> {
        let dir = self.config.dir.clone().ok_or(RecordError::NoFolder)?;
        let place = Running::take(&self.num_running, self.config.recordings, &self.metrics)?;
        let (queue, items) = sync_channel(QUEUE);
        let (made, is_made) = sync_channel(1);
        let shared = Arc::new(Shared::default());
        let (started, unix_nanos) = (Instant::now(), unix_nanos());
        let clock = unix_nanos.saturating_sub(nanos(started - since));
        let sink = Sink { started, clock, queue, shared: shared.clone(), metrics: self.metrics.clone() };
        let keeps = self.tasks.clone();
        let begin = SessionEvent::Recording {
            version: VERSION,
            room: room.to_string(),
            server: env!("CARGO_PKG_VERSION").into(),
            character: Box::new(self.character.clone()),
            clock,
        };
        let (layout, most_bytes, metrics, room) = (self.layout.clone(), self.config.file_bytes, self.metrics.clone(), room.clone());
        let folder = dir.clone();
        let open = move |shared: &Shared| {
            let (file, path) = create(&dir, &room)?;
            *lock(&shared.file) = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            tracing::info!(file = %path.display(), "recording");
            let mut writer = RecordingWriter::new(file, layout, most_bytes)?;
            writer.event(unix_nanos, &begin)?;
            Ok::<_, RecordError>(writer)
        };
        let run = move || {
            let ended = match open(&shared) {
                Ok(writer) => {
                    let _ = made.send(Ok(()));
                    write_all(&items, writer, &shared, &metrics).map_err(|error| error.to_string())
                }
                Err(error) => {
                    let told = error.to_string();
                    let _ = made.send(Err(error));
                    Err(told)
                }
            };
            // What still comes is let go.
            drop(items);
            let file = lock(&shared.file).clone();
            match &ended {
                Ok(()) => tracing::info!(file, "recording ended"),
                Err(error) => {
                    metrics.recording_failures.inc();
                    tracing::error!(file, error, "recording failed; the stream goes on");
                }
            }
            let has_failed = ended.is_err();
            // Before the room is told, so that another may begin at once.
            drop(place);
            *lock(&shared.end) = Some(ended.err().unwrap_or_default());
            // On a full disk every publisher would leave a file of which nothing can be read. This is known without reading it.
            if has_failed && !file.is_empty() && shared.bytes.load(Ordering::Relaxed) == 0 {
                let _ = std::fs::remove_file(folder.join(&file));
            }
            drop(keeps);
        };
        let thread = std::thread::Builder::new().name("recording".into());
        thread.spawn(run).map_err(|source| RecordError::Create { path: "a thread".into(), source })?;
        Ok((Arc::new(sink), is_made))
    }
}

/// Told once a recording's file is there, or why it is not.
pub(crate) type Made = Receiver<Result<(), RecordError>>;

/// What stands under these locks is whole at each step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A place among the recordings at a time.
struct Running {
    count: Arc<AtomicUsize>,
    metrics: Arc<Metrics>,
}

impl Running {
    fn take(count: &Arc<AtomicUsize>, most: usize, metrics: &Arc<Metrics>) -> Result<Self, RecordError> {
        count
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |running| (running < most).then_some(running + 1))
            .map_err(|_| RecordError::TooMany { most })?;
        metrics.recordings.inc();
        Ok(Self { count: count.clone(), metrics: metrics.clone() })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.count.fetch_sub(1, Ordering::Relaxed);
        self.metrics.recordings.dec();
    }
}

/// Makes a file of its own for a recording of `room`: no other one is overwritten. A room's name cannot leave the folder: it has no
/// dots and no slashes.
fn create(dir: &Path, room: &RoomName) -> Result<(File, PathBuf), RecordError> {
    let time = stamp(SystemTime::now());
    for attempt in 1..100 {
        let suffix = if attempt == 1 { String::new() } else { format!("-{attempt}") };
        let path = dir.join(format!("{room}-{time}{suffix}.mcap"));
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => {
                hold(&file);
                return Ok((file, path));
            }
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(source) => return Err(RecordError::Create { path: path.display().to_string(), source }),
        }
    }
    let source = io::ErrorKind::AlreadyExists.into();
    Err(RecordError::Create { path: dir.join(format!("{room}-{time}.mcap")).display().to_string(), source })
}

/// Marks a recording's file as its holder's for as long as it is open there, also in clones of it; false where another holds it.
/// Whoever only reads is not hindered: elsewhere than on Unix a mark would do that, so there is none.
pub(super) fn hold(file: &File) -> bool {
    #[cfg(unix)]
    return !matches!(file.try_lock(), Err(std::fs::TryLockError::WouldBlock));
    #[cfg(not(unix))]
    {
        let _ = file;
        true
    }
}

/// The room that the name of a recording says, where it is one that [`create`] gives.
pub(crate) fn room_of_file(name: &str) -> Option<RoomName> {
    let name = name.strip_suffix(".mcap")?;
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let name = name.rsplit_once('-').filter(|(_, number)| is_number(number)).map_or(name, |(name, _)| name);
    let (room, stamp) = name.rsplit_once('-')?;
    let is_stamp = stamp.len() == "20260131T235959Z".len()
        && stamp.bytes().enumerate().all(|(at, byte)| match at {
            8 => byte == b'T',
            15 => byte == b'Z',
            _ => byte.is_ascii_digit(),
        });
    if is_stamp { RoomName::new(room).ok() } else { None }
}

/// `20260131T235959Z`.
fn stamp(time: SystemTime) -> String {
    let seconds = time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Days since 1970 to a date of the Gregorian calendar, counted in years that begin in March ("civil from days", Hinnant 2013).
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!("{year:04}{month:02}{day:02}T{:02}{:02}{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

/// Of the Unix clock.
pub(super) fn unix_nanos() -> u64 {
    nanos(SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default())
}

pub(super) fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX / 2)
}

/// What the room and the thread both know.
#[derive(Default)]
struct Shared {
    waiting_bytes: AtomicUsize,
    /// Written; nothing as long as no chunk is.
    bytes: AtomicU64,
    /// Left out since the thread was last told.
    gap: AtomicU64,
    dropped: AtomicU64,
    /// Name of the file, once there is one.
    file: Mutex<String>,
    /// Why it has ended; empty where it was told to.
    end: Mutex<Option<String>>,
}

/// The room's end of a recording. The file is finished when the last of these is dropped.
pub(crate) struct Sink {
    started: Instant,
    /// What the Unix clock said when the room's clock was at 0, ns.
    clock: u64,
    queue: SyncSender<(u64, Item)>,
    shared: Arc<Shared>,
    metrics: Arc<Metrics>,
}

impl Sink {
    /// Records `item` as of `at` on the room's clock, ns, unless the disk is too slow. Never waits.
    pub fn put(&self, at: u64, item: Item) {
        let num_bytes = item.num_bytes();
        let before = self.shared.waiting_bytes.fetch_add(num_bytes, Ordering::Relaxed);
        let sent = if before + num_bytes > QUEUE_BYTES {
            false
        } else {
            match self.queue.try_send((self.clock.saturating_add(at), item)) {
                Ok(()) => return,
                Err(TrySendError::Full(_)) => false,
                // The recording has failed, which is counted once.
                Err(TrySendError::Disconnected(_)) => true,
            }
        };
        self.shared.waiting_bytes.fetch_sub(num_bytes, Ordering::Relaxed);
        if !sent {
            self.shared.gap.fetch_add(1, Ordering::Relaxed);
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
            self.metrics.recording_dropped.inc();
        }
    }

    /// True where nothing is written any more.
    pub fn has_ended(&self) -> bool {
        lock(&self.shared.end).is_some()
    }

    pub fn status(&self) -> RecorderStatus {
        RecorderStatus {
            file: lock(&self.shared.file).clone(),
            seconds: self.started.elapsed().as_secs_f64(),
            bytes: self.shared.bytes.load(Ordering::Relaxed),
            dropped: self.shared.dropped.load(Ordering::Relaxed),
            error: lock(&self.shared.end).clone().filter(|error| !error.is_empty()),
        }
    }
}

/// Writes what comes until the room has let go of the recording.
fn write_all(
    items: &Receiver<(u64, Item)>,
    mut writer: RecordingWriter<File>,
    shared: &Shared,
    metrics: &Metrics,
) -> Result<(), EndedEarly> {
    let mut last_sync = Instant::now();
    let mut counted = 0;
    let count = |before: u64, bytes: u64| {
        metrics.recording_bytes.inc_by(bytes - before);
        shared.bytes.store(bytes, Ordering::Relaxed);
        bytes
    };
    loop {
        match items.recv_timeout(writer.due_in()) {
            Ok((at, item)) => {
                shared.waiting_bytes.fetch_sub(item.num_bytes(), Ordering::Relaxed);
                let gap = shared.gap.swap(0, Ordering::Relaxed);
                if gap > 0 {
                    writer.event(at, &SessionEvent::Gap { messages: gap })?;
                }
                writer.put(at, item)?;
                metrics.recording_messages.inc();
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                count(counted, writer.finish()?);
                return Ok(());
            }
        }
        writer.flush_if_due()?;
        // A key packet closes chunks, too.
        if writer.num_bytes() == counted {
            continue;
        }
        counted = count(counted, writer.num_bytes());
        if last_sync.elapsed() >= SYNC {
            writer.sync()?;
            last_sync = Instant::now();
        }
        if writer.num_bytes() >= writer.most_bytes {
            let error = EndedEarly::Full { bytes: writer.num_bytes(), most: writer.most_bytes };
            writer.event(writer.last_time, &SessionEvent::Stop { reason: error.to_string() })?;
            count(counted, writer.finish()?);
            return Err(error);
        }
    }
}

/// Why a recording ended before it was told to.
#[derive(Debug, thiserror::Error)]
enum EndedEarly {
    #[error("the file has {bytes} bytes, its limit is {most}")]
    Full { bytes: u64, most: u64 },
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("{0}")]
    Mcap(McapError),
}

impl From<McapError> for EndedEarly {
    /// In the system's own words where it was the system.
    fn from(error: McapError) -> Self {
        match error {
            McapError::Io(error) => Self::Io(error),
            error => Self::Mcap(error),
        }
    }
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
    most_bytes: u64,
    last_time: u64,
    last_t: u64,
}

impl RecordingWriter<File> {
    fn new(file: File, layout: PacketLayout, most_bytes: u64) -> Result<Self, RecordError> {
        let handle = file.try_clone().map_err(McapError::Io)?;
        let mut writer = Self::to(file, layout)?;
        (writer.file, writer.most_bytes) = (Some(handle), most_bytes);
        Ok(writer)
    }

    /// Brings to the disk what has been flushed.
    fn sync(&mut self) -> Result<(), McapError> {
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
    fn due_in(&self) -> Duration {
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

#[cfg(test)]
mod tests {
    use super::super::reader::Recording;
    use super::*;

    #[test]
    fn what_does_not_fit_into_the_queue_is_counted_and_not_waited_for() {
        let (queue, items) = sync_channel(2);
        let metrics = Arc::new(Metrics::new());
        let sink = Sink { started: Instant::now(), clock: 0, queue, shared: Arc::default(), metrics: metrics.clone() };
        let slot: Arc<str> = "main".into();
        let text = |len: usize| Item::Text { slot: slot.clone(), t: None, text: "x".repeat(len).into() };
        let start = Instant::now();
        for _ in 0..5 {
            sink.put(1, text(10));
        }
        assert_eq!((sink.status().dropped, metrics.recording_dropped.get()), (3, 3));
        assert_eq!(sink.shared.waiting_bytes.load(Ordering::Relaxed), 20);
        // One that has room by number and not by bytes.
        items.recv().unwrap();
        sink.put(1, text(QUEUE_BYTES));
        assert_eq!(sink.status().dropped, 4);
        // After the end nothing is counted any more: that it has failed is.
        drop(items);
        sink.put(1, text(10));
        assert_eq!(sink.status().dropped, 4);
        assert!(start.elapsed() < Duration::from_secs(1));
    }

    #[test]
    fn a_gap_a_full_file_and_the_end_are_written_down() {
        let dir = std::env::temp_dir().join(format!("rhytid-writer-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let (character, _) = crate::load_character(None).unwrap();
        let metrics = Arc::new(Metrics::new());
        let config = RecordConfig { dir: Some(dir.clone()), file_bytes: 20_000, recordings: 1, ..RecordConfig::default() };
        let (tasks, _kept) = mpsc::channel(1);
        let recorder = Recorder::new(config, &character, metrics.clone(), tasks);
        let since = Instant::now();
        let room = RoomName::new("a").unwrap();
        let (sink, made) = recorder.start(&room, since).unwrap();
        made.recv().unwrap().unwrap();
        let Err(RecordError::TooMany { most: 1 }) = recorder.start(&room, since) else { panic!("one is the limit") };
        sink.shared.gap.store(7, Ordering::Relaxed);
        let mut seed = 1u64;
        let start = Instant::now();
        while !sink.has_ended() {
            // What does not compress.
            let noise: String = std::iter::repeat_with(|| {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                char::from(b' ' + ((seed >> 33) % 90) as u8)
            })
            .take(2000)
            .collect();
            sink.put(nanos(since.elapsed()), Item::Text { slot: "main".into(), t: Some(1.0), text: noise.into() });
            std::thread::sleep(Duration::from_millis(20));
            assert!(start.elapsed() < Duration::from_secs(20), "it ends when the file is full");
        }
        let status = sink.status();
        assert!(status.error.as_ref().is_some_and(|error| error.ends_with("its limit is 20000")), "{status:?}");
        assert_eq!((metrics.recording_failures.get(), metrics.recordings.get()), (1, 0));
        let path = dir.join(&status.file);
        assert_eq!(metrics.recording_bytes.get(), std::fs::metadata(&path).unwrap().len());
        let mut recording = Recording::open(&path).unwrap();
        assert_eq!(recording.cut_off(), None, "it is finished all the same");
        let mut text = String::new();
        for index in 0..recording.chunks().len() {
            for entry in recording.read_chunk(index).unwrap().iter().filter(|entry| entry.topic == Topic::Session) {
                text.push_str(std::str::from_utf8(&entry.data).unwrap());
            }
        }
        assert!(text.contains(r#"{"event":"gap","messages":7}"#) && text.contains(r#"{"event":"stop","reason":"the file has"#), "{text}");
        std::fs::remove_dir_all(&dir).unwrap();
    }

    #[test]
    fn recordings_are_told_by_room_though_names_begin_alike() {
        let room = |file: &str| room_of_file(file).map(|room| room.to_string());
        assert_eq!(room("a-20260131T235959Z.mcap").as_deref(), Some("a"));
        assert_eq!(room("a-20260131T235959Z-12.mcap").as_deref(), Some("a"));
        assert_eq!(room("a-b-20260131T235959Z.mcap").as_deref(), Some("a-b"));
        assert_eq!(room("a-20260131T235959Z-20260131T235959Z.mcap").as_deref(), Some("a-20260131T235959Z"));
        for file in ["a-.mcap", "a-20260131T235959Z-.mcap", "b.mcap", "-20260131T235959Z.mcap", "a-20260131T235959Z", "a-2.mcap"] {
            assert_eq!(room(file), None, "{file}");
        }
    }

    #[test]
    fn stamps_are_dates() {
        let at = |seconds: u64| stamp(UNIX_EPOCH + Duration::from_secs(seconds));
        assert_eq!(at(0), "19700101T000000Z");
        assert_eq!(at(951_827_696), "20000229T123456Z");
        assert_eq!(at(1_767_225_599), "20251231T235959Z");
    }
}
