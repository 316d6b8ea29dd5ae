//! A recording as a feed: the messages of one of its sessions, one a line.

use super::format::{Entry, SessionEvent, Topic};
use super::reader::{ReadError, Recording};
use std::collections::VecDeque;
use std::io::{self, BufRead, Read};
use std::path::Path;

/// Reads the text messages of one session of a recording as the lines of a feed file.
pub struct RecordedFeed {
    recording: Recording,
    slot: String,
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

    /// Session `index` (from 0) of those that were recorded from their beginning: its hello and its messages from `range[0]` to
    /// `range[1]`, seconds since the recording began. Gives the recording back where there are not so many.
    pub fn session(mut recording: Recording, index: usize, range: [f64; 2]) -> Result<Result<Self, Recording>, ReadError> {
        let mut left = index;
        let nanos = |seconds: f64| recording.start().saturating_add((seconds.clamp(0.0, 9e9) * 1e9) as u64);
        let range = [nanos(range[0]), nanos(range[1])];
        for chunk in 0..recording.chunks().len() {
            let entries = recording.read_chunk(chunk)?;
            for (at, entry) in entries.iter().enumerate() {
                let Some(SessionEvent::Start { slot, under_way: false, .. }) = event(entry) else { continue };
                if left > 0 {
                    left -= 1;
                    continue;
                }
                let (waiting, line, is_over) = (VecDeque::new(), Vec::new(), false);
                let mut feed = Self { recording, slot, chunk: chunk + 1, waiting, line, at: 0, is_over, range };
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
                    if wants_hello || (self.range[0]..=self.range[1]).contains(&entry.log_time) {
                        // Line ends are blanks in JSON.
                        let mut line: Vec<u8> =
                            entry.data.iter().map(|byte| if matches!(byte, b'\n' | b'\r') { b' ' } else { *byte }).collect();
                        line.push(b'\n');
                        self.waiting.push_back(line);
                    }
                    wants_hello = false;
                    self.is_over |= entry.log_time > self.range[1];
                }
                // The next session of this slot.
                Topic::Session if matches!(event(entry), Some(SessionEvent::Start { slot, .. }) if slot == self.slot) => {
                    self.is_over = true
                }
                _ => {}
            }
            if self.is_over {
                return;
            }
        }
    }
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
