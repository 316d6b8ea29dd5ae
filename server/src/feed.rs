//! Feed files: the publish messages of one session, one a line (`.jsonl`).

use rhytid_shared::{Character, MessageError, PublishHello, PublishMessage, PublishReader, TrackingFrame};
use std::fs::File;
use std::io::{BufRead, BufReader};
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
        let shown = path.display().to_string();
        let file = File::open(path).map_err(|source| FeedError::Io { path: shown.clone(), source })?;
        Self::new(BufReader::with_capacity(1 << 16, file), shown, character)
    }
}

impl<R: BufRead> Feed<R> {
    /// Reads the hello from `lines`; `path` is what errors call the feed.
    pub fn new(lines: R, path: String, character: &Character) -> Result<Self, FeedError> {
        let _ = (&lines, &path, PublishReader::new(character));
        unimplemented!()
    }

    /// The next line that is not blank; `None` at the end. A frame is written into `frame`.
    pub fn next_frame(&mut self, frame: &mut TrackingFrame) -> Result<Option<FeedItem>, FeedError> {
        let _ = (self.reader.read(&self.text, frame), self.line, &mut self.lines, &self.path, PublishMessage::Frame);
        unimplemented!()
    }
}
