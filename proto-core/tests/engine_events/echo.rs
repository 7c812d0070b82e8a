//! What may be an echo confirms nothing.

use super::*;

/// A register is written when it changes; with `reads`, another one is read.
fn cell(reads: bool, echo: Echo) -> (Cell, PortId) {
    let mut cell = Cell::new();
    let when = Triggers { change: true, ..Triggers::NEVER };
    let mut write = sets(&mut cell, 3, 0x20, Some("WordOutputReg[1]"), 0.0, when);
    let Transaction::Rtu { operation, .. } = &mut write.transaction else { panic!() };
    *operation = Operation::WriteRegister { address: 0x20 };
    let mut table = vec![write];
    if reads {
        table.push(reads_at(&mut cell, 3, 0x10, "WordInputReg[1]", MS(200)));
    }
    let port = talking(&mut cell, &table);
    let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!() };
    line.echo = echo;
    (cell, port)
}

/// What is heard on a line that echoes or does not, whose slave says this.
fn heard(has_echo: bool, request: &[u8], says: Option<Vec<u8>>) -> Option<(Duration, Vec<u8>)> {
    let echo = if has_echo { request } else { &[] };
    let heard = [echo, &says.unwrap_or_default()].concat();
    (!heard.is_empty()).then_some((MS(2), heard))
}

fn counts(line: &Line) -> (u32, u32, u32) {
    let counters = line.peer(3).counters;
    (counters.replies, counters.refused, counters.unconfirmed)
}

#[test]
fn a_line_without_a_slave_has_no_replies() {
    let (cell, port) = cell(false, Echo::Auto);
    let mut line = Line::new(&cell, port);
    line.run(MS(3_000), |request| heard(true, request, None));
    assert_eq!(counts(&line), (0, 0, 1), "its own echo confirms nothing");
}

#[test]
fn a_refused_write_behind_its_echo_is_refused() {
    for reads in [true, false] {
        let (cell, port) = cell(reads, Echo::Auto);
        let mut line = Line::new(&cell, port);
        for value in [5, 6] {
            line.word("WordOutputReg[1]", value);
            line.run(MS(3_000), |request| {
                let says = if request[1] == 6 { exception(request, 2) } else { answer(request, |_| 7) };
                heard(true, request, Some(says))
            });
        }
        let (_, refused, unconfirmed) = counts(&line);
        assert!(refused >= 2 && unconfirmed == 0, "{:?}", line.peer(3).counters);
    }
}

#[test]
fn an_echo_is_learned_and_what_was_not_confirmed_is_written_again() {
    let (cell, port) = cell(true, Echo::Auto);
    let mut line = Line::new(&cell, port);
    let mut held = 0;
    // The slave does not hear the first write, whose echo looks like its reply.
    let mut first = true;
    line.word("WordOutputReg[1]", 5);
    line.run(MS(3_000), |request| {
        let says = match write_in(request) {
            Some(_) if std::mem::take(&mut first) => None,
            Some((_, value)) => {
                held = value;
                Some(request.to_vec())
            }
            None => Some(answer(request, |_| 7)),
        };
        heard(true, request, says)
    });
    assert_eq!(held, 5);
    assert_eq!(line.shown("WordInputReg[1]"), 7);
    line.word("WordOutputReg[1]", 6);
    let asked = line.run(MS(3_000), |request| heard(true, request, Some(answer(request, |_| 7))));
    assert_eq!(asked.iter().filter(|(_, request)| request[1] == 6).count(), 1, "now a reply is one");
}

#[test]
fn a_line_without_an_echo_confirms() {
    for (reads, echo) in [(true, Echo::Auto), (true, Echo::No), (false, Echo::No)] {
        let (cell, port) = cell(reads, echo);
        let mut line = Line::new(&cell, port);
        for value in 1..20 {
            line.word("WordOutputReg[1]", value);
            line.run(MS(300), |request| heard(false, request, Some(answer(request, |_| 7))));
        }
        let (replies, refused, unconfirmed) = counts(&line);
        assert!(
            replies >= 18 && refused == 0 && unconfirmed <= 1,
            "{reads} {echo:?}: {:?}",
            line.peer(3).counters
        );
    }
}

#[test]
fn an_event_that_may_have_been_echoed_is_of_unknown_outcome() {
    let mut cell = Cell::new();
    let mut start = sets(&mut cell, 3, 0x20, Some("WordOutputReg[1]"), 0.0, rising(0));
    let Transaction::Rtu { operation, .. } = &mut start.transaction else { panic!() };
    *operation = Operation::WriteRegister { address: 0x20 };
    start.outcome.to = Some(var("WordInputReg[5]"));
    let port = talking(&mut cell, &[start]);
    let mut line = Line::new(&cell, port);
    line.run(MS(200), |_| None);
    line.bit(0, true);
    let asked = line.run(MS(5_000), |request| heard(true, request, None));
    assert_eq!((asked.len(), line.shown("WordInputReg[5]")), (1, 5));
}
