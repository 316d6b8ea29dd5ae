//! What lies between the link's thread and the picture's: bounded, and the newest wins.

use super::{CharacterSource, Connected, LinkState, LinkStats};
use rhytid_shared::FaceFrame;
use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Most frames that wait: 10 s at 25 Hz, less than 1 MB. A picture that sleeps longer wants the newest only.
const MAX_WAITING: usize = 256;

/// A decoded frame and when its packet came.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameArrival {
    /// The frame.
    pub frame: FaceFrame,
    /// When.
    pub received_at: Instant,
}

/// What has come since the last time: first a connection, if there was a new one, then the frames that came over it.
#[derive(Debug, Default)]
pub struct LinkNews {
    /// The last connection made; frames of the one before it are gone.
    pub connected: Option<Connected>,
    /// Frames by arrival.
    pub frames: VecDeque<FrameArrival>,
}

/// Shared by the two threads.
#[derive(Debug)]
pub(super) struct Inbox {
    inner: Mutex<Inner>,
    stopped: Condvar,
}

#[derive(Debug)]
struct Inner {
    news: LinkNews,
    state: LinkState,
    stats: LinkStats,
    is_stopped: bool,
}

impl Inbox {
    pub(super) fn new() -> Self {
        let inner = Inner { news: LinkNews::default(), state: LinkState::Connecting, stats: LinkStats::default(), is_stopped: false };
        Self { inner: Mutex::new(inner), stopped: Condvar::new() }
    }

    pub(super) fn connected(&self, mut connected: Connected) {
        let mut inner = self.lock();
        // What counts as known was fetched last; where nobody has taken it from here yet, this is the only copy.
        if connected.character == CharacterSource::Known
            && let Some(Connected { character: fetched @ CharacterSource::Fetched(_), .. }) = inner.news.connected.take()
        {
            connected.character = fetched;
        }
        inner.news.frames.clear();
        inner.news.connected = Some(connected);
        inner.state = LinkState::Live;
        inner.stats.connects += 1;
    }

    pub(super) fn frame(&self, frame: FaceFrame, received_at: Instant) {
        let mut inner = self.lock();
        if inner.news.frames.len() == MAX_WAITING {
            inner.news.frames.pop_front();
            inner.stats.overflowed += 1;
        }
        inner.news.frames.push_back(FrameArrival { frame, received_at });
    }

    pub(super) fn count(&self, add: impl FnOnce(&mut LinkStats)) {
        add(&mut self.lock().stats);
    }

    pub(super) fn set_state(&self, state: LinkState) {
        self.lock().state = state;
    }

    pub(super) fn take(&self) -> LinkNews {
        std::mem::take(&mut self.lock().news)
    }

    pub(super) fn state(&self) -> LinkState {
        self.lock().state.clone()
    }

    pub(super) fn stats(&self) -> LinkStats {
        self.lock().stats
    }

    pub(super) fn stop(&self) {
        self.lock().is_stopped = true;
        self.stopped.notify_all();
    }

    pub(super) fn is_stopped(&self) -> bool {
        self.lock().is_stopped
    }

    /// Sleeps, but not past a stop.
    pub(super) fn sleep_until(&self, at: Instant) {
        let mut inner = self.lock();
        while !inner.is_stopped {
            let left = at.saturating_duration_since(Instant::now());
            if left == Duration::ZERO {
                return;
            }
            (inner, _) = self.stopped.wait_timeout(inner, left).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Every change under this lock is whole, so a thread that panicked elsewhere leaves nothing broken.
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use rhytid_shared::HeadPose;

    #[test]
    fn full_inbox_drops_the_oldest_frame() {
        let inbox = Inbox::new();
        for seq in 0..MAX_WAITING as u32 + 3 {
            let frame = FaceFrame {
                session: 1,
                seq,
                captured_at_micros: u64::from(seq),
                face: true,
                points: vec![Vec3::ZERO],
                rotations: vec![Quat::IDENTITY],
                influences: vec![0.0],
                zones: Vec::new(),
                stretched: Vec::new(),
                shapes: None,
                head: HeadPose::default(),
            };
            inbox.frame(frame, Instant::now());
        }
        let news = inbox.take();
        assert_eq!(news.frames.len(), MAX_WAITING);
        assert_eq!(news.frames.front().map(|arrival| arrival.frame.seq), Some(3));
        assert_eq!(inbox.stats().overflowed, 3);
        assert!(inbox.take().frames.is_empty());
    }

    #[test]
    fn stop_ends_a_sleep() {
        let inbox = Inbox::new();
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| {
                let started_at = Instant::now();
                inbox.sleep_until(started_at + Duration::from_secs(60));
                started_at.elapsed()
            });
            inbox.stop();
            assert!(sleeper.join().unwrap() < Duration::from_secs(30));
        });
    }
}
