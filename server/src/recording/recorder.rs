//! Recording beside the live stream.
//!
//! A room hands its messages to a bounded queue and goes on; a thread of the recording's own takes them from there. What does not
//! fit is left out and counted, and the file says where. A file that cannot be written any more is given up with an error; the
//! stream does not notice.

use super::files::create;
use super::format::{SessionEvent, VERSION};
use super::writer::{RecordingWriter, nanos, unix_nanos};
use crate::lock::lock;
use crate::metrics::Metrics;
use mcap::McapError;
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::view::{CharacterHello, ViewHello};
use rhytid_shared::{Character, RoomName};
use serde::{Deserialize, Serialize};
use std::convert::Infallible;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_tungstenite::tungstenite::{Bytes, Utf8Bytes};

/// How often the system is told to bring the file to the disk.
const SYNC: Duration = Duration::from_secs(5);
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
    #[error("cannot make {file}: {source}")]
    Create {
        /// Its name: where the server keeps it is nobody's business.
        file: String,
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
    /// The beginning of a session whose packets are recorded, and no messages that they could be solved from.
    pub fn under_way(session: u32, slot: &str, source: &str) -> Self {
        Self::Event(SessionEvent::Start {
            session,
            slot: slot.to_owned(),
            source: source.to_owned(),
            under_way: true,
            kept_neutral: None,
            profile: None,
            solve: None,
        })
    }

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
                    tracing::error!(file, folder = %folder.display(), error, "recording failed; the stream goes on");
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
        thread.spawn(run).map_err(|source| RecordError::Create { file: "a thread".into(), source })?;
        Ok((Arc::new(sink), is_made))
    }
}

/// Told once a recording's file is there, or why it is not.
pub(crate) type Made = Receiver<Result<(), RecordError>>;

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

#[cfg(test)]
mod tests {
    use super::super::format::Topic;
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
}
