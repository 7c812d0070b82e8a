//! Subscribers of a gateway's records, each with its own bounded queue.
//!
//! In: records, from the one thread that reads the gateway's ring. Out: the same records for each subscriber. A slow
//! subscriber misses records, which are counted for it alone. Nothing waits for a subscriber.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::task::{Poll, Waker};
use std::thread::Thread;
use std::time::{Duration, Instant as Deadline};

use crate::record::{Record, What};

/// The kinds of records that a subscriber wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Interest {
    /// Frames at ports and links.
    pub frames: bool,
    /// Every call of the engine. A replay requires all calls since the engine's start, so subscribe before it.
    pub passes: bool,
}

impl Interest {
    const fn bits(self) -> u8 {
        self.frames as u8 | (self.passes as u8) << 1
    }

    const fn of_bits(bits: u8) -> Self {
        Self { frames: bits & 1 != 0, passes: bits & 2 != 0 }
    }

    const fn covers(self, what: &What) -> bool {
        match what {
            What::Began(_) => true,
            What::Frame(_) => self.frames,
            What::Pass(_) => self.passes,
        }
    }
}

/// The records of a gateway, which may be started more than once. Clones share them.
#[derive(Debug, Clone, Default)]
pub struct Watch(Arc<WatchState>);

#[derive(Debug, Default)]
struct WatchState {
    /// The kinds that any subscriber wants, as bits of [`Interest`].
    wanted: AtomicU8,
    state: Mutex<Wanted>,
}

#[derive(Debug, Default)]
struct Wanted {
    queues: Vec<Arc<Queue>>,
    /// The newest [`What::Began`], for later subscribers.
    began: Option<Arc<Record>>,
    /// The thread that reads the ring, woken by a new subscription.
    reader: Option<Thread>,
    is_closed: bool,
}

/// The queue of one subscriber.
#[derive(Debug)]
struct Queue {
    interest: Interest,
    capacity: usize,
    inner: Mutex<Inner>,
    arrived: Condvar,
}

#[derive(Debug, Default)]
struct Inner {
    waiting: VecDeque<Arrived>,
    missed: u64,
    is_closed: bool,
    waker: Option<Waker>,
}

/// A record for one subscriber.
#[derive(Debug, Clone)]
pub struct Arrived {
    /// The record.
    pub record: Arc<Record>,
    /// Number of records that this subscriber has missed before it.
    pub missed: u64,
}

/// The next item of a subscription.
#[derive(Debug, Clone)]
pub enum Next {
    /// A record.
    Record(Arrived),
    /// Nothing arrived before the timeout.
    Nothing,
    /// Nothing more will arrive.
    End,
}

/// A subscriber. Dropping it ends the subscription.
#[derive(Debug)]
pub struct Subscription {
    queue: Arc<Queue>,
    shared: Arc<WatchState>,
}

impl Watch {
    /// A gateway that was not started.
    pub fn new() -> Self {
        Self::default()
    }

    /// Subscribes. At most `capacity` records, and at least 1, wait to be taken; further records are missed.
    pub fn subscribe(&self, interest: Interest, capacity: usize) -> Subscription {
        let queue = Arc::new(Queue {
            interest,
            capacity: capacity.max(1),
            inner: Mutex::default(),
            arrived: Condvar::new(),
        });
        let mut state = locked(&self.0.state);
        if let Some(began) = &state.began {
            queue.give(began);
        }
        if state.is_closed {
            queue.close();
        } else {
            state.queues.push(Arc::clone(&queue));
        }
        self.0.note_wanted(&state);
        if let Some(reader) = &state.reader {
            reader.unpark();
        }
        Subscription { queue, shared: Arc::clone(&self.0) }
    }

    /// The kinds of records that any subscriber wants. Costs one relaxed load.
    #[inline]
    pub fn wanted(&self) -> Interest {
        Interest::of_bits(self.0.wanted.load(Ordering::Relaxed))
    }

    /// Registers the current thread to be woken by a new subscription.
    pub fn read_here(&self) {
        locked(&self.0.state).reader = Some(std::thread::current());
    }

    /// Delivers a record to all interested subscribers.
    pub fn give(&self, record: Record) {
        let record = Arc::new(record);
        let mut state = locked(&self.0.state);
        if let What::Began(_) = record.what {
            state.began = Some(Arc::clone(&record));
        }
        for queue in &state.queues {
            queue.give(&record);
        }
    }

    /// Ends all subscriptions after their waiting records.
    pub fn close(&self) {
        let mut state = locked(&self.0.state);
        state.is_closed = true;
        for queue in state.queues.drain(..) {
            queue.close();
        }
        self.0.note_wanted(&state);
    }
}

impl WatchState {
    fn note_wanted(&self, state: &Wanted) {
        let wanted = state.queues.iter().fold(0, |wanted, queue| wanted | queue.interest.bits());
        self.wanted.store(wanted, Ordering::Relaxed);
    }
}

impl Queue {
    fn give(&self, record: &Arc<Record>) {
        if !self.interest.covers(&record.what) {
            return;
        }
        let mut inner = locked(&self.inner);
        if inner.waiting.len() >= self.capacity {
            inner.missed += 1;
            return;
        }
        let missed = std::mem::take(&mut inner.missed);
        inner.waiting.push_back(Arrived { record: Arc::clone(record), missed });
        self.wake(inner);
    }

    fn close(&self) {
        let mut inner = locked(&self.inner);
        inner.is_closed = true;
        self.wake(inner);
    }

    fn wake(&self, mut inner: MutexGuard<'_, Inner>) {
        let waker = inner.waker.take();
        drop(inner);
        self.arrived.notify_one();
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

impl Inner {
    fn next(&mut self) -> Next {
        match self.waiting.pop_front() {
            Some(arrived) => Next::Record(arrived),
            None if self.is_closed => Next::End,
            None => Next::Nothing,
        }
    }
}

impl Subscription {
    /// The next record; waits at most `timeout` for it.
    pub fn next(&self, timeout: Duration) -> Next {
        let deadline = Deadline::now() + timeout;
        let mut inner = locked(&self.queue.inner);
        loop {
            let next = inner.next();
            let left = deadline.saturating_duration_since(Deadline::now());
            if !matches!(next, Next::Nothing) || left.is_zero() {
                return next;
            }
            let waited = self.queue.arrived.wait_timeout(inner, left);
            inner = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// The next record, for an async task; `None` if nothing more will arrive.
    pub async fn arrived(&self) -> Option<Arrived> {
        poll_fn(|context| {
            let mut inner = locked(&self.queue.inner);
            match inner.next() {
                Next::Record(arrived) => Poll::Ready(Some(arrived)),
                Next::End => Poll::Ready(None),
                Next::Nothing => {
                    inner.waker = Some(context.waker().clone());
                    Poll::Pending
                }
            }
        })
        .await
    }

    /// Number of records missed since the newest arrived record.
    pub fn missed(&self) -> u64 {
        locked(&self.queue.inner).missed
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut state = locked(&self.shared.state);
        state.queues.retain(|queue| !Arc::ptr_eq(queue, &self.queue));
        self.shared.note_wanted(&state);
    }
}

/// No code that holds these locks can panic half way.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proto_core::time::Instant;

    const FRAMES: Interest = Interest { frames: true, passes: false };
    const PASSES: Interest = Interest { frames: false, passes: true };

    fn pass(nth: u64) -> Record {
        Record { at: Instant::from_micros(nth), lost: 0, what: What::Pass(Box::default()) }
    }

    fn taken(subscription: &Subscription) -> Option<(u64, u64)> {
        match subscription.next(Duration::ZERO) {
            Next::Record(Arrived { record, missed }) => Some((record.at.as_micros(), missed)),
            _ => None,
        }
    }

    #[test]
    fn a_subscriber_that_stalls_misses_records_and_no_other_does() {
        let watch = Watch::new();
        let (stalled, other) = (watch.subscribe(PASSES, 3), watch.subscribe(PASSES, 3));
        for nth in 0..100 {
            watch.give(pass(nth));
            assert_eq!(taken(&other), Some((nth, 0)));
        }
        assert_eq!(stalled.missed(), 97);
        assert_eq!(
            [taken(&stalled), taken(&stalled), taken(&stalled)],
            [Some((0, 0)), Some((1, 0)), Some((2, 0))]
        );
        watch.give(pass(100));
        assert_eq!(taken(&stalled), Some((100, 97)), "how many are missing is told at the gap");
        assert_eq!(taken(&stalled), None);
    }

    #[test]
    fn what_is_wanted_is_what_subscribers_want() {
        let watch = Watch::new();
        assert_eq!(watch.wanted(), Interest::default());
        let frames = watch.subscribe(FRAMES, 1);
        let passes = watch.subscribe(PASSES, 1);
        assert_eq!(watch.wanted(), Interest { frames: true, passes: true });
        drop(frames);
        assert_eq!(watch.wanted(), PASSES);
        watch.give(pass(1));
        assert_eq!(taken(&passes), Some((1, 0)));
        watch.close();
        assert_eq!(watch.wanted(), Interest::default());
        assert!(matches!(passes.next(Duration::from_secs(60)), Next::End));
        assert!(matches!(watch.subscribe(FRAMES, 1).next(Duration::from_secs(60)), Next::End));
    }

    #[test]
    fn who_waits_is_woken() {
        let watch = Watch::new();
        let subscription = watch.subscribe(PASSES, 8);
        let waiting = std::thread::spawn(move || subscription.next(Duration::from_secs(60)));
        watch.give(pass(7));
        assert!(matches!(waiting.join().unwrap(), Next::Record(_)));
    }
}
