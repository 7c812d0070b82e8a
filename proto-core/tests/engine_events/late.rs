//! A reply belongs to its request, or to nobody.

use super::*;

/// Reply times of a slave, seeded.
struct Times(u64);

impl Times {
    fn next(&mut self, below: u64) -> u64 {
        // xorshift64
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % below
    }
}

/// Three reads of one slave whose replies look alike, each 20 ms. Register n holds 100 times its number, and a count of
/// the times that it was asked.
fn three(cell: &mut Cell) -> PortId {
    let table = [1, 2, 3].map(|nth: u16| {
        let name = format!("WordInputReg[{nth}]");
        let mut poll = reads_at(cell, 5, nth, &name, MS(20));
        (poll.timeout, poll.late) = (MS(30), None);
        poll
    });
    talking(cell, &table)
}

/// Runs until so many requests were made; how many replies came in time, and how many were taken.
fn play(requests: usize, mut delay: impl FnMut() -> Duration) -> (usize, u32, u32) {
    let mut cell = Cell::new();
    let port = three(&mut cell);
    cell.last_port().timeout = MS(60_000);
    let mut line = Line::new(&cell, port);
    let (mut asked, mut in_time) = (0, 0);
    while asked < requests {
        let count = line.run(MS(1_000), |request| {
            let delay = delay();
            in_time += usize::from(delay < MS(30));
            Some((delay, answer(request, |address| address * 100)))
        });
        asked += count.len();
        for written in line.rig.take_written() {
            let Written::Registers(address, words) = written else { panic!() };
            for (at, word) in (address..).zip(words) {
                assert_eq!(word, (at - 7) * 100, "a register has the value of another one");
            }
        }
    }
    let counters = line.peer(5).counters;
    (in_time, counters.replies, counters.late_replies)
}

/// A hundred thousand where it is built for speed (`.ci/run long`).
const REQUESTS: usize = if cfg!(debug_assertions) { 2_000 } else { 100_000 };

#[test]
fn no_register_shows_a_value_of_another_one() {
    let mut times = Times(0x5EED);
    let (in_time, taken, late) =
        play(REQUESTS, || Duration::from_micros(30_000 * (20 + times.next(281)) / 100));
    assert!(late as usize > REQUESTS / 10, "{late}");
    assert!(u64::from(taken) * 2 >= in_time as u64, "{taken} of {in_time}");
}

#[test]
fn replies_in_time_are_taken() {
    let mut times = Times(0x5EED);
    let (in_time, taken, late) =
        play(REQUESTS, || Duration::from_micros(30_000 * (20 + times.next(79)) / 100));
    assert_eq!(late, 0);
    assert!(u64::from(taken) * 100 >= in_time as u64 * 95, "{taken} of {in_time}");
}

#[test]
fn only_what_cannot_be_told_apart_waits_for_a_late_reply() {
    let mut cell = Cell::new();
    let mut like =
        [1, 2].map(|nth: u16| reads_at(&mut cell, 5, nth, &format!("WordInputReg[{nth}]"), MS(20)));
    like.iter_mut().for_each(|poll| (poll.timeout, poll.late) = (MS(30), None));
    let mut longer = reads(&mut cell, 5, &["WordInputReg[3]", "WordInputReg[4]"], Triggers::every(MS(20)));
    (longer.timeout, longer.late) = (MS(30), None);
    let mut other = reads_at(&mut cell, 6, 1, "WordInputReg[5]", MS(20));
    (other.timeout, other.late) = (MS(30), None);
    let port = talking(&mut cell, &[like[0], like[1], longer, other]);
    let mut line = Line::new(&cell, port);
    line.run(MS(2_000), |request| Some((MS(1), answer(request, |_| 7))));
    // One reply is lost, with its repetition.
    let mut lost = 2;
    let asked = line.run(MS(1_200), |request| {
        let is_first = request[0] == 5 && request[3] == 1 && lost > 0;
        lost -= i32::from(is_first);
        (!is_first).then(|| (MS(1), answer(request, |_| 7)))
    });
    let failed = asked.iter().rposition(|(_, request)| request[..4] == [5, 3, 0, 1]);
    assert!(failed.is_some());
    let gap = |wanted: [u8; 4]| {
        let times: Vec<_> =
            asked.iter().filter(|(_, request)| request[..4] == wanted).map(|(at, _)| *at).collect();
        times.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap()
    };
    for (wanted, waits) in
        [([5, 3, 0, 1], true), ([5, 3, 0, 2], true), ([5, 3, 0, 0x10], false), ([6, 3, 0, 1], false)]
    {
        let longest = gap(wanted);
        assert_eq!((longest > MS(900), longest < MS(1_100)), (waits, true), "{wanted:?}: {longest}");
    }
}

#[test]
fn a_late_reply_is_counted_and_frees_its_exchange() {
    let mut cell = Cell::new();
    let port = three(&mut cell);
    let mut line = Line::new(&cell, port);
    line.run(MS(2_000), |request| Some((MS(1), answer(request, |_| 7))));
    let mut late = 2;
    let asked = line.run(MS(500), |request| {
        let is_late = request[3] == 2 && late > 0;
        late -= i32::from(is_late);
        Some((if is_late { MS(100) } else { MS(1) }, answer(request, |_| 7)))
    });
    assert!(line.peer(5).counters.late_replies >= 1);
    let last = asked.iter().filter(|(_, request)| request[3] == 2).count();
    assert!(last > 10, "it goes on when its replies have come: {last}");
}

#[test]
fn a_late_reply_to_an_old_value_does_not_confirm_the_new_one() {
    let mut cell = Cell::new();
    let when = Triggers { change: true, ..Triggers::NEVER };
    let mut speed = sets(&mut cell, 3, 0x20, Some("WordOutputReg[1]"), 0.0, when);
    speed.late = None;
    let port = talking(&mut cell, &[speed]);
    let mut line = Line::new(&cell, port);
    line.word("WordOutputReg[1]", 1);
    line.run(MS(3_000), |request| Some((MS(2), answer(request, |_| 7))));
    line.word("WordOutputReg[1]", 2);
    // The reply to 2 comes late; that to 3 never, the first time.
    let (mut held, mut lost) = (0_u16, 1);
    let mut run = |line: &mut Line, span| {
        line.run(span, |request| {
            let (_, value) = write_in(request).unwrap();
            if value == 3 && lost > 0 {
                // It is not heard.
                lost -= 1;
                return None;
            }
            held = value;
            Some((if value == 2 { MS(250) } else { MS(2) }, answer(request, |_| 7)))
        })
    };
    run(&mut line, MS(120));
    line.word("WordOutputReg[1]", 3);
    run(&mut line, MS(6_000));
    assert_eq!((held, lost), (3, 0));
}

#[test]
fn a_value_is_as_old_as_the_first_question_that_it_may_answer() {
    let mut cell = Cell::new();
    let mut poll = reads_at(&mut cell, 5, 1, "WordInputReg[1]", MS(500));
    (poll.timeout, poll.late, poll.retries) = (MS(100), None, 1);
    let port = talking(&mut cell, &[poll]);
    cell.last_port().timeout = MS(150);
    cell.safe("WordInputReg[1]", 9.0);
    let mut line = Line::new(&cell, port);
    let value = |line: &Line| line.rig.engine.image().value(var("WordInputReg[1]")).as_f64();
    line.run(MS(1_400), |request| Some((MS(2), answer(request, |_| 7))));
    assert_eq!(value(&line), 9.0, "it is asked seldom");
    // The next question has no reply in time; the reply to its repetition may be to it.
    let mut nth = 0;
    let mut run = |line: &mut Line, millis| {
        line.run(MS(millis), |request| {
            nth += 1;
            (nth % 2 == 0).then(|| (MS(2), answer(request, |_| 7)))
        })
    };
    while run(&mut line, 1).is_empty() {}
    run(&mut line, 120);
    assert_eq!(value(&line), 7.0, "the reply is taken");
    run(&mut line, 40);
    assert_eq!(value(&line), 9.0, "150 ms behind the first question");
}
