//! Gateways that break what is promised of devices: the judge finds each of them.

use std::cell::RefCell;
use std::rc::Rc;

use proto_core::config::{Bus, Echo};
use proto_core::engine::{Input, LinkId, Output, PortId};
use proto_core::time::{Duration, Instant};

use crate::corruption::{Forged, Inward, Outward};
use crate::soak::{Level, Scenario, Soak};
use crate::{Cell, Invariant};

const PORT: PortId = PortId(0);
const MS: fn(u64) -> Duration = Duration::from_millis;

/// Runs of three minutes until the judge finds something; returns what, and after how many virtual minutes.
fn found(name: &str, runs: u64, corruption: impl Fn(&mut Cell)) -> Option<(Invariant, u64)> {
    let scenario = Scenario::named(name).unwrap().unwrap();
    found_in(&scenario, runs, corruption)
}

fn found_in(scenario: &Scenario, runs: u64, corruption: impl Fn(&mut Cell)) -> Option<(Invariant, u64)> {
    let mut before = Duration::ZERO;
    for seed in 0..runs {
        let mut soak = Soak::new(scenario, seed, Level::Harsh).unwrap();
        corruption(soak.cell_mut());
        soak.run_to(Duration::from_secs(180));
        before = before + soak.elapsed();
        if let Some(found) = soak.cell().violation() {
            let minutes = before.as_micros().div_ceil(60_000_000);
            println!("{}: {found}, within {minutes} virtual minutes", scenario.name);
            return Some((found.invariant, minutes));
        }
    }
    None
}

#[track_caller]
fn finds(name: &str, invariant: Invariant, corruption: impl Fn(&mut Cell)) {
    let found = found(name, 20, corruption);
    assert_eq!(found.map(|(found, _)| found), Some(invariant));
}

/// What a request is repeated, held back or answered by, in the words of its first bytes.
type Waits = Rc<RefCell<Vec<(Instant, Vec<u8>)>>>;

/// A request that begins like this and has no answer is sent again after 200 ms.
fn resends(cell: &mut Cell, begin: &'static [u8]) {
    let sent: Waits = Rc::default();
    let outward: Outward = Box::new(move |now, input, output| {
        if let Input::PortBytes { bytes, .. } = input
            && (bytes.len() < 2 || bytes.starts_with(&begin[..2]))
        {
            sent.borrow_mut().clear();
        }
        match output {
            Output::PortSend { bytes, .. } if bytes.starts_with(begin) => {
                *sent.borrow_mut() = vec![(now, bytes.to_vec())];
                None
            }
            Output::Sleep { .. } => {
                let (at, bytes) = sent.borrow_mut().pop_if(|(at, _)| now >= *at + MS(200))?;
                assert!(at < now);
                Some(vec![Forged::Port(PORT, bytes)])
            }
            _ => None,
        }
    });
    cell.corrupt(None, Some(outward));
}

/// A request that begins like this is sent so much later.
fn delays(cell: &mut Cell, begin: &'static [u8], by: Duration) {
    let held: Waits = Rc::default();
    let outward: Outward = Box::new(move |now, _, output| match output {
        Output::PortSend { bytes, .. } if bytes.starts_with(begin) => {
            held.borrow_mut().push((now, bytes.to_vec()));
            Some(Vec::new())
        }
        Output::Sleep { .. } => {
            let (_, bytes) = held.borrow_mut().pop_if(|(at, _)| now >= *at + by)?;
            Some(vec![Forged::Port(PORT, bytes)])
        }
        _ => None,
    });
    cell.corrupt(None, Some(outward));
}

const MOVE: &[u8] = &[9, 16, 1, 0x10];
const STOP: &[u8] = &[9, 6, 1, 0];

#[test]
fn what_the_gateway_does_is_not_accused() {
    for name in ["judged-gripper", "judged-axis", "judged-rfid", "judged-drive", "judged-modbus-tcp"] {
        assert_eq!(found(name, 2, |_| ()), None, "{name}");
    }
}

#[test]
fn an_event_that_is_sent_again_when_its_reply_is_lost() {
    finds("judged-gripper", Invariant::EventsOnce, |cell| resends(cell, MOVE));
}

#[test]
fn an_event_that_is_kept_until_it_can_be_sent() {
    finds("judged-gripper", Invariant::EventsOnce, |cell| delays(cell, MOVE, MS(3_000)));
}

#[test]
fn an_event_with_the_values_of_the_one_before() {
    finds("judged-gripper", Invariant::EventsOnce, |cell| {
        let before: Waits = Rc::default();
        let outward: Outward = Box::new(move |now, _, output| match output {
            Output::PortSend { bytes, .. } if bytes.starts_with(MOVE) => {
                let last = before.replace(vec![(now, bytes.to_vec())]).pop()?.1;
                Some(vec![Forged::Port(PORT, last)])
            }
            _ => None,
        });
        cell.corrupt(None, Some(outward));
    });
}

#[test]
fn a_rise_that_nobody_saw() {
    // Each answer with the bit is taken as a rise, one second apart: the 0 before it was never read.
    finds("judged-drive", Invariant::EventsOnce, |cell| {
        let newest = Rc::new(RefCell::new(Instant::ZERO));
        let inward: Inward = Box::new(move |now, input| match input {
            Input::LinkBytes { bytes, .. }
                if bytes.len() == 10 && bytes[7..9] == [1, 1] && bytes[9] & 1 == 1 =>
            {
                let is_again = now.saturating_since(*newest.borrow()) > MS(150);
                if !is_again {
                    return None;
                }
                *newest.borrow_mut() = now;
                let mut other = bytes.to_vec();
                other[9] &= !1;
                Some(other)
            }
            _ => None,
        });
        cell.corrupt(Some(inward), None);
    });
}

#[test]
fn a_stop_that_comes_behind_others() {
    finds("judged-gripper", Invariant::StopsFirst, |cell| delays(cell, STOP, MS(2_500)));
}

/// A request that begins like this is sent again whenever nothing comes for 200 ms behind one.
fn repeats_when_a_reply_is_lost(cell: &mut Cell, begin: &'static [u8]) {
    let kept: Waits = Rc::default();
    let asked: Rc<RefCell<Option<Instant>>> = Rc::default();
    let outward: Outward = Box::new(move |now, input, output| {
        if let Input::PortBytes { .. } = input {
            asked.take();
        }
        match output {
            Output::PortSend { bytes, .. } => {
                if bytes.starts_with(begin) {
                    *kept.borrow_mut() = vec![(now, bytes.to_vec())];
                }
                asked.borrow_mut().get_or_insert(now);
                None
            }
            Output::Sleep { .. } => {
                asked.borrow_mut().take_if(|at| now >= *at + MS(200))?;
                let (_, bytes) = kept.borrow().last()?.clone();
                Some(vec![Forged::Port(PORT, bytes)])
            }
            _ => None,
        }
    });
    cell.corrupt(None, Some(outward));
}

#[test]
fn a_start_that_is_repeated_when_a_reply_is_lost() {
    finds("judged-axis", Invariant::StartsOnce, |cell| repeats_when_a_reply_is_lost(cell, &[5, 6, 2, 0]));
}

#[test]
fn a_late_reply_that_is_taken_for_another() {
    finds("judged-gripper", Invariant::DeviceValues, |cell| {
        let newest: Waits = Rc::default();
        let inward: Inward = Box::new(move |now, input| match input {
            Input::PortBytes { bytes, .. } if bytes.len() == 7 && bytes.starts_with(&[9, 4, 2]) => {
                let last = newest.replace(vec![(now, bytes.to_vec())]).pop();
                // One in a hundred.
                last.map(|(_, last)| last).filter(|_| now.as_micros() % 100 == 0)
            }
            _ => None,
        });
        cell.corrupt(Some(inward), None);
    });
}

#[test]
fn an_echo_that_is_taken_for_a_confirmation() {
    let mut scenario = Scenario::named("judged-gripper").unwrap().unwrap();
    let Bus::Rs485(line) = &mut scenario.gateway.ports[0].bus else { panic!() };
    line.echo = Echo::No;
    let found = found_in(&scenario, 20, |cell| {
        let line = cell.line_of("device");
        cell.line(line).gives_back = true;
    });
    let found = found.map(|(found, _)| found);
    assert!(matches!(found, Some(Invariant::DeviceKeeps | Invariant::StopsFirst)), "{found:?}");
}

/// The link of a port of Modbus TCP.
const LINK: LinkId = LinkId::of_port(PORT);
const MOVE_TCP: &[u8] = &[1, 16, 2, 0x10];
const START_TCP: &[u8] = &[1, 6, 2, 0];

/// The newest request that begins like this behind its header is sent again on each connection that is there anew.
fn resends_on_connections(cell: &mut Cell, begin: &'static [u8]) {
    let sent: Waits = Rc::default();
    let outward: Outward = Box::new(move |now, input, output| match (input, output) {
        (_, Output::LinkSend { link: LINK, bytes }) if bytes[6..].starts_with(begin) => {
            *sent.borrow_mut() = vec![(now, bytes.to_vec())];
            None
        }
        (Input::LinkUp { link: LINK }, Output::Sleep { .. }) => {
            let (_, bytes) = sent.borrow_mut().pop()?;
            Some(vec![Forged::Link(LINK, bytes)])
        }
        _ => None,
    });
    cell.corrupt(None, Some(outward));
}

#[test]
fn an_event_that_is_sent_again_on_the_next_connection() {
    finds("judged-modbus-tcp", Invariant::EventsOnce, |cell| resends_on_connections(cell, MOVE_TCP));
}

#[test]
fn a_start_that_is_sent_again_on_the_next_connection() {
    finds("judged-modbus-tcp", Invariant::StartsOnce, |cell| resends_on_connections(cell, START_TCP));
}

#[test]
fn a_reply_to_another_transaction_that_is_taken() {
    finds("judged-modbus-tcp", Invariant::DeviceValues, |cell| {
        let newest = Rc::new(RefCell::new([0; 2]));
        let asked = Rc::clone(&newest);
        let outward: Outward = Box::new(move |_, _, output| {
            if let Output::LinkSend { link: LINK, bytes } = output {
                asked.borrow_mut().copy_from_slice(&bytes[..2]);
            }
            None
        });
        let inward: Inward = Box::new(move |_, input| match input {
            Input::LinkBytes { link: LINK, bytes } if bytes.len() == 11 => {
                Some([&*newest.borrow(), &bytes[2..]].concat())
            }
            _ => None,
        });
        cell.corrupt(Some(inward), Some(outward));
    });
}

#[test]
fn a_gateway_that_does_not_connect_again() {
    finds("judged-modbus-tcp", Invariant::DeviceKeeps, |cell| {
        let outward: Outward = Box::new(|now, _, output| match output {
            // After the first minute.
            Output::LinkOpen { link: LINK, .. } if now > Instant::from_millis(1_060_000) => Some(Vec::new()),
            _ => None,
        });
        cell.corrupt(None, Some(outward));
    });
}
