//! Feed files: the publish messages of one session, one a line (`.jsonl`), or a recording of Live Link Face (`.csv`).

use crate::trackers::livelink_csv::LiveLinkCsv;
use rhytid_shared::limits::MAX_MESSAGE_BYTES;
use rhytid_shared::{Character, Command, MessageError, PublishHello, PublishMessage, PublishReader, TrackingFrame};
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
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
#[derive(Debug, Clone, PartialEq)]
pub enum FeedItem {
    /// A frame, written into the buffer given.
    Frame,
    /// What the publisher asked for between two frames.
    Command(Command),
}

/// The lines of a feed file, whatever it is on the disk.
pub type FeedLines = Box<dyn BufRead + Send>;

/// A feed being read, line by line.
pub struct Feed<R = FeedLines> {
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
        let mut hello = PublishHello::default();
        let mut feed = Self { hello: hello.clone(), path, line: 0, text: String::new(), lines, reader };
        if feed.next_line()? {
            match feed.read(&mut TrackingFrame::default())? {
                PublishMessage::Hello(first) => hello = first,
                _ => return Err(feed.refuse(MessageError::new("no_hello", NO_HELLO))),
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
            PublishMessage::Command(command) => Ok(Some(FeedItem::Command(command))),
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
            self.line += 1;
            let mut bytes = std::mem::take(&mut self.text).into_bytes();
            bytes.clear();
            // One more than the longest line and its end.
            let most = MAX_MESSAGE_BYTES as u64 + 3;
            let num_bytes = (&mut self.lines)
                .take(most)
                .read_until(b'\n', &mut bytes)
                .map_err(|source| FeedError::Io { path: self.path.clone(), source })?;
            if num_bytes == 0 {
                return Ok(false);
            }
            while bytes.pop_if(|byte| matches!(byte, b'\n' | b'\r')).is_some() {}
            // Before its text is looked at: where a line is cut, a character may be.
            if bytes.len() > MAX_MESSAGE_BYTES {
                return Err(self.refuse(MessageError::new("too_long", format!("line is longer than {MAX_MESSAGE_BYTES} bytes"))));
            }
            self.text = String::from_utf8(bytes).map_err(|_| self.refuse(MessageError::new("not_utf8", "line is not UTF-8 text")))?;
            if !self.text.trim().is_empty() {
                return Ok(true);
            }
        }
    }
}

fn open(path: &Path) -> Result<(FeedLines, String), FeedError> {
    let shown = path.display().to_string();
    let file = File::open(path).map_err(|source| FeedError::Io { path: shown.clone(), source })?;
    let lines = BufReader::with_capacity(1 << 16, file);
    let is_recording = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("csv"));
    Ok((if is_recording { Box::new(BufReader::new(LiveLinkCsv::new(lines))) } else { Box::new(lines) }, shown))
}

const NO_HELLO: &str = "the first line must be {\"type\":\"hello\",\"version\":1,…}";

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    const HELLO: &str = "{\"type\":\"hello\",\"version\":1}\n";

    /// What is wrong with the line after a hello.
    fn problem(line: &[u8]) -> String {
        let bytes = [HELLO.as_bytes(), line].concat();
        let mut feed = Feed::new_for_any_character(Cursor::new(bytes), "feed".into()).unwrap();
        feed.next_frame(&mut TrackingFrame::default()).unwrap_err().to_string()
    }

    #[test]
    fn an_empty_feed_has_no_hello() {
        for text in ["", "\n \r\n\n"] {
            let Err(error) = Feed::new_for_any_character(Cursor::new(text), "feed".into()) else { panic!("{text:?} is no feed") };
            assert!(error.to_string().starts_with("feed feed, line 1: the feed is empty, the first line must be"), "{error}");
        }
    }

    #[test]
    fn the_longest_line_is_taken_and_a_longer_one_is_called_long_whatever_it_holds() {
        let line = |len: usize, pad: &str| {
            let start = "{\"type\":\"frame\",\"t\":0,\"face\":false,\"pad\":\"";
            let pad = pad.repeat((len - start.len() - 2) / pad.len());
            format!("{start}{pad}{}\"}}", "x".repeat(len - start.len() - 2 - pad.len()))
        };
        let longest = line(MAX_MESSAGE_BYTES, "x");
        assert_eq!(longest.len(), MAX_MESSAGE_BYTES);
        for end in ["", "\n", "\r\n"] {
            let feed = format!("{HELLO}{longest}{end}");
            let mut feed = Feed::new_for_any_character(Cursor::new(feed), "feed".into()).unwrap();
            assert_eq!(feed.next_frame(&mut TrackingFrame::default()).unwrap(), Some(FeedItem::Frame), "{end:?}");
        }
        let expected = format!("feed feed, line 2: line is longer than {MAX_MESSAGE_BYTES} bytes");
        // Four bytes a character: at three of the four lengths the cut goes through one.
        for more in 1..=8 {
            for end in ["", "\n", "\r\n"] {
                assert_eq!(problem(format!("{}{end}", line(MAX_MESSAGE_BYTES + more, "x")).as_bytes()), expected, "{more} {end:?}");
                assert_eq!(problem(format!("{}{end}", line(MAX_MESSAGE_BYTES + more, "😀")).as_bytes()), expected, "{more} {end:?}");
            }
        }
    }

    #[test]
    fn a_line_that_is_not_text_is_called_so() {
        assert_eq!(problem(b"\xff\xfe\n"), "feed feed, line 2: line is not UTF-8 text");
    }
}
