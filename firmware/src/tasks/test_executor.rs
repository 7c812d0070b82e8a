//! An executor that runs tasks like that of a board: woken tasks run once in a round, the one woken last first.
//! Tasks woken during a round run in the next.

use core::future::Future;
use core::pin::Pin;
use core::task::Context;
use std::boxed::Box;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Wake, Waker};
use std::vec::Vec;

/// An executor whose tasks may live as long as `'a`.
pub(crate) struct Executor<'a> {
    tasks: Vec<(BoxedTask<'a>, Waker)>,
    woken: Arc<Mutex<Vec<usize>>>,
    order: WakeOrder,
}

type BoxedTask<'a> = Pin<Box<dyn Future<Output = ()> + 'a>>;

/// The order of the woken tasks, on which nothing may depend.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WakeOrder {
    LastFirst,
    FirstFirst,
}

impl WakeOrder {
    pub(crate) const ALL: [Self; 2] = [Self::LastFirst, Self::FirstFirst];
}

struct Task {
    index: usize,
    woken: Arc<Mutex<Vec<usize>>>,
}

impl Wake for Task {
    fn wake(self: Arc<Self>) {
        let mut woken = self.woken.lock().unwrap_or_else(PoisonError::into_inner);
        if !woken.contains(&self.index) {
            woken.push(self.index);
        }
    }
}

impl<'a> Executor<'a> {
    pub(crate) fn new(order: WakeOrder) -> Self {
        Self { tasks: Vec::new(), woken: Arc::default(), order }
    }

    /// Adds a task that never ends; it runs in the next round.
    pub(crate) fn spawn(&mut self, task: impl Future + 'a) {
        let waker = Waker::from(Arc::new(Task { index: self.tasks.len(), woken: Arc::clone(&self.woken) }));
        waker.wake_by_ref();
        let task = Box::pin(async move {
            task.await;
            unreachable!("a task does not end");
        });
        self.tasks.push((task, waker));
    }

    /// Runs each woken task once; returns whether there was one.
    pub(crate) fn round(&mut self) -> bool {
        let mut batch = core::mem::take(&mut *self.woken.lock().unwrap());
        if self.order == WakeOrder::LastFirst {
            batch.reverse();
        }
        for &index in &batch {
            let (task, waker) = &mut self.tasks[index];
            assert!(task.as_mut().poll(&mut Context::from_waker(waker)).is_pending());
        }
        !batch.is_empty()
    }

    /// Runs until no task is woken.
    pub(crate) fn settle(&mut self) {
        let rounds = (0..1_000).take_while(|_| self.round()).count();
        assert!(rounds < 1_000, "a task wakes itself for ever");
    }
}
