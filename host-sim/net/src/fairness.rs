//! Who has a turn when on a shell's thread, where everybody who has something to do is served in order.

use std::cell::Cell;
use std::rc::Rc;

use proto_core::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::task::yield_now;

use super::timer::now;

thread_local! {
    static TURN: Rc<Semaphore> = Rc::new(Semaphore::new(1));
    /// How many have more to do than their turn allowed.
    static UNFINISHED: Cell<usize> = const { Cell::new(0) };
    /// The next deadline of this thread's engine, until it has been told that it has passed.
    static DEADLINE: Cell<Instant> = const { Cell::new(Instant::NEVER) };
}

/// For those who come back at once: sockets and timers are looked at and all others served before this
/// returns, and of those that wait here only one goes on each time. So however many send without end, no
/// deadline waits for more than one of them.
pub async fn give_way() {
    let _unfinished = Unfinished::new();
    let turn = TURN.with(Rc::clone);
    let _mine = turn.acquire().await;
    yield_now().await;
}

struct Unfinished;

impl Unfinished {
    fn new() -> Self {
        UNFINISHED.set(UNFINISHED.get() + 1);
        Self
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        UNFINISHED.set(UNFINISHED.get() - 1);
    }
}

/// The engine of this thread wants to be told when `deadline` has passed.
pub fn expect(deadline: Instant) {
    DEADLINE.set(deadline);
}

/// For who is to tell that the deadline has passed: first everybody takes what had come by then.
///
/// tokio looks at the sockets before it lets go on who has yielded, and everybody who has something is
/// served once. That is enough on time. When the thread was kept from looking, more may wait than one turn
/// takes: then until all of it is taken, but not for long, since it may have no end.
pub async fn all_others() {
    yield_now().await;
    let mut before = now();
    if held_up_at(before).is_none() {
        return;
    }
    let (mut spent, mut quiet_rounds) = (Duration::ZERO, 0);
    // One round more than anybody needs: what one took he may have passed on to another.
    while quiet_rounds < 2 && spent < CATCHING_UP {
        yield_now().await;
        let round = now().saturating_since(before);
        before += round;
        // The thread may be held up once more.
        let is_quiet = UNFINISHED.get() == 0 && round < HELD_UP;
        quiet_rounds = if is_quiet { quiet_rounds + 1 } else { 0 };
        spent = spent + round.min(HELD_UP);
    }
}

/// When what is read now arrived: now, but by the deadline that this thread should have kept if it was kept
/// from looking.
pub fn arrival() -> Instant {
    let now = now();
    held_up_at(now).unwrap_or(now)
}

fn held_up_at(now: Instant) -> Option<Instant> {
    let deadline = DEADLINE.get();
    (now.saturating_since(deadline) >= HELD_UP).then_some(deadline)
}

/// What others do takes less, so being this late has another reason.
const HELD_UP: Duration = Duration::from_millis(5);
/// How much later a deadline is told so that more of what came before it is told first.
const CATCHING_UP: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::task::{JoinSet, LocalSet};

    #[test]
    fn of_many_that_never_stop_one_goes_on_at_a_time() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let turns = Rc::new(Cell::new(0));
            let mut tasks = JoinSet::new();
            for _ in 0..50 {
                let turns = Rc::clone(&turns);
                tasks.spawn_local(async move {
                    loop {
                        turns.set(turns.get() + 1);
                        give_way().await;
                    }
                });
            }
            yield_now().await;
            let begun = turns.get();
            for _ in 0..100 {
                yield_now().await;
            }
            let taken = turns.get() - begun;
            assert!((50..=101).contains(&taken), "{taken} in 100 rounds");
        });
    }

    #[test]
    fn who_never_ends_does_not_keep_a_late_deadline_from_being_told() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let turns = Rc::new(Cell::new(0));
            let own = Rc::clone(&turns);
            tokio::task::spawn_local(async move {
                loop {
                    own.set(own.get() + 1);
                    give_way().await;
                }
            });
            expect(now() + Duration::from_secs(3_600));
            all_others().await;
            let on_time = turns.get();
            expect(now() - HELD_UP);
            all_others().await;
            assert!((1..5).contains(&on_time), "{on_time}");
            assert!(turns.get() > 2 * on_time, "it had time to catch up");
        });
    }
}
