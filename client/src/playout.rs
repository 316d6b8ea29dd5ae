//! Playout: turns frames that arrive when they like into a face that moves evenly.
//!
//! A state machine without sockets and without a clock: frames and the viewer's `now` go in, one interpolated
//! [`RenderFrame`] comes out. The face is shown a little late (the playout delay), so that there is nearly always a frame
//! on both sides of the moment shown. Coefficients and bones are interpolated with the same `u`, or wrinkles would lag
//! the brow.
//!
//! A sender that falls silent is held for 250 ms, then eased to neutral within 500 ms. Whatever makes the shown value
//! jump (a return from silence, a new session, a clock that was set) is blended in from what was shown last.

mod clock;
mod mix;
#[cfg(test)]
mod tests;

use crate::renderer::RenderFrame;
use clock::PlayoutClock;
use rhytid_shared::{Character, FaceFrame};
use std::collections::VecDeque;
use std::time::Duration;

/// How long the last frame of a sender that fell silent is held.
pub const HOLD: Duration = Duration::from_millis(250);
/// How long the easing to neutral takes after that.
pub const EASE: Duration = Duration::from_millis(500);
/// Longest blend from what was shown into what shall be shown. Tuned by eye: longer looks like swimming.
const MAX_BLEND: i64 = 250_000;
/// Shortest blend, microseconds: two pictures at 60 Hz.
const MIN_BLEND: i64 = 33_000;
/// Most frames kept: twice what the longest delay (250 ms) holds of a 240 Hz tracker.
const MAX_BUFFERED: usize = 128;
/// Sender's clocks beyond this (285 years in microseconds) are taken as this, so that differences fit an `i64`.
const LATEST_CAPTURE: u64 = 1 << 53;

/// What the face on the screen is a picture of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlayoutState {
    /// No frame has arrived yet; the character is at rest.
    Waiting,
    /// The face moves.
    Live,
    /// The sender is there and says that its tracker sees no face.
    FaceLost,
    /// The sender fell silent; the face is easing to neutral.
    Silent,
    /// The sender has been silent for so long that the face is at rest again.
    Idle,
}

impl PlayoutState {
    fn is_eased(self) -> bool {
        matches!(self, Self::Silent | Self::Idle)
    }
}

/// What became of a frame given to [`Playout::push`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pushed {
    /// Will be shown.
    Accepted,
    /// First of a new session; everything older is forgotten.
    NewSession,
    /// Came after a newer one of its session, or belongs to a session that is over; ignored.
    Late,
    /// Came before; ignored.
    Duplicate,
    /// Has other lengths than the character needs; ignored.
    Misfit,
}

/// What playout measured. Times are on the viewer's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PlayoutStats {
    /// How long after the earliest possible moment a frame is shown.
    pub delay: Duration,
    /// 95th percentile of the time packets took more than the fastest of the last 10 s.
    pub jitter: Duration,
    /// Median time between frames on the sender's clock.
    pub send_interval: Duration,
    /// Frames held.
    pub buffered: usize,
    /// Frames taken.
    pub accepted: u64,
    /// Frames ignored because newer ones had come.
    pub late: u64,
    /// Frames ignored because they had come before.
    pub duplicates: u64,
    /// Frames ignored because their lengths do not fit the character.
    pub misfits: u64,
    /// Times the picture ran out of frames.
    pub underruns: u64,
    /// Sessions seen.
    pub sessions: u64,
}

/// The state machine. Times are `Duration`s since any fixed moment on the viewer's monotonic clock.
#[derive(Debug, Clone)]
pub struct Playout {
    rest: RenderFrame,
    shown: RenderFrame,
    wanted: RenderFrame,
    blend: Option<Blend>,
    session: Option<Session>,
    state: PlayoutState,
    stats: PlayoutStats,
}

/// What is known of the publisher being watched.
#[derive(Debug, Clone)]
struct Session {
    id: u32,
    clock: PlayoutClock,
    /// In the order of sequence and of capture time, at least one.
    frames: VecDeque<Snapshot>,
    received: SequenceWindow,
    /// When the newest frame came, viewer's clock, microseconds.
    newest_came_at: i64,
    /// How far the moment shown lay past the newest frame when it was last sampled, microseconds; 0 where it did not.
    underrun: i64,
}

#[derive(Debug, Clone)]
struct Snapshot {
    /// Sender's clock, microseconds.
    captured_at: i64,
    face: bool,
    frame: RenderFrame,
}

/// A fading memory of what was shown before a jump.
#[derive(Debug, Clone)]
struct Blend {
    from: RenderFrame,
    started_at: i64,
    length: i64,
}

impl Blend {
    /// How much of what shall be shown is shown at `now`, in `[0, 1]`.
    fn share(&self, now: i64) -> f32 {
        smoothstep(((now - self.started_at) as f32 / self.length as f32).clamp(0.0, 1.0))
    }

    /// How far the face shown at `now` is at most behind what shall be shown, microseconds. At the start it was half the
    /// length (see [`Playout::sample`]); what shall be shown has moved on since.
    fn behind(&self, now: i64) -> i64 {
        ((1.0 - self.share(now)) * (self.length / 2 + now - self.started_at) as f32) as i64
    }
}

impl Playout {
    /// Nothing has come yet: the character at rest.
    pub fn new(character: &Character) -> Self {
        Self::with_rest(RenderFrame::at_rest(character))
    }

    fn with_rest(rest: RenderFrame) -> Self {
        Self {
            shown: rest.clone(),
            wanted: rest.clone(),
            rest,
            blend: None,
            session: None,
            state: PlayoutState::Waiting,
            stats: PlayoutStats::default(),
        }
    }

    /// Takes a frame that arrived at `now`.
    pub fn push(&mut self, frame: &FaceFrame, now: Duration) -> Pushed {
        let outcome = self.file(frame, micros(now));
        match outcome {
            Pushed::Accepted => self.stats.accepted += 1,
            Pushed::NewSession => {
                self.stats.accepted += 1;
                self.stats.sessions += 1;
            }
            Pushed::Late => self.stats.late += 1,
            Pushed::Duplicate => self.stats.duplicates += 1,
            Pushed::Misfit => self.stats.misfits += 1,
        }
        outcome
    }

    fn file(&mut self, frame: &FaceFrame, now: i64) -> Pushed {
        if frame.points.len() != self.rest.points.len()
            || frame.rotations.len() != self.rest.rotations.len()
            || frame.influences.len() != self.rest.influences.len()
        {
            return Pushed::Misfit;
        }
        let captured_at = frame.captured_at_micros.min(LATEST_CAPTURE) as i64;
        let snapshot = Snapshot { captured_at, face: frame.face, frame: RenderFrame::from(frame) };
        if let Some(session) = &mut self.session {
            // Sessions are counted up; the difference wraps with the counter.
            match frame.session.wrapping_sub(session.id).cast_signed() {
                0 => {
                    let outcome = session.file(frame.seq, snapshot, now);
                    if session.clock.take_jump() {
                        self.blend_from_shown(now, MAX_BLEND);
                    }
                    return outcome;
                }
                ..0 => return Pushed::Late,
                1.. => {}
            }
        }
        self.session = Some(Session {
            id: frame.session,
            clock: PlayoutClock::starting(captured_at, now),
            frames: VecDeque::from([snapshot]),
            received: SequenceWindow::starting(frame.seq),
            newest_came_at: now,
            underrun: 0,
        });
        // The first face ever is shown at once; later ones fade in.
        if self.stats.sessions > 0 {
            self.blend_from_shown(now, MAX_BLEND);
        }
        Pushed::NewSession
    }

    /// Forgets the session but not the picture: for a new connection, whose server may count sessions anew.
    pub fn reconnected(&mut self, now: Duration) {
        if self.session.take().is_some() {
            self.blend_from_shown(micros(now), EASE.as_micros() as i64);
        }
        self.state = PlayoutState::Waiting;
    }

    /// What to show at `now`, which must not run backwards.
    pub fn sample(&mut self, now: Duration) -> &RenderFrame {
        let now = micros(now);
        let mut blend_length = None;
        match &mut self.session {
            None => self.wanted.clone_from(&self.rest),
            Some(session) => {
                let passed = session.clock.advance(now);
                let (underrun_before, state_before) = (session.underrun, self.state);
                self.state = session.sample(session.clock.play_time(now), now, &self.rest, &mut self.wanted);
                let missed = underrun_before - session.underrun;
                if session.clock.take_jump() {
                    blend_length = Some(MAX_BLEND);
                } else if underrun_before > 0 && state_before.is_eased() && !self.state.is_eased() {
                    blend_length = Some(EASE.as_micros() as i64);
                } else if 2 * missed > passed {
                    // Twice the time that the face is behind: it catches up at one and a half times life, on average. That
                    // includes what a blend cut short here still had to make up for, or a short gap after a long one would
                    // hurry the face through both. Less than half of the time since the last picture is no faster than that
                    // as it is; a blend begun anew for every little that evenly late frames gain would hold the face.
                    let behind = self.blend.as_ref().map_or(0, |blend| blend.behind(now));
                    blend_length = Some(2 * (missed + behind));
                } else if underrun_before == 0 && session.underrun > 0 {
                    self.stats.underruns += 1;
                }
            }
        }
        if let Some(length) = blend_length {
            self.blend_from_shown(now, length);
        }
        match &self.blend {
            Some(blend) if now < blend.started_at + blend.length => {
                mix::mix(&blend.from, &self.wanted, blend.share(now), &mut self.shown);
            }
            _ => {
                self.blend = None;
                self.shown.clone_from(&self.wanted);
            }
        }
        &self.shown
    }

    /// What the last [`Playout::sample`] was a picture of.
    pub fn state(&self) -> PlayoutState {
        self.state
    }

    /// True while the next sample may differ from the last.
    pub fn is_moving(&self) -> bool {
        self.blend.is_some() || matches!(self.state, PlayoutState::Live | PlayoutState::FaceLost | PlayoutState::Silent)
    }

    /// What was measured so far.
    pub fn stats(&self) -> PlayoutStats {
        let mut stats = self.stats;
        if let Some(session) = &self.session {
            stats.delay = session.clock.delay();
            stats.jitter = session.clock.jitter();
            stats.send_interval = session.clock.send_interval();
            stats.buffered = session.frames.len();
        }
        stats
    }

    fn blend_from_shown(&mut self, now: i64, length: i64) {
        let length = length.clamp(MIN_BLEND, MAX_BLEND.max(EASE.as_micros() as i64));
        self.blend = Some(Blend { from: self.shown.clone(), started_at: now, length });
    }
}

impl Session {
    fn file(&mut self, seq: u32, snapshot: Snapshot, now: i64) -> Pushed {
        match self.received.note(seq) {
            Arrival::Newest => {}
            Arrival::Late => return Pushed::Late,
            Arrival::Duplicate => return Pushed::Duplicate,
        }
        let newest = self.frames.back().expect("a session holds at least the newest frame").captured_at;
        if snapshot.captured_at <= newest {
            return Pushed::Late;
        }
        self.clock.note_arrival(snapshot.captured_at, newest, now);
        if self.frames.len() == MAX_BUFFERED {
            self.frames.pop_front();
        }
        self.frames.push_back(snapshot);
        self.newest_came_at = now;
        Pushed::Accepted
    }

    /// Writes the face at `play_time` (sender's clock), which is `now` (viewer's clock), into `out` and drops the frames that are over.
    fn sample(&mut self, play_time: i64, now: i64, rest: &RenderFrame, out: &mut RenderFrame) -> PlayoutState {
        while self.frames.get(1).is_some_and(|next| next.captured_at <= play_time) {
            self.frames.pop_front();
        }
        let before = &self.frames[0];
        let past = play_time - before.captured_at;
        self.underrun = 0;
        match self.frames.get(1) {
            Some(after) if past > 0 => {
                let u = past as f32 / (after.captured_at - before.captured_at) as f32;
                mix::mix(&before.frame, &after.frame, u, out);
            }
            None if past > 0 => {
                self.underrun = past;
                // Frames that come too late for their moment are no silence: the newest of them is held.
                let silence = past.min(now - self.newest_came_at);
                let eased = (silence - HOLD.as_micros() as i64) as f32 / EASE.as_micros() as f32;
                mix::mix(&before.frame, rest, smoothstep(eased.clamp(0.0, 1.0)), out);
                if eased >= 1.0 {
                    return PlayoutState::Idle;
                } else if eased > 0.0 {
                    return PlayoutState::Silent;
                }
            }
            _ => out.clone_from(&before.frame),
        }
        if before.face { PlayoutState::Live } else { PlayoutState::FaceLost }
    }
}

/// Which of the last 64 sequence numbers came.
#[derive(Debug, Clone, Copy)]
struct SequenceWindow {
    newest: u32,
    /// Bit `k`: `newest - k` came.
    came: u64,
}

enum Arrival {
    Newest,
    Late,
    Duplicate,
}

impl SequenceWindow {
    fn starting(seq: u32) -> Self {
        Self { newest: seq, came: 1 }
    }

    fn note(&mut self, seq: u32) -> Arrival {
        let ahead = seq.wrapping_sub(self.newest).cast_signed();
        if ahead > 0 {
            self.came = self.came.checked_shl(ahead.unsigned_abs()).unwrap_or(0) | 1;
            self.newest = seq;
            return Arrival::Newest;
        }
        let bit = 1_u64.checked_shl(ahead.unsigned_abs()).unwrap_or(0);
        if self.came & bit != 0 {
            return Arrival::Duplicate;
        }
        self.came |= bit;
        Arrival::Late
    }
}

/// `3u² − 2u³`: starts and ends at rest. `u` in `[0, 1]`.
fn smoothstep(u: f32) -> f32 {
    u * u * (3.0 - 2.0 * u)
}

fn micros(now: Duration) -> i64 {
    now.as_micros().min(LATEST_CAPTURE.into()) as i64
}
