//! The viewers of a room, in groups. Each group has one task, which writes a new state to one viewer after the other.
//!
//! A task for each viewer would cost a frame as much again as the kernel's send leaves: its wake-up, and the way of everything
//! that it holds into the cache. One task for all would keep a large room on one core.

use super::member::{Counts, Member};
use crate::room::{Latest, Room};
use crate::service::Hub;
use crate::socket::{Ending, Stop};
use futures_util::task::AtomicWaker;
use slab::Slab;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Wake, Waker};
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tokio::time::{Instant, Sleep};

/// Viewers of a group: a thousand are four groups, so that four cores can serve them.
const GROUP: usize = 256;
/// Viewers between two pauses of a group's task, in which the tasks of other rooms have their turn: 150 µs.
const STRETCH: usize = 32;
/// A timer that is due at no time.
const NEVER: Duration = Duration::from_secs(86_400);

/// All viewers of a room.
#[derive(Default)]
pub(crate) struct Audience {
    groups: Mutex<Vec<Door>>,
}

/// The way into a group.
struct Door {
    seats: Arc<Semaphore>,
    /// Holds as many as there are seats.
    newcomers: mpsc::UnboundedSender<Newcomer>,
}

/// A viewer and its seat, which is free again when it is dropped.
struct Newcomer {
    member: Member,
    seat: OwnedSemaphorePermit,
}

impl Audience {
    /// Serves `member` from now on.
    pub fn enter(&self, hub: &Arc<Hub>, member: Member) {
        let mut groups = self.groups();
        let found = groups.iter().find_map(|door| Some((door.seats.clone().try_acquire_owned().ok()?, &door.newcomers)));
        let (seat, newcomers) = match found {
            Some(found) => found,
            None => {
                let (newcomers, arrivals) = mpsc::unbounded_channel();
                let seats = Arc::new(Semaphore::new(GROUP));
                let seat = seats.clone().try_acquire_owned().expect("nobody else knows of it");
                let viewing = member.viewing();
                let group = Group {
                    hub: hub.clone(),
                    room: viewing.room.clone(),
                    news: viewing.slot.clone(),
                    seats: seats.clone(),
                    arrivals,
                    seated: Slab::new(),
                    calls: Arc::default(),
                };
                groups.push(Door { seats, newcomers });
                tokio::spawn(group.run());
                (seat, &groups[groups.len() - 1].newcomers)
            }
        };
        // A group leaves the list, which is locked, before it ends.
        let _ = newcomers.send(Newcomer { member, seat });
    }

    fn groups(&self) -> MutexGuard<'_, Vec<Door>> {
        // Doors come and go whole.
        self.groups.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Who of a group has called for its task, by place.
#[derive(Default)]
struct Calls {
    places: Mutex<Vec<usize>>,
    task: AtomicWaker,
}

impl Calls {
    fn places(&self) -> MutexGuard<'_, Vec<usize>> {
        self.places.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What a viewer's socket wakes its group's task with.
struct Ringer {
    place: usize,
    /// It is among the calls; so each viewer is there once.
    has_rung: AtomicBool,
    calls: Arc<Calls>,
}

impl Wake for Ringer {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if !self.has_rung.swap(true, Ordering::AcqRel) {
            self.calls.places().push(self.place);
            self.calls.task.wake();
        }
    }
}

/// A viewer's [`Ringer`], as a waker.
pub(super) struct Bell {
    ringer: Arc<Ringer>,
    waker: Waker,
}

impl Bell {
    fn new(place: usize, calls: Arc<Calls>) -> Self {
        let ringer = Arc::new(Ringer { place, has_rung: AtomicBool::new(false), calls });
        Self { waker: Waker::from(ringer.clone()), ringer }
    }

    /// What polls on the viewer's behalf.
    pub fn context(&self) -> Context<'_> {
        Context::from_waker(&self.waker)
    }
}

/// A viewer in its place.
struct Seated {
    member: Member,
    bell: Bell,
    _seat: OwnedSemaphorePermit,
}

/// Some viewers of a room, and what their task needs.
struct Group {
    hub: Arc<Hub>,
    room: Arc<Room>,
    news: watch::Receiver<Option<Arc<Latest>>>,
    /// Its door's.
    seats: Arc<Semaphore>,
    arrivals: mpsc::UnboundedReceiver<Newcomer>,
    seated: Slab<Seated>,
    calls: Arc<Calls>,
}

impl Group {
    /// Serves its viewers until there are none, or the service ends.
    async fn run(mut self) {
        let timer = tokio::time::sleep(NEVER);
        tokio::pin!(timer);
        loop {
            self.wait(timer.as_mut()).await;
            while let Ok(newcomer) = self.arrivals.try_recv() {
                self.seat(newcomer);
            }
            if *self.hub.shutdown.borrow() {
                return self.close();
            }
            let mut next = self.answer_calls();
            let is_due = Instant::now() >= timer.deadline();
            if is_due || self.news.has_changed().is_ok_and(|changed| changed) {
                next = next.min(self.walk(is_due).await);
            }
            // Mostly what is due is due later than the timer says; then the timer is moved when it fires.
            if is_due || next < timer.deadline() {
                timer.as_mut().reset(next);
            }
            if self.seated.is_empty() && self.leaves() {
                return;
            }
        }
    }

    /// Waits until there is something to do, whatever it is.
    async fn wait(&mut self, timer: Pin<&mut Sleep>) {
        let Self { news, arrivals, calls, .. } = self;
        let called = poll_fn(|cx| {
            calls.task.register(cx.waker());
            if calls.places().is_empty() { Poll::Pending } else { Poll::Ready(()) }
        });
        tokio::select! {
            biased;
            // The sender is the room's, which is held here.
            changed = news.changed() => if changed.is_ok() { news.mark_changed() },
            newcomer = arrivals.recv() => self.seated.reserve(1),
            () = called => {}
            () = timer => {}
        }
    }

    /// Gives a newcomer its place. It is looked at with the calls.
    fn seat(&mut self, Newcomer { member, seat }: Newcomer) {
        let entry = self.seats.vacant_entry();
        let bell = Bell::new(entry.key(), self.calls.clone());
        bell.waker.wake_by_ref();
        entry.insert(Seated { member, bell, _seat: seat });
    }

    /// Looks at all who have called; when one of them is to be looked at next.
    fn answer_calls(&mut self) -> Instant {
        let places = std::mem::take(&mut *self.calls.places());
        let (latest, now) = (self.news.borrow().clone(), Instant::now());
        let mut next = now + NEVER;
        let mut counts = Counts::default();
        for &place in &places {
            let hub = &self.hub;
            // It may have left, or be another's place by now, who is looked at without need.
            let Some(seated) = self.seats.get_mut(place) else { continue };
            let Seated { member, bell, .. } = seated;
            // From here on it may call again.
            bell.ringer.has_rung.store(false, Ordering::Release);
            let looked = member.answer(bell, now).and_then(|()| match &latest {
                Some(latest) => member.show(latest, hub, bell, now, &mut counts),
                None => Ok(()),
            });
            match looked {
                Ok(()) => next = next.min(member.next_tick(hub, now)),
                Err(stop) => self.dismiss(place, stop),
            }
        }
        self.count(&counts);
        next
    }

    /// Shows everybody the newest state, and does what the time asks for where `ticks` says so; when that is next due.
    async fn walk(&mut self, ticks: bool) -> Instant {
        let mut next = Instant::now() + NEVER;
        let mut place = 0;
        while place < self.seats.capacity() {
            // Whoever comes later in the walk sees what is the newest then.
            let (latest, now) = (self.news.borrow_and_update().clone(), Instant::now());
            let mut counts = Counts::default();
            for _ in 0..STRETCH {
                let hub = &self.hub;
                if let Some(Seated { member, bell, .. }) = self.seats.get_mut(place) {
                    let ticked = if ticks { member.tick(hub, bell, now) } else { Ok(()) };
                    let looked = ticked.and_then(|()| match &latest {
                        Some(latest) => member.show(latest, hub, bell, now, &mut counts),
                        None => Ok(()),
                    });
                    match looked {
                        Ok(()) => next = next.min(member.next_tick(hub, now)),
                        Err(stop) => self.dismiss(place, stop),
                    }
                }
                place += 1;
            }
            self.count(&counts);
            if place < self.seats.capacity() {
                tokio::task::yield_now().await;
            }
        }
        next
    }

    fn count(&self, counts: &Counts) {
        let metrics = &self.hub.metrics;
        if counts.frames > 0 {
            metrics.frames_out.inc_by(counts.frames);
            metrics.bytes_out.inc_by(counts.bytes);
        }
        if counts.skipped > 0 {
            metrics.drop_frames("slow_viewer", counts.skipped);
        }
    }

    fn dismiss(&mut self, place: usize, stop: Stop) {
        self.seats.remove(place).member.end(stop, self.hub.clone());
    }

    /// True where nobody is on the way in; then nobody comes any more.
    fn leaves(&mut self) -> bool {
        let mut groups = self.room.audience.groups();
        if !self.arrivals.is_empty() {
            return false;
        }
        self.arrivals.close();
        groups.retain(|door| !door.newcomers.is_closed());
        true
    }

    /// Sends all away: the service ends.
    fn close(mut self) {
        self.room.audience.groups().retain(|door| !door.newcomers.same_channel_as(&self.arrivals));
        self.arrivals.close();
        while let Ok(Newcomer { member, .. }) = self.arrivals.try_recv() {
            member.end(Ending::shutdown().into(), self.hub.clone());
        }
        for Seated { member, .. } in self.seats.drain() {
            member.end(Ending::shutdown().into(), self.hub.clone());
        }
    }
}
