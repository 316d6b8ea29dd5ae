//! A recording as a feed: the messages of one of its sessions, one a line, binary ones as the text that says the same.

use super::format::{Entry, SessionEvent, Topic};
use super::reader::{ReadError, Recording};
use super::text;
use rhytid_shared::{Profile, PublishReader, TrackingFrame};
use std::collections::{BTreeMap, VecDeque};
use std::io::{self, BufRead, Read};
use std::path::Path;

/// A session of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedSession {
    /// Its place among those that were recorded from their beginning, from 0.
    pub index: usize,
    /// Its slot.
    pub slot: String,
    /// When it began, seconds since the beginning of what is asked for; 0 where it had begun before that.
    pub after: f64,
}

/// Reads the messages of one session of a recording as the lines of a feed file.
pub struct RecordedFeed {
    recording: Recording,
    slot: String,
    /// Its number in its room.
    session: u32,
    /// The profile that the hello or the next command names, which the other end may not keep.
    profile: Option<Box<Profile>>,
    /// Reads binary messages, which a feed has as text.
    reader: PublishReader,
    frame: TrackingFrame,
    chunk: usize,
    waiting: VecDeque<Vec<u8>>,
    line: Vec<u8>,
    at: usize,
    is_over: bool,
    /// Unix clock, ns.
    range: [u64; 2],
}

impl RecordedFeed {
    /// The first session of the recording at `path`.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let recording = Recording::open(path)?;
        match Self::session(recording, 0, [0.0, f64::INFINITY])? {
            Ok(feed) => Ok(feed),
            Err(recording) => Err(recording.broken("it has no publisher's messages from their beginning, so it is no feed")),
        }
    }

    /// The sessions of `recording` that were recorded from their beginning and have messages from `range[0]` to `range[1]`, seconds since
    /// the recording began.
    pub fn sessions(recording: &mut Recording, range: [f64; 2]) -> Result<Vec<RecordedSession>, ReadError> {
        let begin = recording.start();
        let range = range.map(|seconds| begin.saturating_add((seconds.clamp(0.0, 9e9) * 1e9) as u64));
        let mut sessions: Vec<RecordedSession> = Vec::new();
        // By slot, the session that its messages are of.
        let mut current: BTreeMap<String, Option<usize>> = BTreeMap::new();
        let mut has_messages = Vec::new();
        for chunk in 0..recording.chunks().len() {
            for entry in recording.read_chunk(chunk)? {
                match &entry.topic {
                    Topic::Session => {
                        let Some(SessionEvent::Start { slot, under_way, .. }) = event(&entry) else { continue };
                        current.insert(slot.clone(), (!under_way).then_some(sessions.len()));
                        if !under_way {
                            let after = entry.log_time.saturating_sub(range[0]) as f64 / 1e9;
                            sessions.push(RecordedSession { index: sessions.len(), slot, after });
                            has_messages.push(0);
                        }
                    }
                    Topic::Text(slot) | Topic::Binary(slot) => {
                        if let Some(index) = current.get(slot).copied().flatten() {
                            // Its hello is sent wherever it stands.
                            let counts = has_messages[index] == 0 || (range[0]..=range[1]).contains(&entry.log_time);
                            has_messages[index] += u32::from(counts);
                        }
                    }
                    _ => {}
                }
            }
        }
        sessions.retain(|session| has_messages[session.index] > 1);
        Ok(sessions)
    }

    /// Session `index` (from 0) of those that were recorded from their beginning: its hello and its messages from `range[0]` to
    /// `range[1]`, seconds since the recording began. Gives the recording back where there are not so many.
    pub fn session(mut recording: Recording, index: usize, range: [f64; 2]) -> Result<Result<Self, Recording>, ReadError> {
        let mut left = index;
        let nanos = |seconds: f64| recording.start().saturating_add((seconds.clamp(0.0, 9e9) * 1e9) as u64);
        let range = [nanos(range[0]), nanos(range[1])];
        for chunk in 0..recording.chunks().len() {
            let entries = recording.read_chunk(chunk)?;
            for (at, entry) in entries.iter().enumerate() {
                let Some(SessionEvent::Start { session, slot, under_way: false, profile, .. }) = event(entry) else { continue };
                if left > 0 {
                    left -= 1;
                    continue;
                }
                let (waiting, line, is_over) = (VecDeque::new(), Vec::new(), false);
                let (reader, frame) = (PublishReader::for_any_character(), TrackingFrame::default());
                let mut feed =
                    Self { recording, slot, session, profile, reader, frame, chunk: chunk + 1, waiting, line, at: 0, is_over, range };
                feed.gather(&entries[at + 1..], true);
                return Ok(Ok(feed));
            }
        }
        Ok(Err(recording))
    }

    /// Takes the session's messages among `entries`; `is_first` where its hello is still to come.
    fn gather(&mut self, entries: &[Entry], is_first: bool) {
        let mut wants_hello = is_first;
        for entry in entries {
            match &entry.topic {
                Topic::Text(slot) if *slot == self.slot => {
                    if wants_hello {
                        // Whoever reads the feed says what is wrong with it.
                        let text = std::str::from_utf8(&entry.data).unwrap_or_default();
                        let _ = self.reader.read(text, &mut self.frame);
                    }
                    if wants_hello || (self.range[0]..=self.range[1]).contains(&entry.log_time) {
                        let line = self.line_of(&entry.data);
                        self.waiting.push_back(line);
                    }
                    wants_hello = false;
                    self.is_over |= entry.log_time > self.range[1];
                }
                Topic::Binary(slot) if *slot == self.slot => {
                    let is_wanted = (self.range[0]..=self.range[1]).contains(&entry.log_time);
                    if is_wanted && self.reader.read_binary(&entry.data, &mut self.frame).is_ok() {
                        self.waiting.push_back((text::of_frame(&self.frame) + "\n").into_bytes());
                    }
                    self.is_over |= entry.log_time > self.range[1];
                }
                // What others asked for moves the face as well.
                Topic::Control(slot) if *slot == self.slot && (self.range[0]..=self.range[1]).contains(&entry.log_time) => {
                    let line = self.line_of(&entry.data);
                    self.waiting.push_back(line);
                }
                Topic::Session => match event(entry) {
                    // Other sessions' are for messages of theirs.
                    Some(SessionEvent::Profile { session, profile }) if session == self.session => self.profile = Some(profile),
                    // The next session of this slot.
                    Some(SessionEvent::Start { slot, .. }) if slot == self.slot => self.is_over = true,
                    _ => {}
                },
                _ => {}
            }
            if self.is_over {
                return;
            }
        }
    }
}

impl RecordedFeed {
    /// A message as a line, with the profile that it names in place of its name.
    fn line_of(&mut self, message: &[u8]) -> Vec<u8> {
        let mut line: Vec<u8> = match self.profile.take() {
            Some(profile) => with_profile(message, &profile).unwrap_or_else(|| message.to_vec()),
            None => message.to_vec(),
        };
        // Line ends are blanks in JSON.
        line.iter_mut().filter(|byte| matches!(byte, b'\n' | b'\r')).for_each(|byte| *byte = b' ');
        line.push(b'\n');
        line
    }
}

fn with_profile(message: &[u8], profile: &Profile) -> Option<Vec<u8>> {
    let mut fields: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(message).ok()?;
    fields.insert("profile".into(), serde_json::to_value(profile).ok()?);
    serde_json::to_vec(&fields).ok()
}

fn event(entry: &Entry) -> Option<SessionEvent> {
    (entry.topic == Topic::Session).then(|| serde_json::from_slice(&entry.data).ok()).flatten()
}

impl Read for RecordedFeed {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut rest = self.fill_buf()?;
        let num = rest.read(out)?;
        self.consume(num);
        Ok(num)
    }
}

impl BufRead for RecordedFeed {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        while self.at >= self.line.len() {
            if let Some(line) = self.waiting.pop_front() {
                (self.line, self.at) = (line, 0);
            } else if self.is_over || self.chunk >= self.recording.chunks().len() {
                return Ok(&[]);
            } else {
                let entries = self.recording.read_chunk(self.chunk).map_err(io::Error::other)?;
                self.chunk += 1;
                self.gather(&entries, false);
            }
        }
        Ok(&self.line[self.at..])
    }

    fn consume(&mut self, num: usize) {
        self.at += num;
    }
}

#[cfg(test)]
mod tests {
    use super::super::format::VERSION;
    use super::super::writer::RecordingWriter;
    use super::*;
    use rhytid_shared::packet::PacketLayout;
    use rhytid_shared::view::ViewHello;

    #[test]
    fn a_session_names_its_own_profiles_and_no_others() {
        let (character, _) = crate::load_character(None).unwrap();
        let mut bytes = Vec::new();
        let mut writer = RecordingWriter::to(&mut bytes, PacketLayout::from(&*character)).unwrap();
        let hello = ViewHello::new("", &character, String::new());
        let (room, server, character) = ("a".into(), "test".into(), Box::new(hello.character));
        let start = |session, slot: &str| {
            let (slot, source) = (slot.to_owned(), "test".to_owned());
            SessionEvent::Start { session, slot, source, under_way: false, kept_neutral: None, profile: None, solve: None }
        };
        let profile = |session, name: &str| {
            let profile = Profile::from_json(&format!(r#"{{"rhytid_profile":1,"name":"{name}","measured":"weights"}}"#)).unwrap();
            SessionEvent::Profile { session, profile: Box::new(profile) }
        };
        let hello = br#"{"type":"hello","version":1}"#;
        let names = |name: &str| format!(r#"{{"type":"profile","profile":"{name}"}}"#).into_bytes();
        let (main, phone) = (Topic::Text("main".into()), Topic::Text("phone".into()));
        writer.event(1, &SessionEvent::Recording { version: VERSION, room, server, character, clock: 0 }).unwrap();
        writer.event(2, &start(1, "main")).unwrap();
        writer.message(&main, 2, None, hello).unwrap();
        writer.event(3, &start(2, "phone")).unwrap();
        writer.message(&phone, 3, None, hello).unwrap();
        // Both change theirs in one moment.
        writer.event(4, &profile(1, "anna")).unwrap();
        writer.event(4, &profile(2, "bert")).unwrap();
        writer.message(&main, 4, None, &names("anna")).unwrap();
        writer.message(&phone, 4, None, &names("bert")).unwrap();
        writer.finish().unwrap();
        for (index, name) in [(0, "anna"), (1, "bert")] {
            let recording = Recording::from_bytes(bytes.clone(), "both".into()).unwrap();
            let mut feed = RecordedFeed::session(recording, index, [0.0, f64::INFINITY]).unwrap().ok().unwrap();
            let mut text = String::new();
            feed.read_to_string(&mut text).unwrap();
            let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
            assert_eq!((lines.len(), &lines[1]["profile"]["name"]), (2, &name.into()), "{text}");
            assert!(lines[0].get("profile").is_none(), "{text}");
        }
    }
}
