use core::future::{pending, ready};
use core::pin::pin;
use core::task::{Context, Poll};
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::task::{Wake, Waker};
use std::vec::Vec;

use super::*;

const ENGINE: TaskName = TaskName::Engine;
const CAN: TaskName = TaskName::Can(PortId(2));

#[derive(Default)]
struct Wakes(AtomicUsize);

impl Wake for Wakes {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// One round: whether the watchdog is fed, and what is logged.
fn round<const N: usize>(watch: &TaskWatch<N>) -> (bool, Vec<(TaskName, PulseFault)>) {
    let mut told = Vec::new();
    let fed = watch.round(|name, answer| told.push((name, answer)));
    (fed, told)
}

#[test]
fn fed_as_long_as_every_task_answers_and_the_one_that_does_not_is_named_once() {
    let watch = TaskWatch::<4>::new();
    let (engine, can) = (watch.register(ENGINE).unwrap(), watch.register(CAN).unwrap());
    let mut cx = Context::from_waker(Waker::noop());
    let (mut at_engine, mut at_can) = (pin!(pending::<()>()), pin!(pending::<()>()));
    let mut engine = pin!(engine.idle(at_engine.as_mut()));
    let mut can = pin!(can.idle(at_can.as_mut()));
    for _ in 0..3 {
        assert!(engine.as_mut().poll(&mut cx).is_pending());
        assert!(can.as_mut().poll(&mut cx).is_pending());
        assert_eq!(round(&watch), (true, Vec::new()));
    }
    assert!(engine.as_mut().poll(&mut cx).is_pending());
    assert_eq!(round(&watch), (false, [(CAN, PulseFault::Missing)].into()));
    for _ in 0..3 {
        assert!(engine.as_mut().poll(&mut cx).is_pending());
        assert_eq!(round(&watch), (false, Vec::new()));
    }
    assert!(can.as_mut().poll(&mut cx).is_pending());
    assert_eq!(round(&watch), (true, [(CAN, PulseFault::Late)].into()));
}

#[test]
fn a_task_that_never_began_starves_the_dog() {
    let watch = TaskWatch::<4>::new();
    watch.register(ENGINE).unwrap();
    assert_eq!(round(&watch), (false, [(ENGINE, PulseFault::Missing)].into()));
}

#[test]
fn the_question_wakes_a_task_that_waits() {
    let watch = TaskWatch::<1>::new();
    let pulse = watch.register(ENGINE).unwrap();
    let wakes = Arc::new(Wakes::default());
    let waker = Waker::from(wakes.clone());
    let mut nothing = pin!(pending::<()>());
    let mut waiting = pin!(pulse.idle(nothing.as_mut()));
    let mut cx = Context::from_waker(&waker);
    assert!(waiting.as_mut().poll(&mut cx).is_pending());
    assert_eq!(wakes.0.load(Ordering::Relaxed), 0);
    assert!(round(&watch).0);
    assert_eq!(wakes.0.load(Ordering::Relaxed), 1);
    // Being woken is not an answer.
    assert!(!round(&watch).0);
    assert!(waiting.as_mut().poll(&mut cx).is_pending());
    assert!(round(&watch).0);
}

/// A task that always has something to do never waits, but has to answer.
#[test]
fn what_is_there_at_once_is_an_answer_too() {
    let watch = TaskWatch::<1>::new();
    let pulse = watch.register(ENGINE).unwrap();
    let mut value = pin!(ready(7));
    let mut cx = Context::from_waker(Waker::noop());
    assert_eq!(pin!(pulse.idle(value.as_mut())).poll(&mut cx), Poll::Ready(7));
    assert!(round(&watch).0);
}

#[test]
fn no_more_than_there_is_room_for_is_registered() {
    let watch = TaskWatch::<1>::new();
    assert!(watch.register(ENGINE).is_some());
    assert!(watch.register(CAN).is_none());
}

#[test]
fn the_task_that_has_the_processor_is_known_by_name() {
    let port = PortId(3);
    let names = [
        ENGINE,
        TaskName::Serial(port),
        TaskName::Can(port),
        TaskName::Link(LinkKind::Command),
        TaskName::Link(LinkKind::Urgent),
        TaskName::Link(LinkKind::State),
        TaskName::Link(LinkKind::Modbus),
        TaskName::Link(LinkKind::RecipeUdp),
        TaskName::Link(LinkKind::RecipeTcpListen { port }),
        TaskName::Link(LinkKind::RecipeUdpListen { port }),
        TaskName::Link(LinkKind::ModbusDevice { port }),
        TaskName::Network,
        TaskName::Address,
        TaskName::Status,
        TaskName::Led,
        TaskName::Refused,
        TaskName::Board(3),
    ];
    let watch = TaskWatch::<17>::new();
    let mut cx = Context::from_waker(Waker::noop());
    for name in names {
        let pulse = watch.register(name).unwrap();
        let mut task = pin!(async { running() });
        let mut run = pin!(pulse.run(task.as_mut()));
        assert_eq!(run.as_mut().poll(&mut cx), Poll::Ready(Some(name)));
        assert_eq!(running(), None);
    }
}
