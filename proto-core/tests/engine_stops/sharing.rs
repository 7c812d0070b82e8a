//! Whether the controller takes a second client of port 2000, and what is done where it does not (D26).

use proto_core::config::CommandWhen;

use super::rig::*;
use super::{A, B, COMMAND, NOTHING, RUN, STOP, URGENT, cell, down, panels, press, sent, shared, state};

#[test]
fn a_second_connection_that_is_refused_twice_is_shared() {
    let mut rig = panels();
    rig.reachable.remove(&URGENT.0);
    down(&mut rig, URGENT);
    assert_eq!(state(&rig, URGENT), "down", "closed by the controller: once");
    rig.run(MS(100));
    assert_eq!(state(&rig, URGENT), "shared", "refused: twice");
    rig.log.clear();
    rig.reachable.insert(URGENT.0);
    rig.run(MS(50_000));
    assert!(!rig.log.iter().any(|(_, out)| *out == Out::Open(URGENT)), "and is left alone");
    press(&mut rig, A, RUN);
    press(&mut rig, B, STOP);
    assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)", "stop"]);
}

#[test]
fn a_second_connection_that_is_refused_from_the_start_is_shared() {
    let mut rig = cell(CommandWhen::Change).rig();
    rig.reachable.remove(&URGENT.0);
    rig.run(MS(200));
    assert_eq!((state(&rig, COMMAND), state(&rig, URGENT)), ("up", "shared"));
}

#[test]
fn a_second_connection_that_the_controller_closes_twice_is_shared() {
    let mut rig = panels();
    down(&mut rig, URGENT);
    rig.run(MS(5_000));
    assert_eq!(state(&rig, URGENT), "up");
    press(&mut rig, A, STOP);
    rig.log.clear();
    down(&mut rig, URGENT);
    assert_eq!(state(&rig, URGENT), "shared");
    assert_eq!(sent(&mut rig, COMMAND), ["stop"], "what was under way goes over the first at once");
    rig.run(MS(60_000));
    assert_eq!(rig.link(URGENT).history.connects, 2);
}

#[test]
fn a_second_connection_that_does_not_open_in_time_twice_is_shared() {
    let mut rig = cell(CommandWhen::Change).rig();
    rig.unanswered.insert(URGENT.0);
    rig.run(MS(4_099));
    assert_eq!(state(&rig, URGENT), "opening", "2 s, a pause of 100 ms, and 2 s");
    rig.run(MS(1));
    assert_eq!(state(&rig, URGENT), "shared");
    assert_eq!(rig.closed().len(), 2, "each attempt was closed");
}

#[test]
fn a_first_connection_that_the_second_displaces_counts_too() {
    let mut rig = cell(CommandWhen::Change).rig();
    rig.run(MS(500));
    // The controller takes the newest client only.
    down(&mut rig, COMMAND);
    rig.run(MS(100));
    assert_eq!((state(&rig, COMMAND), state(&rig, URGENT)), ("up", "up"));
    down(&mut rig, URGENT);
    assert_eq!((state(&rig, COMMAND), state(&rig, URGENT)), ("up", "shared"));
}

#[test]
fn losses_more_than_10_s_apart_are_no_verdict() {
    let mut rig = panels();
    for _ in 0..10 {
        down(&mut rig, URGENT);
        rig.run(MS(10_001));
        assert_eq!(state(&rig, URGENT), "up");
    }
    down(&mut rig, URGENT);
    rig.run(MS(10_000));
    down(&mut rig, URGENT);
    assert_eq!(state(&rig, URGENT), "shared", "10 s are not");
}

#[test]
fn a_first_connection_that_is_lost_by_itself_is_no_verdict() {
    let mut rig = panels();
    rig.run(MS(1_001));
    for _ in 0..10 {
        down(&mut rig, COMMAND);
        rig.run(MS(1_000));
    }
    assert_eq!((state(&rig, COMMAND), state(&rig, URGENT)), ("up", "up"));
    assert_eq!(rig.link(URGENT).history.losses, 0);
}

#[test]
fn both_lost_together_are_no_verdict() {
    for order in [[URGENT, COMMAND], [COMMAND, URGENT]] {
        for between in [0, 1, 90] {
            // After long, and at once after they came up.
            for held in [50, 900, 3_000] {
                let mut rig = panels();
                for nth in 0..6 {
                    let is_up = |rig: &Rig| state(rig, COMMAND) == "up" && state(rig, URGENT) == "up";
                    // They wait longer and longer.
                    for _ in 0..520 {
                        rig.run(MS(if is_up(&rig) { 0 } else { 10 }));
                    }
                    assert!(is_up(&rig), "{order:?}, {between} ms, {held} ms, {nth}");
                    rig.run(MS(held));
                    down(&mut rig, order[0]);
                    rig.run(MS(between));
                    down(&mut rig, order[1]);
                }
            }
        }
    }
}

#[test]
fn what_the_gateway_closes_itself_is_no_verdict() {
    let mut rig = panels();
    rig.acknowledges = false;
    for _ in 0..4 {
        press(&mut rig, A, STOP);
        press(&mut rig, A, NOTHING);
        rig.run(MS(1_500));
    }
    assert_eq!(rig.link(URGENT).counters.unacknowledged, 4);
    rig.run(MS(1_000));
    assert_eq!(state(&rig, URGENT), "up");
}

#[test]
fn sharing_ends_when_the_controller_was_away() {
    for unanswered in [false, true] {
        let mut rig = shared();
        rig.reachable.insert(URGENT.0);
        down(&mut rig, COMMAND);
        rig.run(MS(100));
        assert_eq!((state(&rig, COMMAND), state(&rig, URGENT)), ("up", "shared"), "back at once");
        rig.run(MS(10_000));
        if unanswered {
            rig.unanswered.insert(COMMAND.0);
        } else {
            rig.reachable.remove(&COMMAND.0);
        }
        down(&mut rig, COMMAND);
        rig.run(MS(if unanswered { 2_099 } else { 99 }));
        assert_eq!(state(&rig, URGENT), "shared");
        rig.log.clear();
        rig.run(MS(1));
        assert_ne!(state(&rig, COMMAND), "up");
        assert_eq!(state(&rig, URGENT), "down", "another may have come back");
        rig.run(MS(99));
        assert_eq!(state(&rig, URGENT), "down");
        rig.run(MS(1));
        assert_eq!(state(&rig, URGENT), "up", "opened after the shortest wait");
        press(&mut rig, A, STOP);
        assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    }
}

#[test]
fn after_the_end_of_sharing_it_takes_two_losses_again() {
    let mut rig = shared();
    rig.reachable.clear();
    down(&mut rig, COMMAND);
    rig.run(MS(1_000));
    assert_ne!(state(&rig, URGENT), "shared", "refused, but so is the first");
    rig.reachable.insert(COMMAND.0);
    rig.run(MS(6_000));
    assert_eq!(state(&rig, COMMAND), "up");
    rig.run(MS(10_000));
    assert_eq!(state(&rig, URGENT), "shared");
}
