//! A controller that answers late or never: a stop has somewhere to go all the same.

use proto_core::config::{CommandWhen, InputBinding, Parts};
use proto_core::engine::{Input, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::wire::scalar::ScalarType;

use super::rig::*;
use super::{
    A, B, COMMAND, DISABLE, NOTHING, PAUSE, RESUME, RUN, STOP, URGENT, down, panels, press, reply, sent,
    shared, state, unplug,
};

/// A stop of another kind each, a tenth of a second apart.
fn three_unanswered() -> Rig {
    let mut rig = panels();
    for (value, link) in [(STOP, URGENT), (PAUSE, COMMAND), (DISABLE, COMMAND)] {
        press(&mut rig, A, value);
        assert_eq!(sent(&mut rig, link).len(), 1);
        rig.run(MS(100));
    }
    rig.log.clear();
    rig
}

const POWEROFF: u8 = 6;

#[test]
fn a_place_is_free_when_the_older_of_two_has_its_reply() {
    let mut rig = shared();
    press(&mut rig, A, RESUME);
    rig.run(MS(50));
    press(&mut rig, A, STOP);
    assert_eq!(sent(&mut rig, COMMAND), ["resume", "stop"]);
    rig.link_bytes(COMMAND, b"resume success");
    press(&mut rig, A, PAUSE);
    assert_eq!(sent(&mut rig, COMMAND), ["pause"], "beside the stop");
    press(&mut rig, B, DISABLE);
    assert!(sent(&mut rig, COMMAND).is_empty());
    rig.link_bytes(COMMAND, b"pause success");
    assert_eq!(reply(&rig, A), ReplyCode::Success, "of the younger one");
    assert_eq!(sent(&mut rig, COMMAND), ["disable"], "beside the stop, which is still unanswered");
    rig.link_bytes(COMMAND, b"stop fail\ndisable success");
    assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::Success, ReplyCode::Success));
}

#[test]
fn a_keyword_ends_before_the_next_one_whatever_was_answered_between() {
    let mut rig = shared();
    press(&mut rig, A, RESUME);
    rig.run(MS(50));
    press(&mut rig, A, STOP);
    rig.link_bytes(COMMAND, b"resume success");
    rig.log.clear();
    press(&mut rig, A, PAUSE);
    assert_eq!(rig.sent_on(COMMAND), [b"\npause".to_vec()], "`stop` is not answered, and has no end");
}

#[test]
fn where_all_are_unanswered_the_oldest_connection_makes_way() {
    let mut rig = three_unanswered();
    let first = rig.now - MS(300);
    press(&mut rig, B, POWEROFF);
    rig.run(MS(699));
    assert_eq!((sent(&mut rig, URGENT), rig.closed()), (vec![], vec![]));
    rig.run(MS(1));
    assert_eq!(rig.closed(), [(first + MS(1_000), URGENT)]);
    assert_eq!(reply(&rig, A), ReplyCode::Pending, "its newest is the disable");
    rig.run(MS(200));
    assert_eq!(
        sent(&mut rig, URGENT),
        ["poweroff"],
        "before what was under way and is not asked for any more"
    );
    assert_eq!(state(&rig, COMMAND), "up");
}

#[test]
fn what_is_still_asked_for_goes_again_behind_the_one_that_waited() {
    let mut rig = panels();
    press(&mut rig, B, STOP);
    rig.run(MS(10));
    press(&mut rig, A, PAUSE);
    rig.run(MS(10));
    press(&mut rig, A, DISABLE);
    rig.run(MS(10));
    press(&mut rig, A, POWEROFF);
    rig.log.clear();
    rig.run(MS(1_200));
    assert_eq!(sent(&mut rig, URGENT), ["poweroff"]);
    // The stop has nowhere to go then, and the other connection is given up for it.
    rig.run(MS(800));
    assert_eq!(sent(&mut rig, COMMAND), ["stop"]);
    assert_eq!(rig.closed().len(), 2);
}

#[test]
fn nothing_is_given_up_for_one_that_only_waits_for_the_transport() {
    let mut rig = panels();
    press(&mut rig, B, POWEROFF);
    rig.run(MS(3_000));
    rig.log.clear();
    rig.reports_sent = false;
    press(&mut rig, A, STOP);
    press(&mut rig, A, PAUSE);
    rig.run(MS(500));
    assert_eq!((sent(&mut rig, COMMAND), rig.closed()), (vec!["stop".to_owned()], vec![]));
    rig.input(Input::LinkSent { link: COMMAND });
    assert_eq!(sent(&mut rig, COMMAND), ["pause"]);
    assert_eq!(reply(&rig, B), ReplyCode::Pending);
}

#[test]
fn one_that_may_go_again_behind_its_like_goes_when_it_may() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    let at = rig.now;
    rig.log.clear();
    rig.run(MS(7));
    press(&mut rig, A, NOTHING);
    press(&mut rig, A, STOP);
    rig.run(MS(1_100));
    assert_eq!(rig.sent_after(COMMAND, at), [(1_000, b"stop".to_vec())]);
}

#[test]
fn a_lost_connection_is_no_reason_to_give_up_the_other_at_once() {
    let mut rig = three_unanswered();
    press(&mut rig, B, POWEROFF);
    down(&mut rig, URGENT);
    rig.run(MS(150));
    assert_eq!(sent(&mut rig, URGENT), ["poweroff"]);
    assert_eq!(rig.closed(), []);
    unplug(&mut rig);
    press(&mut rig, A, RUN);
    rig.run(MS(20_000));
    assert_eq!(rig.closed(), [], "and there is none to give up");
}

#[test]
fn of_one_frame_what_stops_goes_whatever_the_order_of_the_fields() {
    for order in [[RUN, STOP], [STOP, RUN]] {
        let mut cell = Cell::new();
        let table = cell.commands(&super::TABLE);
        let to = || InputBinding::Commands { table, when: CommandWhen::Change };
        let fields = cell.fields([user_in(ScalarType::Byte, to()), user_in(ScalarType::Byte, to())]);
        let input = cell.part(&[255, 255], &[238, 238], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
        cell.rs485(recipe);
        let mut rig = cell.rig();
        rig.run(MS(10));
        let frame = |[a, b]: [u8; 2]| [255, 255, a, b, 238, 238];
        rig.bytes(A, &frame([NOTHING, NOTHING]));
        rig.bytes(A, &frame(order));
        assert_eq!(sent(&mut rig, URGENT), ["stop"]);
        rig.link_bytes(URGENT, b"stop success");
        rig.run(MS(2_000));
        assert_eq!(sent(&mut rig, COMMAND), [""; 0], "{order:?}: not behind the stop either");
        assert_eq!((rig.counters(A).commands, rig.counters(A).commands_dropped), (2, 1));
        // A later frame of the same piece is another matter.
        rig.bytes(A, &frame([NOTHING, NOTHING]));
        rig.bytes(A, &[frame(order), frame([NOTHING, NOTHING]), frame([RUN, NOTHING])].concat());
        rig.link_bytes(URGENT, b"stop success");
        assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)"]);
    }
}
