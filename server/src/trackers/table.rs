//! Tables of text (CSV) as feeds: row by row, so that one of any length takes little memory.

use std::io::{self, BufRead, Read};

/// What makes the lines of a feed of one kind of table's rows.
pub trait Rows: Default {
    /// Longest row, bytes.
    const LONGEST: u64;

    /// Takes a row without the white space at its end, the header first, and writes the lines that it adds to the feed, if any.
    fn take(&mut self, row: &str, text: &mut String) -> Result<(), String>;

    /// Whether what has been taken is a whole table.
    fn end(&self) -> Result<(), String>;
}

/// Reads a table as the lines of a feed.
pub struct Table<R, T> {
    source: R,
    rows: T,
    num_rows: usize,
    /// What has not been given yet, from `at` on.
    text: Vec<u8>,
    at: usize,
}

impl<R: BufRead, T: Rows> Table<R, T> {
    /// A reader of `source`, which begins with the header's line.
    pub fn new(source: R) -> Self {
        Self { source, rows: T::default(), num_rows: 0, text: Vec::new(), at: 0 }
    }

    /// The next lines of the feed into `text`; false at the end.
    fn next_lines(&mut self) -> io::Result<bool> {
        loop {
            self.num_rows += 1;
            let wrong = |problem: String| io::Error::new(io::ErrorKind::InvalidData, format!("line {}: {problem}", self.num_rows));
            let mut bytes = Vec::new();
            if (&mut self.source).take(T::LONGEST).read_until(b'\n', &mut bytes)? == 0 {
                return self.rows.end().map(|()| false).map_err(wrong);
            }
            if bytes.len() as u64 == T::LONGEST && bytes.last() != Some(&b'\n') {
                return Err(wrong(format!("it is longer than {} bytes", T::LONGEST)));
            }
            let row = std::str::from_utf8(&bytes).map_err(|_| wrong("it is not UTF-8 text".into()))?;
            let mut text = String::new();
            self.rows.take(row.trim_start_matches('\u{feff}').trim_end(), &mut text).map_err(wrong)?;
            if !text.is_empty() {
                (self.text, self.at) = (text.into_bytes(), 0);
                return Ok(true);
            }
        }
    }
}

impl<R: BufRead, T: Rows> Read for Table<R, T> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.at == self.text.len() && !self.next_lines()? {
            return Ok(0);
        }
        let count = buffer.len().min(self.text.len() - self.at);
        buffer[..count].copy_from_slice(&self.text[self.at..self.at + count]);
        self.at += count;
        Ok(count)
    }
}
