//! The window's remote control of a room that plays a recording: asks the server over HTTP how its player stands, and tells it what
//! to do. On a thread of its own; the window only looks and leaves word.

use crate::link::{ServerAddress, agent};
use rhytid_shared::RoomName;
use rhytid_shared::trust::Trust;
use serde::{Deserialize, Serialize};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// How often the server is asked: while something plays or is recorded, and while nothing is.
const BUSY: Duration = Duration::from_millis(500);
const QUIET: Duration = Duration::from_secs(3);
/// Least time between two requests: as fast as a slider is dragged.
const PACE: Duration = Duration::from_millis(60);
/// How long an answer may take.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Largest answer, bytes; usual ones have 400.
const MAX_ANSWER: u64 = 64 << 10;

/// How a room's player stands.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub(crate) struct Replay {
    /// Name of the recording.
    pub(crate) file: String,
    /// Seconds since the recording began.
    pub(crate) position: f64,
    /// Whether it moves.
    pub(crate) playing: bool,
    /// Seconds of the recording a second; nothing where it goes as fast as it can.
    pub(crate) speed: Option<f64>,
    /// Begins again at the end.
    #[serde(rename = "loop")]
    pub(crate) repeats: bool,
    /// Where it begins and ends, seconds.
    pub(crate) from: f64,
    pub(crate) to: f64,
    /// Why it has ended, where it has.
    #[serde(default)]
    error: Option<String>,
}

impl Replay {
    /// Where it stands `elapsed` after it was asked: it goes on meanwhile.
    pub(crate) fn place(&self, elapsed: Duration) -> f64 {
        let moved = self.position + if self.playing { elapsed.as_secs_f64() * self.speed.unwrap_or(0.0) } else { 0.0 };
        if moved <= self.to || !self.repeats || self.to <= self.from {
            return moved.min(self.to);
        }
        self.from + (moved - self.from) % (self.to - self.from)
    }
}

/// A recording being made of the room.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub(crate) struct Take {
    pub(crate) seconds: f64,
    pub(crate) bytes: u64,
    /// Why it has ended, where it has.
    #[serde(default)]
    pub(crate) error: Option<String>,
}

/// What a player shall do; what is not said stays as it is.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub(crate) struct Ask {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) position: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) playing: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) speed: Option<f64>,
    #[serde(rename = "loop", skip_serializing_if = "Option::is_none")]
    pub(crate) repeats: Option<bool>,
}

impl Ask {
    /// What `later` says counts before what was said.
    fn change(&mut self, later: &Self) {
        self.position = later.position.or(self.position);
        self.playing = later.playing.or(self.playing);
        self.speed = later.speed.or(self.speed);
        self.repeats = later.repeats.or(self.repeats);
    }
}

/// Word left for the thread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Word {
    /// To the player.
    Ask(Ask),
    /// Begin or end a recording of the room.
    Record(bool),
}

/// What is known of the room.
#[derive(Debug, Clone, Default)]
pub(crate) struct Known {
    /// Its player, and when it stood so.
    pub(crate) replay: Option<(Replay, Instant)>,
    /// Its recording.
    pub(crate) take: Option<Take>,
    /// The server keeps recordings, and whoever watches may make some.
    pub(crate) is_enabled: bool,
    /// Why the last word was not obeyed.
    pub(crate) problem: Option<String>,
}

/// The remote control of one room; dropped, its thread ends.
#[derive(Debug)]
pub(crate) struct Remote {
    words: Sender<Word>,
    known: Arc<Mutex<Known>>,
}

/// What stands under this lock is whole at each step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Remote {
    /// Watches over `room`; `wake` is called on the thread when something has changed. `token` goes only where nobody else reads it.
    pub(crate) fn open(
        server: &ServerAddress,
        room: &RoomName,
        trust: &Trust,
        token: Option<String>,
        wake: impl Fn() + Send + 'static,
    ) -> Self {
        let (words, inbox) = channel();
        let known = Arc::<Mutex<Known>>::default();
        let shared = Arc::clone(&known);
        let bearer = token.filter(|_| server.may_carry_secrets()).map(|token| format!("Bearer {token}"));
        let line = Line { agent: agent(trust, TIMEOUT), base: server.http_url(&format!("/api/rooms/{room}")), bearer };
        let thread = std::thread::Builder::new().name("remote".into());
        if let Err(error) = thread.spawn(move || line.run(&inbox, &shared, &wake)) {
            tracing::warn!(%error, "no thread for the remote control");
        }
        Self { words, known }
    }

    /// What is known by now.
    pub(crate) fn known(&self) -> Known {
        lock(&self.known).clone()
    }

    /// Leaves word.
    pub(crate) fn say(&self, word: Word) {
        // Without a thread there is nobody to obey, which has been said.
        let _ = self.words.send(word);
    }
}

#[derive(Debug, Deserialize)]
struct Answer {
    #[serde(default)]
    replay: Option<Replay>,
    #[serde(default)]
    recording: Option<Take>,
    #[serde(default)]
    enabled: bool,
    /// Servers of before say nothing of it, and whoever watches may.
    #[serde(default = "yes")]
    control: bool,
}

fn yes() -> bool {
    true
}

/// The way to the server.
struct Line {
    agent: ureq::Agent,
    /// Address of the room.
    base: String,
    /// What lets it in, where the server wants to know.
    bearer: Option<String>,
}

impl Line {
    fn run(&self, inbox: &Receiver<Word>, known: &Mutex<Known>, wake: &dyn Fn()) {
        loop {
            let asked_at = Instant::now();
            let is_busy = self.look(known, wake);
            let due = asked_at + if is_busy { BUSY } else { QUIET };
            match inbox.recv_timeout(due.saturating_duration_since(Instant::now())) {
                Ok(word) => self.obey(word, inbox, known, wake),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// Asks how things stand; true where they change by themselves.
    fn look(&self, known: &Mutex<Known>, wake: &dyn Fn()) -> bool {
        let request = self.with_token(self.agent.get(format!("{}/replay", self.base)));
        let answer = request.config().http_status_as_error(false).build().call();
        let Ok(answer) = read(answer) else {
            // Servers of before know nothing of this, and one that is away is spoken of elsewhere.
            return false;
        };
        let mut known = lock(known);
        let was_shown = known.replay.is_some() || known.is_enabled;
        known.take_over(answer);
        let is_busy = known.replay.is_some() || known.take.as_ref().is_some_and(|take| take.error.is_none());
        let is_shown = known.replay.is_some() || known.is_enabled;
        drop(known);
        if was_shown || is_shown {
            wake();
        }
        is_busy
    }

    /// A refusal is an answer, too.
    fn post(&self, path: &str) -> ureq::RequestBuilder<ureq::typestate::WithBody> {
        self.with_token(self.agent.post(format!("{}{path}", self.base))).config().http_status_as_error(false).build()
    }

    fn with_token<Body>(&self, request: ureq::RequestBuilder<Body>) -> ureq::RequestBuilder<Body> {
        match &self.bearer {
            Some(bearer) => request.header("Authorization", bearer),
            None => request,
        }
    }

    /// Does what `word` says, and whatever has been said since: of a slider that is dragged the newest place counts.
    fn obey(&self, word: Word, inbox: &Receiver<Word>, known: &Mutex<Known>, wake: &dyn Fn()) {
        let begun_at = Instant::now();
        let (mut ask, mut record) = (None::<Ask>, None);
        for word in std::iter::once(word).chain(inbox.try_iter()) {
            match word {
                Word::Ask(later) => ask.get_or_insert_default().change(&later),
                Word::Record(is_wanted) => record = Some(is_wanted),
            }
        }
        let mut problem = None;
        if let Some(is_wanted) = record {
            let action = if is_wanted { "start" } else { "stop" };
            problem = read(self.post(&format!("/record/{action}")).send_empty()).err();
        }
        if let Some(ask) = ask {
            let body = serde_json::to_vec(&ask).expect("plain data can be written");
            match read(self.post("/replay").send(&body[..])) {
                Ok(answer) => lock(known).replay = answer.replay.map(|replay| (replay, Instant::now())),
                Err(error) => problem = Some(error),
            }
        }
        lock(known).problem = problem;
        wake();
        std::thread::sleep(PACE.saturating_sub(begun_at.elapsed()));
    }
}

impl Known {
    fn take_over(&mut self, answer: Answer) {
        let now = Instant::now();
        self.replay = answer.replay.filter(|replay| replay.error.is_none()).map(|replay| (replay, now));
        self.take = answer.recording;
        self.is_enabled = answer.enabled && answer.control;
    }
}

/// The server's answer, or in its own words why there is none.
fn read(answer: Result<ureq::http::Response<ureq::Body>, ureq::Error>) -> Result<Answer, String> {
    #[derive(Deserialize)]
    struct Refusal {
        message: String,
    }
    let mut answer = answer.map_err(|error| error.to_string())?;
    let body = answer.body_mut().with_config().limit(MAX_ANSWER).read_to_vec().map_err(|error| error.to_string())?;
    if !answer.status().is_success() {
        let said = serde_json::from_slice(&body).map(|Refusal { message }| message);
        return Err(said.unwrap_or_else(|_| format!("the server answers {}", answer.status())));
    }
    serde_json::from_slice(&body).map_err(|error| format!("the server's answer is none: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn replay() -> Replay {
        let text = r#"{"file":"a.mcap","position":8,"seconds":12,"playing":true,"speed":2,"loop":false,"from":1,"to":10}"#;
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn a_player_goes_on_between_two_looks() {
        let after = |replay: &Replay, millis| replay.place(Duration::from_millis(millis));
        let playing = replay();
        assert_eq!((after(&playing, 500), after(&playing, 4000)), (9.0, 10.0));
        assert_eq!(after(&Replay { playing: false, ..replay() }, 500), 8.0);
        assert_eq!(after(&Replay { repeats: true, ..replay() }, 4000), 7.0);
        assert_eq!(after(&Replay { speed: None, ..replay() }, 4000), 8.0, "nobody knows how fast it goes");
    }

    #[test]
    fn of_several_words_the_newest_counts() {
        let mut ask = Ask { position: Some(1.0), playing: Some(false), ..Ask::default() };
        ask.change(&Ask { position: Some(2.0), speed: Some(0.5), ..Ask::default() });
        assert_eq!(serde_json::to_string(&ask).unwrap(), r#"{"position":2.0,"playing":false,"speed":0.5}"#);
    }

    #[cfg(feature = "embedded")]
    #[test]
    fn a_player_on_a_real_server_obeys() {
        use rhytid_server::pipeline::Pipeline;
        use rhytid_server::recording::{PlayRequest, RecordConfig, RecordingWriter, SessionEvent};
        use rhytid_server::{Play, ServerConfig, bind, load_character, run};
        use rhytid_shared::packet::PacketLayout;
        use rhytid_shared::view::ViewHello;

        let folder = std::env::temp_dir().join(format!("rhytid-remote-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("take.mcap");
        let (character, glb) = load_character(None).unwrap();
        let mut feed =
            rhytid_server::feed::Feed::new(&include_bytes!("../../shared/assets/demo.ibug68.jsonl")[..], "demo".into(), &character)
                .unwrap();
        let mut pipeline = Pipeline::new(character.clone(), &rhytid_server::solve::SolveConfig::default(), &feed.hello, 1).unwrap();
        let mut writer = RecordingWriter::to(std::fs::File::create(&file).unwrap(), PacketLayout::from(&*character)).unwrap();
        let hello = Box::new(ViewHello::new("demo", &character, String::new()).character);
        let begin = SessionEvent::Recording { version: 1, room: "demo".into(), server: "test".into(), character: hello, clock: 0 };
        writer.event(0, &begin).unwrap();
        let (mut frame, mut packet) = (rhytid_shared::TrackingFrame::default(), Vec::new());
        while feed.next_frame(&mut frame).unwrap().is_some() {
            pipeline.frame(&frame, &mut packet).unwrap();
            writer.packet((frame.t * 1e9) as u64, packet.clone().into());
        }
        writer.finish().unwrap();

        let room = RoomName::new("stage").unwrap();
        let play = Play { file, room: room.clone(), request: PlayRequest::default() };
        let record = RecordConfig { dir: Some(folder.clone()), rooms: vec!["none".into()], ..RecordConfig::default() };
        let config = ServerConfig { listen: "127.0.0.1:0".into(), play: Some(play), record, ..ServerConfig::default() };
        let (stop, stopped) = channel::<()>();
        let (bound, address) = channel();
        let server = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
            runtime.block_on(async {
                let listener = bind(&config.listen).await.unwrap();
                bound.send(listener.local_addr().unwrap()).unwrap();
                let stopped = tokio::task::spawn_blocking(move || stopped.recv());
                run(listener, config, (character, glb), None, async move { drop(stopped.await) }).await.unwrap();
            });
        });
        let address: ServerAddress = format!("ws://{}", address.recv().unwrap()).parse().unwrap();
        let remote = Remote::open(&address, &room, &Trust::Public, None, || ());
        let wait_for = |what: &str, is_so: &dyn Fn(&Known) -> bool| {
            let start = Instant::now();
            while !is_so(&remote.known()) {
                assert!(start.elapsed() < Duration::from_secs(10), "waited for {what}: {:?}", remote.known());
                std::thread::sleep(Duration::from_millis(20));
            }
        };
        let is_at = |known: &Known, place: f64| known.replay.as_ref().is_some_and(|(replay, _)| (replay.position - place).abs() < 1e-6);
        wait_for("the player", &|known| known.replay.as_ref().is_some_and(|(replay, _)| replay.playing) && known.is_enabled);
        // A slider that is dragged: all of it in a moment, the last place is where it stands.
        for place in 0..20 {
            remote.say(Word::Ask(Ask { position: Some(f64::from(place) * 0.5), playing: Some(false), ..Ask::default() }));
        }
        wait_for("the last place", &|known| is_at(known, 9.5));
        remote.say(Word::Ask(Ask { speed: Some(0.25), repeats: Some(true), ..Ask::default() }));
        wait_for("the speed", &|known| known.replay.as_ref().is_some_and(|(replay, _)| replay.speed == Some(0.25) && replay.repeats));
        remote.say(Word::Record(true));
        wait_for("a recording", &|known| known.take.is_some());
        remote.say(Word::Record(false));
        wait_for("its end", &|known| known.take.is_none());
        remote.say(Word::Ask(Ask { speed: Some(-1.0), ..Ask::default() }));
        wait_for("a refusal in words", &|known| known.problem.as_ref().is_some_and(|problem| problem.contains("field speed is -1")));
        drop(remote);
        drop(stop);
        server.join().unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
