//! Bits of a register that others write too, with Modbus function 22.

use super::*;

/// The register.
const SHARED: u16 = 0x20;

/// A slave's register, which another master writes as well.
struct Register(u16);

impl Register {
    /// Carries out a request, as the specification has it.
    fn carries_out(&mut self, request: &[u8]) -> Vec<u8> {
        let word = |at: usize| u16::from_be_bytes([request[at], request[at + 1]]);
        assert_eq!((request[1], word(2), request.len()), (22, SHARED, 10), "{request:02X?}");
        let (and, or) = (word(4), word(6));
        self.0 = self.0 & and | or & !and;
        request.to_vec()
    }
}

/// Writes these bits of the register from a variable.
fn masks(cell: &mut Cell, (first, count): (u8, u8), from_var: &str, when: Triggers) -> Exchange {
    let bits = Encoding::bits(T::Word, first..=first + count - 1).big_endian();
    let field = FieldSpec::DeviceOutput { encoding: bits, overflow: Overflow::Usual, from: from(from_var) };
    let written = cell.fields([field]);
    let mask = ((1 << count) - 1) << first;
    let operation = Operation::MaskWriteRegister { address: SHARED, mask };
    never_late(Exchange::new(3, Transaction::Rtu { operation, written, read: Span::default() }, when))
}

/// A line on which nothing echoes.
fn line_with(mut cell: Cell, exchanges: &[Exchange]) -> Line {
    let port = talking(&mut cell, exchanges);
    let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!() };
    line.echo = Echo::No;
    Line::new(&cell, port)
}

const CHANGE: Triggers = Triggers { change: true, ..Triggers::NEVER };

#[test]
fn the_bits_of_others_stay_as_another_master_has_set_them() {
    let mut cell = Cell::new();
    let write = masks(&mut cell, (4, 4), "WordOutputReg[1]", CHANGE);
    let mut line = line_with(cell, &[write]);
    let mut register = Register(0xA50F);
    for (value, others) in [(0_u16, 0_u16), (5, 0xFF0F), (15, 0x0000), (3, 0x1234 & 0xFF0F)] {
        line.word("WordOutputReg[1]", value);
        let mut requests = Vec::new();
        line.run(MS(300), |request| {
            // Between any reading of the gateway's and its write.
            register.0 = register.0 & 0x00F0 | others;
            requests.push(request.to_vec());
            Some((MS(2), register.carries_out(request)))
        });
        assert_eq!(register.0, others | value << 4, "{value}: {:04X}", register.0);
        assert_eq!(requests, [with_crc(&[3, 22, 0, 0x20, 0xFF, 0x0F, 0, (value as u8) << 4])]);
    }
    let counters = line.peer(3).counters;
    assert_eq!((counters.requests, counters.replies, counters.refused), (4, 4, 0));
}

#[test]
fn a_period_writes_them_again_and_again() {
    let mut cell = Cell::new();
    let write = masks(&mut cell, (0, 1), "WordOutputReg[1]", Triggers::every(MS(50)));
    let mut line = line_with(cell, &[write]);
    line.word("WordOutputReg[1]", 1);
    let mut register = Register(0);
    let asked = line.run(MS(1_000), |request| {
        // The other master clears all of them by mistake.
        register.0 = 0x8000;
        Some((MS(2), register.carries_out(request)))
    });
    assert!(asked.len() >= 18, "{}", asked.len());
    assert_eq!(register.0, 0x8001);
}

/// An event on bits 0 and 1, whose outcome the robot sees.
fn event(cell: &mut Cell) -> Exchange {
    let outcome = OutcomeTo {
        to: Some(var("WordInputReg[5]")),
        code_to: Some(var("WordInputReg[6]")),
        count_to: Some(var("WordInputReg[7]")),
    };
    Exchange { outcome, ..masks(cell, (0, 2), "WordOutputReg[1]", rising(0)) }
}

fn told(line: &Line) -> [u16; 3] {
    ["WordInputReg[5]", "WordInputReg[6]", "WordInputReg[7]"].map(|name| line.shown(name))
}

#[test]
fn an_event_is_done_once_or_refused_by_a_device_without_the_function() {
    for is_there in [true, false] {
        let mut cell = Cell::new();
        let start = event(&mut cell);
        let mut line = line_with(cell, &[start]);
        let mut register = Register(0xFFF0);
        line.word("WordOutputReg[1]", 2);
        line.run(MS(300), |_| panic!("nothing rose"));
        line.bit(0, true);
        let asked = line.run(MS(3_000), |request| {
            let reply = if is_there { register.carries_out(request) } else { exception(request, 1) };
            Some((MS(2), reply))
        });
        assert_eq!(asked.len(), 1);
        let (held, outcome) = if is_there { (0xFFF2, [2, 0, 1]) } else { (0xFFF0, [3, 1, 1]) };
        assert_eq!((register.0, told(&line)), (held, outcome));
    }
}

#[test]
fn what_may_be_an_echo_confirms_no_bits() {
    for (echo, outcome) in [(Echo::Auto, 5), (Echo::No, 2)] {
        let mut cell = Cell::new();
        let start = event(&mut cell);
        let port = talking(&mut cell, &[start]);
        let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!() };
        line.echo = echo;
        let mut line = Line::new(&cell, port);
        line.run(MS(300), |_| None);
        line.bit(0, true);
        // The request again: of a slave, or of the adapter alone.
        let asked = line.run(MS(5_000), |request| Some((MS(2), request.to_vec())));
        assert_eq!((asked.len(), told(&line)[0]), (1, outcome), "{echo:?}");
    }
}

#[test]
fn replies_are_told_apart_by_the_bits_and_like_ones_wait() {
    let mut cell = Cell::new();
    let low = Exchange { late: None, retries: 0, ..masks(&mut cell, (0, 4), "WordOutputReg[1]", CHANGE) };
    let high = Exchange { late: None, retries: 0, ..masks(&mut cell, (8, 4), "WordOutputReg[2]", CHANGE) };
    let mut line = line_with(cell, &[low, high]);
    let mut register = Register(0);
    line.run(MS(2_000), |request| Some((MS(2), register.carries_out(request))));
    // The reply about the low bits comes while that about the high ones is awaited.
    line.word("WordOutputReg[1]", 1);
    let asked = line.run(MS(300), |request| Some((MS(150), register.carries_out(request))));
    assert_eq!((asked.len(), line.peer(3).counters.late_replies), (1, 1), "{asked:02X?}");
    line.word("WordOutputReg[1]", 2);
    line.word("WordOutputReg[2]", 7);
    let before = line.peer(3).counters;
    let asked = line.run(MS(400), |request| {
        let is_low = request[5] == 0xF0;
        let reply = register.carries_out(request);
        // No reply about the high ones.
        is_low.then_some((MS(130), reply))
    });
    let after = line.peer(3).counters;
    // The others are not held back until the late reply has come.
    let at = |keeps: u8| asked.iter().find(|(_, request)| request[4] == keeps).unwrap().0;
    assert!(at(0xFF) < at(0xF0) && at(0xF0) < at(0xFF) + MS(130), "{asked:02X?}");
    assert_eq!(after.replies, before.replies, "none was in time: {asked:02X?}");
    assert!(after.late_replies > before.late_replies);
}

#[test]
fn a_stop_is_written_until_it_is_confirmed() {
    let mut cell = Cell::new();
    let mut stop = masks(&mut cell, (15, 1), "WordOutputReg[3]", rising(1));
    stop.stop = true;
    let start = event(&mut cell);
    let mut line = line_with(cell, &[start, stop]);
    line.word("WordOutputReg[1]", 1);
    line.word("WordOutputReg[3]", 1);
    line.run(MS(300), |_| panic!("nothing rose"));
    line.bit(0, true);
    line.bit(1, true);
    let (mut register, mut lost) = (Register(0x0FF0), 2);
    let asked = line.run(MS(3_000), |request| {
        let reply = register.carries_out(request);
        lost -= 1;
        (lost < 0).then_some((MS(2), reply))
    });
    let stop = with_crc(&[3, 22, 0, 0x20, 0x7F, 0xFF, 0x80, 0]);
    assert!(asked.iter().all(|(_, request)| *request == stop), "{asked:02X?}");
    assert_eq!((asked.len(), register.0), (3, 0x8FF0));
    assert_eq!(told(&line)[0], 11, "the event was stopped");
}
