//! A step is sent only behind the good answer to the one before.

use super::*;

/// Two steps: the target, and the start.
fn axis(is_named: bool) -> Axis {
    Axis::new(|cell, start| {
        let when = if is_named { Triggers::NEVER } else { rising(0) };
        let mut go = sets(cell, 3, 0x90, None, 1.0, when);
        // The poll is the first exchange, the target the second but one.
        go.follow = is_named.then_some(2);
        go.outcome.to = Some(var("WordInputReg[8]"));
        let target = *start;
        // In this order: poll, an exchange that is never triggered, target, go.
        *start = sets(cell, 9, 0xA0, None, 0.0, rising(7));
        vec![target, go]
    })
}

fn steps(axis: &mut Axis) -> Vec<u16> {
    axis.done.drain(..).map(|(_, address, _)| address).collect()
}

#[test]
fn a_second_step_follows_a_good_first_one() {
    for is_named in [true, false] {
        let mut axis = axis(is_named);
        axis.pulse(good);
        assert_eq!(steps(&mut axis), [TARGET, 0x90]);
        assert_eq!((axis.told()[0], axis.line.shown("WordInputReg[8]")), (2, 2));
    }
}

#[test]
fn a_second_step_is_not_sent_behind_a_refusal_or_silence() {
    for is_named in [true, false] {
        for code in [Some(2), Some(4), Some(5), None] {
            let mut axis = axis(is_named);
            let bad = |request: &[u8]| match write_in(request) {
                Some((TARGET, _)) => code.map(|code| exception(request, code)),
                _ => good(request),
            };
            axis.pulse(bad);
            axis.run(5_000, bad);
            assert_eq!(steps(&mut axis), [TARGET], "{code:?}");
            assert_eq!(axis.line.shown("WordInputReg[8]"), 12, "{code:?}");
            assert_eq!(axis.line.events(3).not_followed, 1);
            axis.pulse(good);
            assert_eq!(steps(&mut axis), [TARGET, 0x90], "the next pulse is another dialogue");
        }
    }
}

#[test]
fn a_dialogue_has_the_values_of_its_beginning() {
    let mut axis = axis(true);
    axis.line.bit(0, true);
    // The first step is answered late; meanwhile the robot shows another target.
    let asked = axis.line.run(MS(60), |request| Some((MS(40), answer(request, |_| 7))));
    axis.note(asked);
    axis.line.word("WordOutputReg[1]", 9);
    let asked = axis.line.run(MS(300), |request| Some((MS(2), answer(request, |_| 7))));
    axis.note(asked);
    let values: Vec<_> = axis.done.iter().map(|(_, address, value)| (*address, *value)).collect();
    assert_eq!(values, [(TARGET, 1_000), (0x90, 1)]);
}
