//! Mending a recording that was not finished, or was damaged: what is whole is written anew, with its index.

use super::files::hold;
use super::format::{SessionEvent, Topic};
use super::reader::{ReadError, Recording};
use super::writer::RecordingWriter;
use mcap::McapError;
use rhytid_shared::packet::BatchReader;
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

/// Why a recording could not be mended.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// Nothing in it can be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The mended file could not be written.
    #[error("cannot write {path}: {problem}")]
    Write {
        /// The file.
        path: String,
        /// What happened.
        problem: String,
    },
    /// It is not cut, but not done yet; or it is being mended already.
    #[error("{path} is still being written; end its recording first, or mend a copy of it with --out")]
    Live {
        /// The file.
        path: String,
    },
}

/// What was kept and what was lost.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RecoverReport {
    /// True where the file was whole, so that nothing was written.
    pub was_whole: bool,
    /// Messages kept.
    pub messages: u64,
    /// Packets kept.
    pub packets: u64,
    /// Seconds from the first message kept to the last.
    pub seconds: f64,
    /// Bytes at the end that make no whole chunk.
    pub cut_off: u64,
    /// Chunks in the middle that are damaged, with what is wrong with each, at most ten of them.
    pub damaged: Vec<String>,
    /// How many there are.
    pub num_damaged: u64,
    /// Batches of packets that go on from what was lost.
    pub orphans: u64,
}

/// Mends the recording at `path`, in its place where nobody is writing it, or into `out` (which must not exist). Without damage
/// nothing is written.
pub fn recover(path: &Path, out: Option<&Path>) -> Result<RecoverReport, RecoverError> {
    let live = || RecoverError::Live { path: path.display().to_string() };
    // Until the mended file is in its place.
    let own = match (out, File::open(path)) {
        (None, Ok(file)) => Some(file),
        // Opening it says what is wrong.
        _ => None,
    };
    if own.as_ref().is_some_and(|file| !hold(file)) {
        return Err(live());
    }
    let mut recording = Recording::open(path)?;
    let target = out.map_or_else(|| temporary(path), Path::to_owned);
    let mut report = RecoverReport { cut_off: recording.cut_off().unwrap_or(0), ..RecoverReport::default() };
    // Looked through first: a file that is whole is left alone.
    let is_finished = recording.cut_off().is_none();
    if is_finished && (0..recording.chunks().len()).all(|index| recording.read_chunk(index).is_ok()) {
        report.was_whole = true;
        report.seconds = recording.seconds();
        return Ok(report);
    }
    let broken = |problem: String| RecoverError::Write { path: target.display().to_string(), problem };
    if out.is_none() {
        remove_left_over(&target).map_err(|error| broken(error.to_string()))?;
    }
    let file = OpenOptions::new().write(true).create_new(true).open(&target).map_err(|error| broken(error.to_string()))?;
    hold(&file);
    let finished = copy(&mut recording, file, &mut report).map_err(|error| broken(error.to_string())).and_then(|()| {
        if out.is_some() {
            return Ok(());
        }
        // Not every system and every disk says who holds a file.
        if std::fs::metadata(path).is_ok_and(|now| now.len() != recording.num_bytes()) {
            return Err(live());
        }
        std::fs::rename(&target, path).map_err(|error| broken(error.to_string()))
    });
    if let Err(error) = finished {
        let _ = std::fs::remove_file(&target);
        return Err(error);
    }
    drop(own);
    Ok(report)
}

/// Where the mended file is made: hidden, and called as nobody would call a file of theirs.
fn temporary(path: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(".rhytid-mending");
    path.with_file_name(name)
}

/// Removes what a mending that was killed has left at `path`: a plain file that nobody holds. Anything else stays, and stands in the
/// way.
fn remove_left_over(path: &Path) -> io::Result<()> {
    // Of a link itself, not of what it leads to.
    let is_plain = std::fs::symlink_metadata(path).is_ok_and(|found| found.is_file());
    if is_plain && hold(&File::open(path)?) { std::fs::remove_file(path) } else { Ok(()) }
}

fn copy(recording: &mut Recording, file: File, report: &mut RecoverReport) -> Result<(), McapError> {
    let layout = recording.layout().clone();
    let handle = file.try_clone()?;
    let mut writer = RecordingWriter::to(file, layout.clone()).map_err(|error| McapError::Io(io::Error::other(error)))?;
    let mut batches = BatchReader::new(layout);
    let (mut first, mut last) = (None, 0);
    for index in 0..recording.chunks().len() {
        let entries = match recording.read_chunk(index) {
            Ok(entries) => entries,
            Err(error) => {
                report.num_damaged += 1;
                if report.damaged.len() < 10 {
                    report.damaged.push(error.to_string());
                }
                // How many messages it had, nobody knows.
                writer.event(last, &SessionEvent::Gap { messages: 0 })?;
                continue;
            }
        };
        for entry in entries {
            if entry.topic == Topic::Packets {
                let mut num = 0;
                if batches.unpack(&entry.data, |_, _| num += 1).is_err() {
                    report.orphans += 1;
                    continue;
                }
                report.packets += num;
            }
            report.messages += 1;
            first.get_or_insert(entry.log_time);
            last = last.max(entry.log_time);
            writer.copy(&entry)?;
        }
        writer.flush()?;
    }
    report.seconds = last.saturating_sub(first.unwrap_or(last)) as f64 / 1e9;
    writer.event(last, &SessionEvent::Stop { reason: "cut; mended afterwards".into() })?;
    writer.finish()?;
    handle.sync_all()?;
    Ok(())
}
