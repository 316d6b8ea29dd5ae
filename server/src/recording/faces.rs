//! The faces of a recording, in their time: what replaying, drawing and exporting have in common.

use super::format::Topic;
use super::reader::{ReadError, Recording};
use rhytid_shared::FaceFrame;
use rhytid_shared::packet::{BatchError, BatchReader, Decoder};
use std::collections::VecDeque;

/// How far a face's arrival may be from where its sender's clock puts it, ns, before the arrival counts: longer than networks
/// jitter, short enough that a sender's clock that runs at another rate is followed.
const TOLERANCE: u64 = 250_000_000;

/// Reads the faces of a recording one after the other, from any time on.
pub struct Faces {
    recording: Recording,
    batches: BatchReader,
    decoder: Decoder,
    /// The next chunk to be read.
    chunk: usize,
    /// Packets with the time of their arrival, ns.
    waiting: VecDeque<(u64, Vec<u8>)>,
    frame: FaceFrame,
    pace: Pace,
    num_unreadable: u64,
}

/// Where a face stands in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// When its packet went out, seconds since the recording began.
    pub at: f64,
    /// The same without the network's jitter: within a session as far apart as the sender's clock says. Never goes back.
    pub smooth: f64,
}

impl Faces {
    /// The faces of `recording`, from its beginning.
    pub fn new(recording: Recording) -> Self {
        let layout = recording.layout().clone();
        Self {
            batches: BatchReader::new(layout.clone()),
            frame: layout.frame_at_rest(),
            decoder: Decoder::new(layout),
            chunk: 0,
            waiting: VecDeque::new(),
            pace: Pace::default(),
            num_unreadable: 0,
            recording,
        }
    }

    /// The recording.
    pub fn recording(&self) -> &Recording {
        &self.recording
    }

    /// The face last given.
    pub fn frame(&self) -> &FaceFrame {
        &self.frame
    }

    /// Packets so far that stood there without the key packet they need.
    pub fn num_unreadable(&self) -> u64 {
        self.num_unreadable
    }

    /// Reads the next face into [`Self::frame`]; nothing at the end.
    pub fn advance(&mut self) -> Result<Option<Moment>, ReadError> {
        while let Some((at, packet)) = self.next_packet()? {
            if self.decoder.decode(&packet, &mut self.frame).is_err() {
                self.num_unreadable += 1;
                continue;
            }
            let since = at.saturating_sub(self.recording.start());
            let smooth = self.pace.place(since, &self.frame);
            return Ok(Some(Moment { at: since as f64 / 1e9, smooth: smooth as f64 / 1e9 }));
        }
        Ok(None)
    }

    /// Goes to `seconds` since the recording began: reads the face that stands there (the first one where there is none before), so
    /// that [`Self::advance`] goes on from there. Nothing where there is no face from there on.
    pub fn seek(&mut self, seconds: f64) -> Result<Option<Moment>, ReadError> {
        let target = self.recording.start().saturating_add((seconds.clamp(0.0, 1e9) * 1e9) as u64);
        self.chunk = self.recording.chunk_before(target)?;
        self.waiting.clear();
        self.batches = BatchReader::new(self.recording.layout().clone());
        self.decoder = Decoder::new(self.recording.layout().clone());
        self.pace = Pace::default();
        let mut found = None;
        loop {
            self.fill()?;
            let is_before = self.waiting.front().is_some_and(|(at, _)| *at <= target);
            if found.is_some() && !is_before {
                return Ok(found);
            }
            match self.advance()? {
                Some(moment) => found = Some(moment),
                None => return Ok(found),
            }
        }
    }

    fn next_packet(&mut self) -> Result<Option<(u64, Vec<u8>)>, ReadError> {
        self.fill()?;
        Ok(self.waiting.pop_front())
    }

    /// Reads until a packet waits, or the end.
    fn fill(&mut self) -> Result<(), ReadError> {
        while self.waiting.is_empty() && self.chunk < self.recording.chunks().len() {
            let entries = self.recording.read_chunk(self.chunk)?;
            self.chunk += 1;
            for entry in entries.iter().filter(|entry| entry.topic == Topic::Packets) {
                let waiting = &mut self.waiting;
                match self.batches.unpack(&entry.data, |at, packet| waiting.push_back((at.saturating_mul(1000), packet.to_vec()))) {
                    // It goes on from one that is not there; one that starts anew will come.
                    Ok(()) | Err(BatchError::Gap { .. }) => {}
                    Err(error) => return Err(self.recording.broken_batch(entry.log_time, &error)),
                }
            }
        }
        Ok(())
    }
}

/// Places faces as far apart as their sender's clock says, near where they arrived.
#[derive(Debug, Clone, Copy, Default)]
struct Pace {
    /// Session, its time of capture (µs) and where that was placed (ns).
    base: Option<(u32, u64, u64)>,
    last: u64,
}

impl Pace {
    /// Where a face that arrived at `at` (ns) stands, ns.
    fn place(&mut self, at: u64, frame: &FaceFrame) -> u64 {
        let by_sender = self.base.filter(|(session, ..)| *session == frame.session).and_then(|(_, captured, placed)| {
            let since = frame.captured_at_micros.checked_sub(captured)?.checked_mul(1000)?;
            placed.checked_add(since).filter(|place| place.abs_diff(at) <= TOLERANCE)
        });
        let place = by_sender.unwrap_or_else(|| {
            self.base = Some((frame.session, frame.captured_at_micros, at));
            at
        });
        self.last = place.max(self.last);
        self.last
    }
}
