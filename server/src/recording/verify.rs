//! Solving a recording again: the same messages must give the same packets to the byte.

use super::format::{Entry, SessionEvent, Topic};
use super::reader::{ReadError, Recording};
use crate::pipeline::Pipeline;
use crate::room::mixer_time;
use crate::solve::mix::Mixer;
use crate::solve::{Calibration, SolveConfig};
use rhytid_shared::packet::{BatchReader, Decoder, Encoder};
use rhytid_shared::view::CharacterHello;
use rhytid_shared::{ARKIT_NAMES, Character, Command, FaceFrame, Profile, ProfileChoice, PublishMessage, PublishReader, TrackingFrame};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::sync::Arc;

/// Frames solved ahead of their packets: packets stand a second behind at most, and a server may take 1,000,000 messages a second.
const MAX_AHEAD: usize = 1_000_000;

/// Why a recording does not verify.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// The file could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// It is of another character.
    #[error("the recording is of character {recorded:?} (SHA-256 {recorded_sha256}), this one is {given:?} ({given_sha256})")]
    Character {
        /// Its name in the recording.
        recorded: String,
        /// SHA-256 of its file, hex.
        recorded_sha256: String,
        /// Name of the one given.
        given: String,
        /// SHA-256 of its file, hex.
        given_sha256: String,
    },
    /// The first packet that came out otherwise.
    #[error("{0}")]
    Different(Box<Difference>),
    /// A packet without its message, or a message without its packet.
    #[error("session {session}, frame {seq}: {problem}")]
    Unmatched {
        /// The session.
        session: u32,
        /// The frame in it.
        seq: u32,
        /// What is missing.
        problem: &'static str,
    },
    /// A message that was taken is refused now.
    #[error("session {session}, at {seconds:.3} s of the recording: a message that was taken is refused now: {problem}")]
    Refused {
        /// The session.
        session: u32,
        /// Since the recording began.
        seconds: f64,
        /// Why.
        problem: String,
    },
    /// Messages are missing, so that it cannot be solved again from there on.
    #[error(
        "at {seconds:.3} s of the recording {messages} messages are missing (the disk was too slow): {frames} frames before that are the same"
    )]
    Gap {
        /// Since the recording began.
        seconds: f64,
        /// How many.
        messages: u64,
        /// Frames that were compared.
        frames: u64,
    },
    /// There is nothing to compare.
    #[error("nothing in it can be solved again: {0}")]
    Nothing(&'static str),
}

/// The first value in which a solved packet is not the recorded one.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// The session.
    pub session: u32,
    /// The frame in it, from 0.
    pub seq: u32,
    /// The sender's time, seconds.
    pub t: f64,
    /// Bone, coefficient or other field.
    pub what: String,
    /// Its value in the recording, and solved again.
    pub recorded: String,
    /// See `recorded`.
    pub solved: String,
    /// Values of the frame that differ.
    pub num_values: usize,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { session, seq, t, what, recorded, solved, num_values } = self;
        write!(f, "first difference at t = {t:.6} s (session {session}, frame {seq}): {what} was {recorded}, is {solved}")?;
        if *num_values > 1 { write!(f, "; {num_values} values of this frame differ") } else { Ok(()) }
    }
}

/// What was compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct VerifyReport {
    /// Sessions solved again.
    pub sessions: u32,
    /// Frames that gave the recorded bytes.
    pub frames: u64,
    /// Packets of sessions that had begun before the recording, or that play one.
    pub not_compared: u64,
    /// Frames at the end whose packets are not there: the recording was cut.
    pub cut: u64,
}

/// Solves `recording` again with `character` and compares every packet.
pub fn verify(recording: &mut Recording, character: &Arc<Character>) -> Result<VerifyReport, VerifyError> {
    let recorded = recording.character();
    if recorded.sha256 != character.sha256 {
        return Err(VerifyError::Character {
            recorded: recorded.name.clone(),
            recorded_sha256: recorded.sha256.clone(),
            given: character.name.clone(),
            given_sha256: character.sha256.clone(),
        });
    }
    let mut run = Run {
        names: recorded.clone(),
        start: recording.start(),
        character,
        slots: BTreeMap::new(),
        merging: Merging::new(character),
        blind: BTreeSet::new(),
        first: None,
        solved: VecDeque::new(),
        batches: BatchReader::new(recording.layout().clone()),
        recorded_stream: Stream::new(character),
        solved_stream: Stream::new(character),
        report: VerifyReport::default(),
        frame: TrackingFrame::default(),
    };
    let is_cut = recording.cut_off().is_some();
    for index in 0..recording.chunks().len() {
        for entry in recording.read_chunk(index)? {
            run.take(recording, &entry)?;
        }
    }
    run.end(is_cut)
}

/// A session being solved again.
struct Solving {
    session: u32,
    config: Box<SolveConfig>,
    kept: Option<Box<Calibration>>,
    /// The profile that the hello, and later that the next command, names.
    profile: Option<Box<Profile>>,
    reader: PublishReader,
    /// Once its hello has been read.
    pipeline: Option<Pipeline>,
}

/// What a room does with the faces of its sources.
struct Merging {
    mixer: Mixer,
    last_session: u32,
    encoder: Encoder,
    encoded_session: u32,
}

impl Merging {
    /// As a room is before its first source, or after the last one has left.
    fn new(character: &Arc<Character>) -> Self {
        Self { mixer: Mixer::new(character.clone()), last_session: 0, encoder: Encoder::new(&**character), encoded_session: 0 }
    }
}

struct Run<'a> {
    names: CharacterHello,
    start: u64,
    character: &'a Arc<Character>,
    /// By slot.
    slots: BTreeMap<String, Solving>,
    merging: Merging,
    /// Sessions that are there and cannot be solved again, or are merged with such; while there are any, nothing is solved.
    blind: BTreeSet<u32>,
    /// Packets of sessions before this one went out while nothing could be solved.
    first: Option<u32>,
    /// Packets that were solved and not compared yet.
    solved: VecDeque<Vec<u8>>,
    batches: BatchReader,
    recorded_stream: Stream,
    solved_stream: Stream,
    report: VerifyReport,
    frame: TrackingFrame,
}

impl Run<'_> {
    fn take(&mut self, recording: &Recording, entry: &Entry) -> Result<(), VerifyError> {
        match &entry.topic {
            Topic::Session => self.event(recording, entry),
            Topic::Text(slot) | Topic::Binary(slot) | Topic::Control(slot) => self.message(recording, slot, entry),
            Topic::Packets => {
                let mut packets = Vec::new();
                let read = self.batches.unpack(&entry.data, |_, packet| packets.push(packet.to_vec()));
                read.map_err(|error| recording.broken_batch(entry.log_time, &error))?;
                packets.iter().try_for_each(|packet| self.compare(packet))
            }
            Topic::Refused(_) => Ok(()),
        }
    }

    fn event(&mut self, recording: &Recording, entry: &Entry) -> Result<(), VerifyError> {
        let event = serde_json::from_slice(&entry.data).map_err(|error| recording.broken(format!("a session event: {error}")))?;
        match event {
            SessionEvent::Start { session, slot, under_way: false, kept_neutral, profile, solve: Some(config), .. }
                if self.blind.is_empty() =>
            {
                let reader = PublishReader::new(self.character);
                if self.slots.is_empty() {
                    self.first.get_or_insert(session);
                }
                self.merging.last_session = session;
                let solving = Solving { session, config, kept: kept_neutral, profile, reader, pipeline: None };
                if let Some(before) = self.slots.insert(slot, solving) {
                    // Its end should have been said.
                    self.merging.mixer.leave(before.session);
                }
            }
            SessionEvent::Start { session, .. } => {
                let others = std::mem::take(&mut self.slots);
                self.blind.extend(others.into_values().map(|solving| solving.session));
                self.blind.insert(session);
            }
            SessionEvent::End { session, .. } => {
                if self.blind.remove(&session) {
                    if self.blind.is_empty() {
                        // The next source finds the room as new.
                        (self.merging, self.first) = (Merging::new(self.character), None);
                    }
                } else {
                    self.slots.retain(|_, solving| solving.session != session);
                    self.merging.mixer.leave(session);
                }
            }
            SessionEvent::Profile { session, profile } => {
                if let Some(solving) = self.slots.values_mut().find(|solving| solving.session == session) {
                    solving.profile = Some(profile);
                }
            }
            SessionEvent::Gap { messages } => {
                let (seconds, frames) = (self.seconds(entry), self.report.frames);
                return Err(VerifyError::Gap { seconds, messages, frames });
            }
            _ => {}
        }
        Ok(())
    }

    fn seconds(&self, entry: &Entry) -> f64 {
        entry.log_time.saturating_sub(self.start) as f64 / 1e9
    }

    fn message(&mut self, recording: &Recording, slot: &str, entry: &Entry) -> Result<(), VerifyError> {
        let seconds = self.seconds(entry);
        let Some(solving) = self.slots.get_mut(slot) else { return Ok(()) };
        let session = solving.session;
        let refused = |problem: String| VerifyError::Refused { session, seconds, problem };
        let text = || std::str::from_utf8(&entry.data).map_err(|error| refused(error.to_string()));
        let is_control = matches!(entry.topic, Topic::Control(_));
        let read = match &entry.topic {
            Topic::Binary(_) => solving.reader.read_binary(&entry.data, &mut self.frame),
            Topic::Control(_) => PublishReader::read_command(text()?).map(PublishMessage::Command),
            _ => solving.reader.read(text()?, &mut self.frame),
        };
        let message = read.map_err(|error| refused(error.message))?;
        let Some(pipeline) = &mut solving.pipeline else {
            let PublishMessage::Hello(mut hello) = message else { return Err(refused("expected a hello first".into())) };
            hello.profile = solving.profile.take().map(ProfileChoice::Given);
            let character = self.character.clone();
            let pipeline = match solving.kept.take() {
                Some(kept) => Pipeline::with_calibration(character, &solving.config, &hello, session, *kept),
                None => Pipeline::new(character, &solving.config, &hello, session),
            };
            solving.pipeline = Some(pipeline.map_err(|error| refused(error.to_string()))?);
            self.merging.mixer.enter(session, &hello.slot);
            self.report.sessions += 1;
            return Ok(());
        };
        match message {
            PublishMessage::Frame => {
                pipeline.solve(&self.frame).map_err(|error| refused(error.to_string()))?;
                let Merging { mixer, last_session, encoder, encoded_session } = &mut self.merging;
                let now = mixer_time(recording.room_nanos(entry.log_time));
                news(pipeline);
                let Some(merged) = mixer.take(session, pipeline.face(), now, last_session) else { return Ok(()) };
                if merged.session != *encoded_session {
                    *encoder = Encoder::new(&**self.character);
                    *encoded_session = merged.session;
                }
                let mut packet = Vec::new();
                encoder.encode(merged, &mut packet);
                if self.solved.len() >= MAX_AHEAD {
                    let (session, seq) = (merged.session, merged.seq);
                    return Err(VerifyError::Unmatched { session, seq, problem: "no packets follow the messages" });
                }
                self.solved.push_back(packet);
            }
            PublishMessage::Command(mut command) => {
                if let Command::Profile(choice @ ProfileChoice::Named(_)) = &mut command {
                    let profile = solving.profile.take().ok_or_else(|| refused("the profile that it names is not there".into()))?;
                    *choice = ProfileChoice::Given(profile);
                }
                pipeline.command(&command).map_err(|error| refused(error.to_string()))?;
                if !is_control {
                    news(pipeline);
                }
            }
            PublishMessage::Hello(_) => return Err(refused("expected one hello".into())),
        }
        Ok(())
    }

    fn compare(&mut self, recorded: &[u8]) -> Result<(), VerifyError> {
        let was = self.recorded_stream.take(recorded);
        let (session, seq) = was.map_or((0, 0), |frame| (frame.session, frame.seq));
        let is_expected = was.is_some() && self.blind.is_empty() && self.first.is_some_and(|first| session >= first);
        let Some(solved) = self.solved.pop_front() else {
            if is_expected {
                return Err(VerifyError::Unmatched { session, seq, problem: "a packet went out that no message gives" });
            }
            // From a time that cannot be solved again; the first of those may not even be read.
            self.report.not_compared += 1;
            return Ok(());
        };
        let is = self.solved_stream.take(&solved).expect("a packet just written can be read");
        if solved == recorded {
            self.report.frames += 1;
            return Ok(());
        }
        let Some(was) = was else {
            return Err(VerifyError::Unmatched { session: is.session, seq: is.seq, problem: "its packet cannot be read" });
        };
        if self.first.is_some_and(|first| was.session < first) {
            // What still went out from before.
            self.solved.push_front(solved);
            self.report.not_compared += 1;
            return Ok(());
        }
        Err(VerifyError::Different(Box::new(difference(was, is, &self.names))))
    }

    fn end(mut self, is_cut: bool) -> Result<VerifyReport, VerifyError> {
        self.report.cut = self.solved.len() as u64;
        let is_over = self.slots.is_empty() && self.blind.is_empty();
        if !is_cut
            && is_over
            && let Some(packet) = self.solved.front()
        {
            let (session, seq) = self.solved_stream.take(packet).map_or((0, 0), |frame| (frame.session, frame.seq));
            return Err(VerifyError::Unmatched { session, seq, problem: "a message gives a packet that did not go out" });
        }
        match self.report {
            VerifyReport { frames: 0, not_compared: 0, .. } => Err(VerifyError::Nothing("it has no packets")),
            VerifyReport { frames: 0, .. } => {
                Err(VerifyError::Nothing("it has no publisher's messages from their beginning (a viewer's recording has none)"))
            }
            report => Ok(report),
        }
    }
}

/// Takes what a server tells its publisher after each message: a solve remembers what has not been taken.
fn news(pipeline: &mut Pipeline) {
    pipeline.take_calibrated();
    pipeline.solver().take_fit();
}

/// Packets read one after the other.
struct Stream {
    decoder: Decoder,
    frame: FaceFrame,
}

impl Stream {
    fn new(character: &Character) -> Self {
        Self { decoder: Decoder::new(character), frame: FaceFrame::at_rest(character) }
    }

    fn take(&mut self, packet: &[u8]) -> Option<&FaceFrame> {
        self.decoder.decode(packet, &mut self.frame).ok()?;
        Some(&self.frame)
    }
}

/// The first value in which two frames differ.
fn difference(was: &FaceFrame, is: &FaceFrame, names: &CharacterHello) -> Difference {
    let mut found = Vec::new();
    let mut check = |what: &dyn Fn() -> String, was: String, is: String| {
        if was != is {
            found.push((what(), was, is));
        }
    };
    check(&|| "number of the frame".into(), was.seq.to_string(), is.seq.to_string());
    check(&|| "time of capture (µs)".into(), was.captured_at_micros.to_string(), is.captured_at_micros.to_string());
    check(&|| "face".into(), was.face.to_string(), is.face.to_string());
    let axes = ["x", "y", "z"];
    for (i, bone) in names.bones.iter().enumerate() {
        for (axis, name) in axes.iter().enumerate() {
            let what = || format!("bone {}, {name} (m)", bone.name);
            check(&what, format!("{:.6}", was.points[i][axis]), format!("{:.6}", is.points[i][axis]));
        }
        let shown = |frame: &FaceFrame| format!("{:.5?}", frame.rotations[i].to_array());
        check(&|| format!("bone {}, rotation", bone.name), shown(was), shown(is));
    }
    for (k, pose) in names.poses.iter().enumerate() {
        for (i, bone) in names.bones.iter().enumerate() {
            let at = k * names.bones.len() + i;
            let what = || format!("coefficient of pose {} at bone {}", pose.name, bone.name);
            check(&what, format!("{:.4}", was.influences[at]), format!("{:.4}", is.influences[at]));
        }
    }
    for (i, zone) in names.zones.iter().enumerate() {
        let shown = |frame: &FaceFrame| format!("{:.4}", frame.zones[i] - frame.stretched[i]);
        check(&|| format!("zone {zone}"), shown(was), shown(is));
    }
    for (i, name) in ARKIT_NAMES.iter().enumerate() {
        let shown = |frame: &FaceFrame| frame.shapes.map_or("none".into(), |shapes| format!("{:.4}", shapes[i]));
        check(&|| format!("expression weight {name}"), shown(was), shown(is));
    }
    let turned = |frame: &FaceFrame| format!("{:.5?}", frame.head.rotation.to_array());
    check(&|| "head, rotation".into(), turned(was), turned(is));
    let placed = |frame: &FaceFrame| format!("{:.5?}", frame.head.position.to_array());
    check(&|| "head, position (m)".into(), placed(was), placed(is));
    let num_values = found.len();
    let same = || ("the packet's form (key or delta), its values are the same".to_owned(), "one".to_owned(), "another".to_owned());
    let (what, recorded, solved) = found.into_iter().next().unwrap_or_else(same);
    let t = was.captured_at_micros as f64 / 1e6;
    Difference { session: was.session, seq: was.seq, t, what, recorded, solved, num_values }
}
