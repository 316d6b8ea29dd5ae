//! The viewers of a room, in groups. Each group has one task, which writes a new state to one viewer after the other.
//!
//! A task for each viewer would cost a frame as much again as the kernel's send leaves: its wake-up, and the way of everything
//! that it holds into the cache. One task for all would keep a large room on one core.

use super::member::{Counts, Member};
use crate::lock::lock;
use crate::room::{Latest, Room};
use crate::service::Hub;
use crate::socket::{Ending, Stop};
use futures_util::task::AtomicWaker;
use slab::Slab;
use std::collections::VecDeque;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Wake, Waker};
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::{coop, yield_now};
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
    groups: Mutex<Vec<Arc<Lobby>>>,
}

/// Where a group's task is called.
struct Lobby {
    /// One for each viewer that may be in the group.
    free: Arc<Semaphore>,
    newcomers: Mutex<Vec<Newcomer>>,
    /// Seats of those who have called, about once each.
    calls: Mutex<VecDeque<usize>>,
    task: AtomicWaker,
}

/// A viewer on its way in. The permit is given back when it is dropped.
struct Newcomer {
    member: Member,
    permit: OwnedSemaphorePermit,
}

impl Audience {
    /// Serves `member` from now on.
    pub fn enter(&self, hub: &Arc<Hub>, member: Member) {
        let mut groups = lock(&self.groups);
        let found = groups.iter().find_map(|lobby| Some((lobby, lobby.free.clone().try_acquire_owned().ok()?)));
        if let Some((lobby, permit)) = found {
            return lobby.enter(Newcomer { member, permit });
        }
        let free = Arc::new(Semaphore::new(GROUP));
        let permit = free.clone().try_acquire_owned().expect("nobody else knows of it");
        let lobby = Arc::new(Lobby { free, newcomers: Mutex::default(), calls: Mutex::default(), task: AtomicWaker::new() });
        let viewing = member.viewing();
        let (room, news) = (viewing.room.clone(), viewing.slot.clone());
        lobby.enter(Newcomer { member, permit });
        groups.push(lobby.clone());
        tokio::spawn(Group { hub: hub.clone(), room, news, lobby, seats: Slab::new() }.run());
    }
}

impl Lobby {
    /// Called under the groups' lock, so that a group that leaves their list has no newcomer.
    fn enter(&self, newcomer: Newcomer) {
        lock(&self.newcomers).push(newcomer);
        self.task.wake();
    }

    /// Ready when there is somebody.
    fn poll(&self, cx: &Context<'_>) -> Poll<()> {
        self.task.register(cx.waker());
        let is_empty = lock(&self.newcomers).is_empty() && lock(&self.calls).is_empty();
        if is_empty { Poll::Pending } else { Poll::Ready(()) }
    }
}

/// What a viewer's socket wakes its group's task with.
struct Ringer {
    seat: usize,
    /// The seat is among the calls.
    has_rung: AtomicBool,
    lobby: Arc<Lobby>,
}

impl Wake for Ringer {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if !self.has_rung.swap(true, Ordering::AcqRel) {
            lock(&self.lobby.calls).push_back(self.seat);
            self.lobby.task.wake();
        }
    }
}

/// A viewer's [`Ringer`], as a waker.
pub(super) struct Bell {
    ringer: Arc<Ringer>,
    waker: Waker,
}

impl Bell {
    /// Rung, so that the viewer is looked at.
    fn ringing(seat: usize, lobby: Arc<Lobby>) -> Self {
        let ringer = Arc::new(Ringer { seat, has_rung: AtomicBool::new(false), lobby });
        let waker = Waker::from(ringer.clone());
        waker.wake_by_ref();
        Self { ringer, waker }
    }

    /// What polls on the viewer's behalf.
    pub fn context(&self) -> Context<'_> {
        Context::from_waker(&self.waker)
    }
}

/// A viewer in its seat.
struct Seated {
    member: Member,
    bell: Bell,
    _permit: OwnedSemaphorePermit,
}

/// Some viewers of a room, and what their task needs.
struct Group {
    hub: Arc<Hub>,
    room: Arc<Room>,
    news: watch::Receiver<Option<Arc<Latest>>>,
    lobby: Arc<Lobby>,
    seats: Slab<Seated>,
}

impl Group {
    /// Serves its viewers until there are none, or the service ends.
    async fn run(mut self) {
        let timer = tokio::time::sleep(NEVER);
        tokio::pin!(timer);
        loop {
            let has_news = self.wait(timer.as_mut()).await;
            self.let_in();
            if *self.hub.shutdown.borrow() {
                return self.close();
            }
            if !coop::has_budget_remaining() {
                yield_now().await;
            }
            let mut next = self.answer_calls();
            let is_due = Instant::now() >= timer.deadline();
            if has_news || is_due {
                next = next.min(self.walk(is_due).await);
            }
            // Mostly what is due is due later than the timer says; then the timer is moved when it fires.
            if is_due || next < timer.deadline() {
                timer.as_mut().reset(next);
            }
            if self.seats.is_empty() && self.leaves() {
                return;
            }
        }
    }

    /// Waits until there is something to do; true where it is a new state.
    async fn wait(&mut self, timer: Pin<&mut Sleep>) -> bool {
        tokio::select! {
            biased;
            // Its sender is the room's, which is held here.
            _ = self.news.changed() => true,
            () = poll_fn(|cx| self.lobby.poll(cx)) => false,
            () = timer => false,
        }
    }

    /// Gives newcomers their seats. They are looked at with the calls.
    fn let_in(&mut self) {
        let newcomers = std::mem::take(&mut *lock(&self.lobby.newcomers));
        for Newcomer { member, permit } in newcomers {
            let entry = self.seats.vacant_entry();
            let bell = Bell::ringing(entry.key(), self.lobby.clone());
            entry.insert(Seated { member, bell, _permit: permit });
        }
    }

    /// Looks at those who have called, some at a time; when one of them is to be looked at next.
    fn answer_calls(&mut self) -> Instant {
        let mut seats: VecDeque<usize> = {
            let mut calls = lock(&self.lobby.calls);
            let num = calls.len().min(STRETCH);
            calls.drain(..num).collect()
        };
        let next = self.look(
            || seats.pop_front(),
            |seated, now| {
                // From here on it may call again.
                seated.bell.ringer.has_rung.store(false, Ordering::Release);
                seated.member.answer(&seated.bell, now)
            },
        );
        if !seats.is_empty() {
            // It is their turn before those who have called since.
            let mut calls = lock(&self.lobby.calls);
            seats.into_iter().rev().for_each(|seat| calls.push_front(seat));
            self.lobby.task.wake();
        }
        next
    }

    /// Shows everybody the newest state, and does what the time asks for where `is_due`; when that is due again. Who calls or comes in
    /// between is looked at in between: a walk through a group, with the tasks of other groups in its pauses, may take long.
    async fn walk(&mut self, is_due: bool) -> Instant {
        let mut next = Instant::now() + NEVER;
        let mut seat = 0;
        let hub = self.hub.clone();
        loop {
            let mut num_left = STRETCH.min(self.seats.capacity().saturating_sub(seat));
            let stretch = || {
                num_left = num_left.checked_sub(1)?;
                seat += 1;
                Some(seat - 1)
            };
            let tick = |seated: &mut Seated, now| if is_due { seated.member.tick(&hub, &seated.bell, now) } else { Ok(()) };
            next = next.min(self.look(stretch, tick));
            if seat >= self.seats.capacity() {
                return next;
            }
            yield_now().await;
            self.let_in();
            next = next.min(self.answer_calls());
        }
    }

    /// Does `first` with those who sit in `seats` and shows them the newest state; who must go goes. When one of them is to be looked
    /// at next.
    ///
    /// Ends early where the task has done so much that the runtime lets it do no more before its next pause: a socket would seem to
    /// take and give nothing.
    fn look(
        &mut self,
        mut seats: impl FnMut() -> Option<usize>,
        mut first: impl FnMut(&mut Seated, Instant) -> Result<(), Stop>,
    ) -> Instant {
        // Not marked as seen: it is news for those who are not looked at here.
        let (latest, now) = (self.news.borrow().clone(), Instant::now());
        let mut next = now + NEVER;
        let mut counts = Counts::default();
        while coop::has_budget_remaining()
            && let Some(seat) = seats()
        {
            // Who called may have left, or left the seat to another, who is looked at without need.
            let Some(seated) = self.seats.get_mut(seat) else { continue };
            let looked = first(seated, now).and_then(|()| match &latest {
                Some(latest) => seated.member.show(latest, &self.hub, &seated.bell, now, &mut counts),
                None => Ok(()),
            });
            match looked {
                Ok(()) => next = next.min(seated.member.next_tick(&self.hub, now)),
                Err(stop) => self.seats.remove(seat).member.end(stop, self.hub.clone()),
            }
        }
        counts.add_to(&self.hub.metrics);
        next
    }

    /// True where nobody is on the way in; then nobody comes any more.
    fn leaves(&self) -> bool {
        let mut groups = lock(&self.room.audience.groups);
        let leaves = lock(&self.lobby.newcomers).is_empty();
        if leaves {
            groups.retain(|lobby| !Arc::ptr_eq(lobby, &self.lobby));
        }
        leaves
    }

    /// Sends all away: the service ends.
    fn close(&mut self) {
        while !self.leaves() {
            self.let_in();
        }
        for Seated { member, .. } in self.seats.drain() {
            member.end(Ending::shutdown().into(), self.hub.clone());
        }
    }
}

impl Drop for Group {
    /// However the task ends, nobody enters a group without one.
    fn drop(&mut self) {
        lock(&self.room.audience.groups).retain(|lobby| !Arc::ptr_eq(lobby, &self.lobby));
        // Behind the lock: a viewer that goes takes others.
        drop(std::mem::take(&mut *lock(&self.lobby.newcomers)));
    }
}
