//! Who has a turn when on a shell's thread, where everybody who has something to do is served in order.

use std::rc::Rc;

use tokio::sync::Semaphore;

thread_local! {
    static TURN: Rc<Semaphore> = Rc::new(Semaphore::new(1));
}

/// For those who come back at once: sockets and timers are looked at and all others served before this
/// returns, and of those that wait here only one goes on each time. So however many send without end, no
/// deadline waits for more than one of them.
pub(crate) async fn give_way() {
    let turn = TURN.with(Rc::clone);
    let _mine = turn.acquire().await;
    tokio::task::yield_now().await;
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;
    use tokio::task::{JoinSet, LocalSet, yield_now};

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
}
