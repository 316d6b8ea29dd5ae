//! Feed files: the publish messages of one session, one a line (`.jsonl`).

use rhytid_shared::limits::MAX_MESSAGE_BYTES;
use rhytid_shared::{Character, MessageError, PublishHello, PublishMessage, PublishReader, TrackingFrame};
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;

/// Why a feed could not be read.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// The file could not be opened or read.
    #[error("cannot read feed {path}: {source}")]
    Io {
        /// The file as it was named.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line is no message, or one that is not allowed there.
    #[error("feed {path}, line {line}: {source}")]
    Line {
        /// The file as it was named.
        path: String,
        /// Counted from 1.
        line: usize,
        /// What is wrong with it.
        source: MessageError,
    },
}

/// What stands on a line after the hello.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FeedItem {
    /// A frame, written into the buffer given.
    Frame,
    /// Take the neutral face now.
    Calibrate,
}

/// A feed being read, line by line.
pub struct Feed<R = BufReader<File>> {
    /// The first line.
    pub hello: PublishHello,
    path: String,
    line: usize,
    text: String,
    lines: R,
    reader: PublishReader,
}

impl Feed {
    /// Opens a feed file and reads its hello.
    pub fn open(path: &Path, character: &Character) -> Result<Self, FeedError> {
        let (lines, shown) = open(path)?;
        Self::new(lines, shown, character)
    }

    /// As [`Self::open`], for a sender, which does not know the character at the other end.
    pub fn open_for_any_character(path: &Path) -> Result<Self, FeedError> {
        let (lines, shown) = open(path)?;
        Self::begin(lines, shown, PublishReader::for_any_character())
    }
}

impl<R: BufRead> Feed<R> {
    /// Reads the hello from `lines`; `path` is what errors call the feed.
    pub fn new(lines: R, path: String, character: &Character) -> Result<Self, FeedError> {
        Self::begin(lines, path, PublishReader::new(character))
    }

    /// As [`Self::new`], for a sender, which does not know the character at the other end.
    pub fn new_for_any_character(lines: R, path: String) -> Result<Self, FeedError> {
        Self::begin(lines, path, PublishReader::for_any_character())
    }

    fn begin(lines: R, path: String, reader: PublishReader) -> Result<Self, FeedError> {
        let mut hello = PublishHello { source: String::new(), fps: None, layout: None, image: None, focal: None, takeover: false };
        let mut feed = Self { hello: hello.clone(), path, line: 0, text: String::new(), lines, reader };
        if feed.next_line()? {
            match feed.read(&mut TrackingFrame::default())? {
                PublishMessage::Hello(first) => hello = first,
                PublishMessage::Frame | PublishMessage::Calibrate => return Err(feed.refuse(MessageError::new("no_hello", NO_HELLO))),
            }
        } else {
            feed.line = 1;
            return Err(feed.refuse(MessageError::new("no_hello", format!("the feed is empty, {NO_HELLO}"))));
        }
        Ok(Self { hello, ..feed })
    }

    /// The next line that is not blank; `None` at the end. A frame is written into `frame`.
    pub fn next_frame(&mut self, frame: &mut TrackingFrame) -> Result<Option<FeedItem>, FeedError> {
        if !self.next_line()? {
            return Ok(None);
        }
        match self.read(frame)? {
            PublishMessage::Frame => Ok(Some(FeedItem::Frame)),
            PublishMessage::Calibrate => Ok(Some(FeedItem::Calibrate)),
            PublishMessage::Hello(_) => Err(self.refuse(MessageError::new("repeated_hello", "a feed has one hello, its first line"))),
        }
    }

    /// The line last read, as it stands in the file.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Number of the line last read, from 1.
    pub fn line(&self) -> usize {
        self.line
    }

    fn read(&mut self, frame: &mut TrackingFrame) -> Result<PublishMessage, FeedError> {
        self.reader.read(&self.text, frame).map_err(|source| FeedError::Line { path: self.path.clone(), line: self.line, source })
    }

    fn refuse(&self, source: MessageError) -> FeedError {
        FeedError::Line { path: self.path.clone(), line: self.line, source }
    }

    /// Reads the next line that is not blank into `text`, without its end; false at the end of the feed.
    fn next_line(&mut self) -> Result<bool, FeedError> {
        loop {
            self.text.clear();
            self.line += 1;
            let most = MAX_MESSAGE_BYTES as u64 + 2;
            let read = (&mut self.lines).take(most).read_line(&mut self.text);
            let num_bytes = match read {
                Ok(num_bytes) => num_bytes,
                Err(error) if error.kind() == ErrorKind::InvalidData => {
                    return Err(self.refuse(MessageError::new("malformed_json", "line is not UTF-8 text")));
                }
                Err(source) => return Err(FeedError::Io { path: self.path.clone(), source }),
            };
            if num_bytes == 0 {
                return Ok(false);
            }
            self.text.truncate(self.text.trim_end_matches(['\n', '\r']).len());
            if self.text.len() > MAX_MESSAGE_BYTES {
                return Err(self.refuse(MessageError::new("too_long", format!("line is longer than {MAX_MESSAGE_BYTES} bytes"))));
            }
            if !self.text.trim().is_empty() {
                return Ok(true);
            }
        }
    }
}

fn open(path: &Path) -> Result<(BufReader<File>, String), FeedError> {
    let shown = path.display().to_string();
    let file = File::open(path).map_err(|source| FeedError::Io { path: shown.clone(), source })?;
    Ok((BufReader::with_capacity(1 << 16, file), shown))
}

const NO_HELLO: &str = "the first line must be {\"type\":\"hello\",\"version\":1,…}";
