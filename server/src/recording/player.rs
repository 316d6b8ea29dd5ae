//! Playing a recording into a room: its faces go to the room's viewers as they were, and whoever may ask can stop, seek and change the
//! speed. Every jump begins a new session, because a session's time does not go back.

use super::faces::{Faces, Moment};
use super::files::room_of_file;
use super::format::SessionEvent;
use super::reader::{ReadError, Recording};
use super::recorder::Item;
use crate::config::seconds;
use crate::room::{Evicted, Publishing, RoomError, SlotClaim};
use crate::service::Hub;
use rhytid_shared::{PublishHello, Resume, RoomName};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;

/// Recordings that are opened at a time: of one that was not finished, the head of every chunk is read.
const MOST_OPENING: usize = 2;
/// Players at a time: each is a thread and a few hundred KB.
const MOST_PLAYERS: usize = 16;
/// How often a face that stands still is sent again, so that viewers do not take its sender for gone.
const HOLD: Duration = Duration::from_millis(50);
/// How often a player that waits looks whether the service ends.
const LOOK: Duration = Duration::from_millis(100);
/// Speeds that make sense; an infinite one sends everything at once.
const SPEEDS: std::ops::RangeInclusive<f64> = 0.01..=100.0;
/// Requests of one player that may wait for it: each jump takes it some milliseconds.
const MOST_WAITING: usize = 64;
/// Frames sent in a row at infinite speed before commands are looked at.
const BURST: usize = 256;

/// What a player shall do; what is not said stays as it is.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlayRequest {
    /// A recording in the server's folder, by its name. Starts a player, in place of one that plays another.
    pub file: Option<String>,
    /// Go there, seconds since the recording began.
    pub position: Option<f64>,
    /// Play, or stand still.
    pub playing: Option<bool>,
    /// Seconds of the recording a second, 0.01 to 100.
    pub speed: Option<f64>,
    /// Begin again at the end.
    #[serde(rename = "loop")]
    pub repeats: Option<bool>,
    /// Where it begins, also again; seconds.
    pub from: Option<f64>,
    /// Where it ends, seconds.
    pub to: Option<f64>,
    /// Take the room from a publisher that is there.
    pub takeover: bool,
}

/// How a player stands.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlayStatus {
    /// Name of the recording.
    pub file: String,
    /// Seconds since the recording began.
    pub position: f64,
    /// How long it is, seconds.
    pub seconds: f64,
    /// Whether it moves.
    pub playing: bool,
    /// Seconds of the recording a second.
    pub speed: f64,
    /// Begins again at the end.
    #[serde(rename = "loop")]
    pub repeats: bool,
    /// Where it begins, seconds.
    pub from: f64,
    /// Where it ends, seconds.
    pub to: f64,
    /// Why it has ended, where it has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// Why a player did not start or does not obey.
#[derive(Debug, thiserror::Error)]
pub enum PlayError {
    /// The recording cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// It is of another character.
    #[error("the recording is of character {recorded:?}, this server has {served:?}, which is another file")]
    Character {
        /// Its name in the recording.
        recorded: String,
        /// The server's.
        served: String,
    },
    /// There is no player in the room.
    #[error("nothing is played in this room; say which \"file\"")]
    NoPlayer,
    /// The server was started without a folder of recordings.
    #[error("this server keeps no recordings; start it with --record DIR")]
    NoFolder,
    /// The name is none of a recording, or of one of a room that whoever asks may not watch: which of the two, nobody learns.
    #[error("field file is {got:?}, expected the name of a recording in the server's folder")]
    File {
        /// The name.
        got: String,
    },
    /// A number outside its range.
    #[error("field {field} is {got}, expected {expected}")]
    Range {
        /// The field.
        field: &'static str,
        /// Its value.
        got: f64,
        /// The range.
        expected: &'static str,
    },
    /// There are too many.
    #[error("the server plays {MOST_PLAYERS} recordings already, which is its limit")]
    TooMany,
    /// It is told more than it can do.
    #[error("the player has {MOST_WAITING} requests waiting, which is its limit")]
    Busy,
    /// The machine has no thread for it.
    #[error("cannot start a thread: {0}")]
    Thread(String),
    /// The room cannot be had.
    #[error("{problem}")]
    Room {
        /// Why, short and stable, as publishers are told it.
        code: &'static str,
        /// The same in words.
        problem: String,
    },
}

impl PlayError {
    fn no_file(name: &str) -> Self {
        Self::File { got: name.chars().take(80).collect() }
    }
}

impl From<RoomError> for PlayError {
    fn from(error: RoomError) -> Self {
        Self::Room { code: error.code(), problem: error.to_string() }
    }
}

impl PlayRequest {
    fn check(&self) -> Result<(), PlayError> {
        for (field, value) in [("position", self.position), ("from", self.from), ("to", self.to)] {
            if let Some(got) = value.filter(|value| !(0.0..=1e9).contains(value)) {
                return Err(PlayError::Range { field, got, expected: "seconds, 0 or more" });
            }
        }
        match self.speed.filter(|speed| !SPEEDS.contains(speed) && *speed != f64::INFINITY) {
            Some(got) => Err(PlayError::Range { field: "speed", got, expected: "0.01 to 100" }),
            None => Ok(()),
        }
    }
}

/// All players, by room.
pub(crate) struct Players {
    by_room: Mutex<BTreeMap<RoomName, Handle>>,
    opening: Arc<Semaphore>,
}

impl Default for Players {
    fn default() -> Self {
        Self { by_room: Mutex::default(), opening: Arc::new(Semaphore::new(MOST_OPENING)) }
    }
}

/// A player's outer end; dropped, it ends.
struct Handle {
    requests: SyncSender<PlayRequest>,
    status: Arc<Mutex<PlayStatus>>,
}

/// What stands under these locks is whole at each step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Players {
    /// Does what `request` says in `room`. A file is played as by [`Self::start`].
    pub async fn request(
        &self,
        hub: &Arc<Hub>,
        room: &RoomName,
        request: PlayRequest,
        may_watch: impl Fn(Option<&RoomName>) -> bool,
    ) -> Result<PlayStatus, PlayError> {
        request.check()?;
        if let Some(file) = &request.file {
            let path = path_of(hub.recorder.dir(), file)?;
            let most_standing = Some(seconds(hub.config.timeouts.replay_idle));
            return self.start(hub, room, path, request, most_standing, may_watch).await;
        }
        let by_room = lock(&self.by_room);
        let handle = by_room.get(room).filter(|handle| lock(&handle.status).error.is_none()).ok_or(PlayError::NoPlayer)?;
        handle.requests.try_send(request.clone()).map_err(|error| match error {
            TrySendError::Full(_) => PlayError::Busy,
            TrySendError::Disconnected(_) => PlayError::NoPlayer,
        })?;
        let mut status = lock(&handle.status).clone();
        // As it will be in a moment.
        status.position = request.position.unwrap_or(status.position);
        status.playing = request.playing.unwrap_or(status.playing);
        status.speed = request.speed.unwrap_or(status.speed);
        status.repeats = request.repeats.unwrap_or(status.repeats);
        Ok(status)
    }

    /// Plays the recording at `path` in `room`, where `may_watch` says so of the room it was made of; of one whose room is not known,
    /// where it says so of none. Ends where it has stood still for `most_standing`.
    pub async fn start(
        &self,
        hub: &Arc<Hub>,
        room: &RoomName,
        path: PathBuf,
        request: PlayRequest,
        most_standing: Option<Duration>,
        may_watch: impl Fn(Option<&RoomName>) -> bool,
    ) -> Result<PlayStatus, PlayError> {
        request.check()?;
        self.check_place(room)?;
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let permit = self.opening.clone().acquire_owned().await.map_err(|error| PlayError::Thread(error.to_string()))?;
        // Opening a recording reads its index.
        let name = file.clone();
        let open = move || {
            // Until it is done, also where nobody waits for it any more.
            let _permit = permit;
            // Where the server keeps it is nobody's business.
            Recording::open_as(&path, name)
        };
        let opened = tokio::task::spawn_blocking(open).await.map_err(|error| PlayError::Thread(error.to_string()))?;
        let recorded = match &opened {
            Ok(recording) => RoomName::new(recording.room()).ok(),
            // Its name says whose it is.
            Err(_) => room_of_file(&file),
        };
        if !may_watch(recorded.as_ref()) {
            return Err(PlayError::no_file(&file));
        }
        let recording = opened?;
        if recording.character().sha256 != hub.character.sha256 {
            let (recorded, served) = (recording.character().name.clone(), hub.character.name.clone());
            return Err(PlayError::Character { recorded, served });
        }
        if let Some(cluster) = &hub.cluster {
            // Last of all: another node's publisher has to go only for what can be played.
            let hello = PublishHello { source: source_of(&file), takeover: request.takeover, ..PublishHello::default() };
            let entered = cluster.enter(&hub.rooms, room, &hello, None).await;
            entered.map_err(|error| PlayError::Room { code: error.code(), problem: error.to_string() })?;
        }
        self.seat(hub, room, file, recording, &request, most_standing)
    }

    /// Says so where there are too many already for another one in `room`.
    fn check_place(&self, room: &RoomName) -> Result<(), PlayError> {
        let by_room = lock(&self.by_room);
        let others = by_room.iter().filter(|(name, handle)| *name != room && lock(&handle.status).error.is_none()).count();
        if others >= MOST_PLAYERS { Err(PlayError::TooMany) } else { Ok(()) }
    }

    /// Starts the thread that plays `recording`, called `file`.
    fn seat(
        &self,
        hub: &Arc<Hub>,
        room: &RoomName,
        file: String,
        recording: Recording,
        request: &PlayRequest,
        most_standing: Option<Duration>,
    ) -> Result<PlayStatus, PlayError> {
        let mut by_room = lock(&self.by_room);
        // One of our own in this room makes place; others that have ended are forgotten.
        let replaces = by_room.remove(room).is_some_and(|handle| lock(&handle.status).error.is_none());
        by_room.retain(|_, handle| lock(&handle.status).error.is_none());
        if by_room.len() >= MOST_PLAYERS {
            return Err(PlayError::TooMany);
        }
        let length = recording.seconds();
        let from = request.from.unwrap_or(0.0).min(length);
        let status = PlayStatus {
            file,
            position: request.position.unwrap_or(from),
            seconds: length,
            playing: request.playing.unwrap_or(true),
            speed: request.speed.unwrap_or(1.0),
            repeats: request.repeats.unwrap_or(false),
            from,
            to: request.to.unwrap_or(length).clamp(from, length),
            error: None,
        };
        let place = Seat::take(hub, room, &source_of(&status.file), Hold { takeover: request.takeover || replaces, resume: None })?;
        let (requests, inbox) = sync_channel(MOST_WAITING);
        let shared = Arc::new(Mutex::new(status.clone()));
        let handle = Handle { requests, status: shared.clone() };
        let hub = hub.clone();
        let run = move || {
            let mut player = Player::new(&hub, Faces::new(recording), place, status, most_standing);
            let ended = player.run(&inbox, &shared);
            let mut status = lock(&shared);
            status.playing = false;
            status.error = Some(ended.map_or_else(|error| error.to_string(), |why| why.to_owned()));
            drop(status);
            drop(player);
        };
        let thread = std::thread::Builder::new().name("player".into()).spawn(run);
        thread.map_err(|error| PlayError::Thread(error.to_string()))?;
        let told = lock(&handle.status).clone();
        by_room.insert(room.clone(), handle);
        Ok(told)
    }

    /// How the player of `room` stands.
    pub fn status(&self, room: &RoomName) -> Option<PlayStatus> {
        lock(&self.by_room).get(room).map(|handle| lock(&handle.status).clone())
    }

    /// Ends the player of `room`.
    pub fn stop(&self, room: &RoomName) -> Option<PlayStatus> {
        lock(&self.by_room).remove(room).map(|handle| lock(&handle.status).clone())
    }
}

/// What a player of `file` calls itself in its room.
fn source_of(file: &str) -> String {
    format!("replay of {file}")
}

/// The recording called `name` in `dir`: a plain name, so that nothing outside can be meant.
fn path_of(dir: Option<&Path>, name: &str) -> Result<PathBuf, PlayError> {
    let dir = dir.ok_or(PlayError::NoFolder)?;
    let is_plain = name.len() <= 255
        && name.ends_with(".mcap")
        && !name.starts_with('.')
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'_'));
    let path = dir.join(name);
    if is_plain && path.is_file() { Ok(path) } else { Err(PlayError::no_file(name)) }
}

/// The player's place in its room, for one session.
struct Seat {
    place: Publishing,
    evicted: Evicted,
}

/// Whose place a player takes.
#[derive(Debug, Default)]
struct Hold {
    /// Anybody's.
    takeover: bool,
    /// That of this session, its own before.
    resume: Option<Resume>,
}

impl Seat {
    fn take(hub: &Hub, room: &RoomName, source: &str, hold: Hold) -> Result<Self, RoomError> {
        let claim =
            SlotClaim { source: source.to_owned(), takeover: hold.takeover, resume: hold.resume, is_replay: true, ..SlotClaim::default() };
        let recorded = |session| {
            let (slot, source) = (claim.slot.name.clone(), claim.source.clone());
            // Its packets are recorded, and no messages that they could be solved from.
            vec![Item::Event(SessionEvent::Start {
                session,
                slot,
                source,
                under_way: true,
                kept_neutral: None,
                profile: None,
                solve: None,
            })]
        };
        // Nobody commands it as they would a tracker.
        let (place, evicted) = hub.rooms.claim(room, claim.clone(), tokio::sync::mpsc::channel(1).0, recorded)?;
        Ok(Self { place, evicted })
    }
}

struct Player<'a> {
    hub: &'a Hub,
    room: RoomName,
    source: String,
    faces: Faces,
    seat: Seat,
    has_lost_room: bool,
    num_frames: u32,
    status: PlayStatus,
    /// The next face's time; it stands in the reader.
    next: Option<Moment>,
    /// The face that is shown.
    shown: rhytid_shared::FaceFrame,
    /// A place in the recording, seconds, and when it was there.
    anchor: (f64, Instant),
    /// When the session began, and its last time, µs.
    begun: Instant,
    last_micros: Option<u64>,
    /// How long it may stand still, and since when it does, or was last told something.
    most_standing: Option<Duration>,
    stands_since: Instant,
}

impl<'a> Player<'a> {
    fn new(hub: &'a Hub, faces: Faces, seat: Seat, status: PlayStatus, most_standing: Option<Duration>) -> Self {
        let now = Instant::now();
        Self {
            hub,
            room: seat.place.room.name.clone(),
            source: source_of(&status.file),
            shown: faces.frame().clone(),
            faces,
            seat,
            has_lost_room: false,
            num_frames: 0,
            next: None,
            anchor: (status.position, now),
            status,
            begun: now,
            last_micros: None,
            most_standing,
            stands_since: now,
        }
    }

    /// Plays until it is told to end, another publisher takes the room, or the service ends; says which.
    fn run(&mut self, inbox: &Receiver<PlayRequest>, shared: &Mutex<PlayStatus>) -> Result<&'static str, ReadError> {
        self.go_to(self.status.position)?;
        loop {
            let mut due = self.due();
            if self.status.speed.is_infinite() && self.status.playing {
                due = Some(Instant::now());
            }
            let wait =
                due.map_or(HOLD, |due| due.saturating_duration_since(Instant::now())).min(if self.status.playing { LOOK } else { HOLD });
            match inbox.recv_timeout(wait) {
                Ok(request) => {
                    self.stands_since = Instant::now();
                    self.obey(&request)?;
                }
                Err(RecvTimeoutError::Disconnected) => return Ok("ended"),
                Err(RecvTimeoutError::Timeout) => {}
            }
            if *self.hub.shutdown.borrow() {
                return Ok("the server is shutting down");
            }
            if self.is_evicted() {
                return Ok("another publisher has taken the room over");
            }
            if self.status.playing {
                self.stands_since = Instant::now();
            } else if self.most_standing.is_some_and(|most| self.stands_since.elapsed() >= most) {
                return Ok("it has stood still for too long");
            }
            if self.status.playing {
                self.play()?;
            } else {
                self.send(Instant::now());
            }
            *lock(shared) = self.status.clone();
        }
    }

    /// When the next face is due.
    fn due(&self) -> Option<Instant> {
        let next = self.next.filter(|_| self.status.playing)?;
        let ahead = (next.smooth - self.anchor.0).max(0.0) / self.status.speed;
        Some(self.anchor.1 + Duration::from_secs_f64(ahead.min(1e6)))
    }

    /// Sends the faces that are due.
    fn play(&mut self) -> Result<(), ReadError> {
        for _ in 0..BURST {
            let now = Instant::now();
            self.status.position = if self.status.speed.is_finite() {
                self.anchor.0 + (now - self.anchor.1).as_secs_f64() * self.status.speed
            } else {
                self.next.map_or(self.status.position, |next| next.smooth)
            };
            let is_over = self.next.is_none_or(|next| next.smooth > self.status.to) && {
                // What follows the last face belongs to the recording, too.
                self.status.speed.is_infinite() || self.status.position >= self.status.to || self.next.is_none()
            };
            if is_over {
                if self.status.repeats && self.status.to > self.status.from {
                    self.renew();
                    return self.go_to(self.status.from);
                }
                (self.status.playing, self.status.position) = (false, self.status.to);
                return Ok(());
            }
            let due = if self.status.speed.is_infinite() { Some(now) } else { self.due().filter(|due| *due <= now) };
            let (Some(next), Some(due)) = (self.next, due) else { return Ok(()) };
            self.shown.clone_from(self.faces.frame());
            self.send(due);
            self.status.position = self.status.position.max(next.smooth);
            self.next = self.faces.advance()?;
        }
        Ok(())
    }

    fn obey(&mut self, request: &PlayRequest) -> Result<(), ReadError> {
        let now = Instant::now();
        // From here on by the new speed.
        self.anchor = (self.status.position, now);
        let seconds = self.status.seconds;
        self.status.from = request.from.map_or(self.status.from, |from| from.min(seconds));
        self.status.to = request.to.unwrap_or(self.status.to).clamp(self.status.from, seconds);
        self.status.speed = request.speed.unwrap_or(self.status.speed);
        self.status.repeats = request.repeats.unwrap_or(self.status.repeats);
        let starts = request.playing == Some(true) && !self.status.playing;
        self.status.playing = request.playing.unwrap_or(self.status.playing);
        let is_at_end = starts && request.position.is_none() && self.status.position >= self.status.to;
        if let Some(position) = request.position.or(is_at_end.then_some(self.status.from)) {
            self.renew();
            self.go_to(position.min(seconds))?;
        }
        Ok(())
    }

    /// Begins a session anew, unless another publisher has the room.
    fn renew(&mut self) {
        if self.is_evicted() {
            return;
        }
        let place = &self.seat.place;
        let resume = Some(Resume { session: place.session, key: Some(place.key.to_string()) });
        match Seat::take(self.hub, &self.room, &self.source, Hold { resume, ..Hold::default() }) {
            Ok(seat) => {
                self.seat = seat;
                self.num_frames = 0;
                (self.begun, self.last_micros) = (Instant::now(), None);
            }
            // Taken in this moment.
            Err(_) => self.has_lost_room = true,
        }
    }

    /// True once another publisher has the room. A place is told of that once, so it is kept in mind.
    fn is_evicted(&mut self) -> bool {
        self.has_lost_room |= self.seat.evicted.try_recv().is_ok();
        self.has_lost_room
    }

    /// Shows the face at `position`, seconds, and goes on from there.
    fn go_to(&mut self, position: f64) -> Result<(), ReadError> {
        if self.faces.seek(position)?.is_some() {
            self.shown.clone_from(self.faces.frame());
            self.send(Instant::now());
            self.next = self.faces.advance()?;
        } else {
            self.next = None;
        }
        self.status.position = position;
        self.anchor = (position, Instant::now());
        Ok(())
    }

    /// Sends the face that is shown as of `at`: when it was due, not when this thread woke.
    fn send(&mut self, at: Instant) {
        let now = at.saturating_duration_since(self.begun).as_micros() as u64;
        // Two faces of one time would be one.
        let micros = self.last_micros.map_or(now, |last| now.max(last + 1));
        self.last_micros = Some(micros);
        self.shown.session = self.seat.place.session;
        self.shown.seq = self.num_frames;
        self.shown.captured_at_micros = micros;
        self.num_frames = self.num_frames.wrapping_add(1);
        // An eviction is noticed by the loop.
        self.seat.place.publish(&self.shown, None);
    }
}
