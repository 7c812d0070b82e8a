//! Fair scheduling of the tasks on a runtime's thread: a peer that sends without end must delay neither other tasks nor
//! the engine's deadlines.

use std::cell::Cell;
use std::future::poll_fn;
use std::pin::pin;
use std::rc::Rc;
use std::task::Poll;

use proto_core::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::task::yield_now;

use super::timer::now;

thread_local! {
    static TURN: Rc<Semaphore> = Rc::new(Semaphore::new(1));
    /// Number of tasks in [`yield_fairly`].
    static WAITING: Cell<usize> = const { Cell::new(0) };
    /// The next deadline of the engine whose task is running.
    static DEADLINE: Cell<Instant> = const { Cell::new(Instant::NEVER) };
}

/// Yields, for a task that has more to do at once. tokio polls sockets and timers and runs all other tasks before this
/// returns, and only one of the tasks that wait here continues each time. A deadline thus waits for at most one busy
/// task, however many there are.
pub async fn yield_fairly() {
    let _waiting = WaitingTask::new();
    let turn = TURN.with(Rc::clone);
    let _permit = turn.acquire().await;
    yield_now().await;
}

/// Lets all tasks that are ready run first. Unlike tokio's yield, it polls neither sockets nor timers.
pub async fn give_way() {
    let mut has_given = false;
    poll_fn(|cx| {
        if has_given {
            return Poll::Ready(());
        }
        has_given = true;
        cx.waker().wake_by_ref();
        Poll::Pending
    })
    .await;
}

/// Which of two futures were ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Either<L, R> {
    /// The left one.
    Left(L),
    /// The right one.
    Right(R),
}

/// Which of two futures is polled first, and wins if both are ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Polls the left one first.
    LeftFirst,
    /// Polls the right one first.
    RightFirst,
}

/// Waits for one of two futures and drops the other. The order may change from call to call, so neither starves. Cancel
/// safe if both are.
pub async fn either<L, R>(
    left: impl Future<Output = L>,
    right: impl Future<Output = R>,
    order: Order,
) -> Either<L, R> {
    let (mut left, mut right) = (pin!(left), pin!(right));
    poll_fn(|cx| {
        if order == Order::LeftFirst
            && let Poll::Ready(done) = left.as_mut().poll(cx)
        {
            return Poll::Ready(Either::Left(done));
        }
        if let Poll::Ready(done) = right.as_mut().poll(cx) {
            return Poll::Ready(Either::Right(done));
        }
        if order == Order::RightFirst
            && let Poll::Ready(done) = left.as_mut().poll(cx)
        {
            return Poll::Ready(Either::Left(done));
        }
        Poll::Pending
    })
    .await
}

/// Whether a task waits in [`yield_fairly`].
pub fn is_anyone_busy() -> bool {
    WAITING.get() > 0
}

struct WaitingTask;

impl WaitingTask {
    fn new() -> Self {
        WAITING.set(WAITING.get() + 1);
        Self
    }
}

impl Drop for WaitingTask {
    fn drop(&mut self) {
        WAITING.set(WAITING.get() - 1);
    }
}

/// Sets the next deadline of the engine to which the running task belongs, for [`let_others_run`] and [`arrival_time`].
/// The deadline is that of the surrounding [`apart`], or else of this thread.
pub fn set_deadline(deadline: Instant) {
    DEADLINE.set(deadline);
}

/// Gives an engine and its tasks a deadline of their own where several engines share a thread. All tasks must be polled
/// within `work`, as those of a [`LocalSet`](tokio::task::LocalSet) that it runs are.
pub async fn apart<F: Future>(work: F) -> F::Output {
    let mut work = pin!(work);
    let mut own = Instant::NEVER;
    poll_fn(|cx| {
        let outer = DEADLINE.replace(own);
        let polled = work.as_mut().poll(cx);
        own = DEADLINE.replace(outer);
        polled
    })
    .await
}

/// Lets all other tasks report input that had arrived by the deadline, before the engine handles it.
///
/// tokio polls the sockets before a task that has yielded continues, and runs each task that has input once. That is
/// enough if the deadline is kept. If the thread was blocked, more input may wait than a task reads at once: then this
/// waits until all of it is read, but only for a bounded time, because the input may be endless.
pub async fn let_others_run() {
    yield_now().await;
    let mut before = now();
    if missed_deadline(before).is_none() {
        return;
    }
    let (mut spent, mut idle_rounds) = (Duration::ZERO, 0);
    // Two, because a task may have passed input on to another task.
    while idle_rounds < 2 && spent < MAX_CATCH_UP {
        yield_now().await;
        let round = now().saturating_since(before);
        before += round;
        // The thread may have been blocked again.
        let is_idle = WAITING.get() == 0 && round < BLOCKED;
        idle_rounds = if is_idle { idle_rounds + 1 } else { 0 };
        spent = spent + round.min(BLOCKED);
    }
}

/// The latest time at which input that is read now can have arrived: now, or its engine's deadline if the thread was
/// blocked at the deadline.
pub fn arrival_time() -> Instant {
    let now = now();
    missed_deadline(now).unwrap_or(now)
}

fn missed_deadline(now: Instant) -> Option<Instant> {
    let deadline = DEADLINE.get();
    (now.saturating_since(deadline) >= BLOCKED).then_some(deadline)
}

/// A deadline missed by this much means that the thread was blocked: other tasks take less time.
const BLOCKED: Duration = Duration::from_millis(5);
/// How long [`let_others_run`] waits for late input, without the time for which the thread was blocked.
const MAX_CATCH_UP: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;
    use tokio::task::{JoinSet, LocalSet};

    #[test]
    fn of_many_busy_tasks_one_continues_at_a_time() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let turns = Rc::new(Cell::new(0));
            let mut tasks = JoinSet::new();
            for _ in 0..50 {
                let turns = Rc::clone(&turns);
                tasks.spawn_local(async move {
                    loop {
                        turns.set(turns.get() + 1);
                        yield_fairly().await;
                    }
                });
            }
            yield_now().await;
            let before = turns.get();
            for _ in 0..100 {
                yield_now().await;
            }
            let taken = turns.get() - before;
            assert!((50..=101).contains(&taken), "{taken} in 100 rounds");
        });
    }

    #[test]
    fn who_gives_way_runs_after_the_tasks_that_can_run() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let order = Rc::new(RefCell::new(Vec::new()));
            let mut tasks = JoinSet::new();
            for name in ["gives way", "can run"] {
                let order = Rc::clone(&order);
                tasks.spawn_local(async move {
                    if name == "gives way" {
                        give_way().await;
                    }
                    order.borrow_mut().push(name);
                });
            }
            tasks.join_all().await;
            assert_eq!(*order.borrow(), ["can run", "gives way"]);
        });
    }

    #[test]
    fn of_two_that_are_ready_the_order_decides() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(async {
            let ready = |order| either(std::future::ready(1), std::future::ready(2), order);
            assert_eq!(ready(Order::LeftFirst).await, Either::Left(1));
            assert_eq!(ready(Order::RightFirst).await, Either::Right(2));
            for order in [Order::LeftFirst, Order::RightFirst] {
                assert_eq!(either(std::future::pending::<()>(), yield_now(), order).await, Either::Right(()));
                assert_eq!(either(yield_now(), std::future::pending::<()>(), order).await, Either::Left(()));
            }
        });
    }

    #[test]
    fn engines_of_one_thread_have_deadlines_of_their_own() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let late = now() - BLOCKED;
            let engine = |deadline| async move {
                let tasks = LocalSet::new();
                let arrived = tasks.run_until(async move {
                    set_deadline(deadline);
                    // The other one sets its own before this one goes on.
                    yield_now().await;
                    tokio::task::spawn_local(async { arrival_time() }).await.unwrap()
                });
                apart(arrived).await
            };
            let (missed, kept) = tokio::join!(engine(late), engine(now() + Duration::from_secs(3_600)));
            assert_eq!(missed, late);
            assert!(kept > late, "{kept:?}");
            assert!(arrival_time() >= kept, "outside nothing is late");
        });
    }

    #[test]
    fn a_busy_task_does_not_delay_a_missed_deadline_for_ever() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let turns = Rc::new(Cell::new(0));
            let own = Rc::clone(&turns);
            tokio::task::spawn_local(async move {
                loop {
                    own.set(own.get() + 1);
                    yield_fairly().await;
                }
            });
            set_deadline(now() + Duration::from_secs(3_600));
            let_others_run().await;
            let on_time = turns.get();
            set_deadline(now() - BLOCKED);
            let_others_run().await;
            assert!((1..5).contains(&on_time), "{on_time}");
            assert!(turns.get() > 2 * on_time, "it had time to catch up");
        });
    }
}
