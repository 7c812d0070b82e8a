//! Who has the line, and when.

use proto_core::modbus::rtu::{Echo, Exchange, Presence, Timing, When};

use crate::line::{Line, MS, Told, read, write};

const SLOW: Timing = Timing::new(19_200, 11);
const FAST: Timing = Timing::new(115_200, 11);

#[test]
fn eight_slaves_of_which_two_are_dead_keep_their_periods() {
    let addresses: Vec<u8> = (1..=8).collect();
    let table: Vec<Exchange> = addresses.iter().map(|&slave| read(slave, 0, 8, 200)).collect();
    let mut line = Line::new(SLOW, Echo::Absent, &addresses, &table);
    line.node(3).alive = false;
    line.node(6).alive = false;
    line.run(MS(300_000));

    assert_eq!(line.collisions, 0);
    for (nth, &slave) in addresses.iter().enumerate() {
        let (status, sent) = (line.status(slave), line.sent_to(slave));
        if matches!(slave, 3 | 6) {
            assert_eq!(status.presence, Presence::Down);
            // 30 ms of timeout 64 times is 1.92 s, to which the wait for a period and a gap adds.
            assert!((100..=200).contains(&sent.len()), "slave {slave} was asked {} times", sent.len());
            continue;
        }
        assert_eq!(status.missed_periods, 0, "slave {slave}");
        assert!((1500..=1501).contains(&line.replies(nth)), "slave {slave}: {}", line.replies(nth));
        // Once the dead are asked seldom, nothing moves any more.
        let steps = sent[50..].windows(2).map(|pair| pair[1].saturating_since(pair[0]).as_micros());
        let (shortest, longest) = steps.fold((u64::MAX, 0), |(a, b), step| (a.min(step), b.max(step)));
        assert!(shortest > 199_000 && longest < 201_000, "slave {slave}: {shortest}..={longest} us");
    }
}

#[test]
fn without_a_gap_for_its_timeout_a_dead_slave_costs_a_small_part_of_the_line() {
    let dead = Exchange { timeout: MS(100), ..read(9, 0, 1, 20) };
    let mut line = Line::new(FAST, Echo::Absent, &[1, 2, 9], &[read(1, 0, 1, 20), read(2, 0, 1, 20), dead]);
    line.node(9).alive = false;
    line.run(MS(300_000));

    assert_eq!(line.collisions, 0);
    let asked = line.sent_to(9).len() as u64;
    assert!(asked > 20, "asked {asked} times: it would not be found when it comes back");
    assert!(asked * 100 * 65 < 300_000 + 65 * 100 * 12, "asked {asked} times");
    let periods = 300_000 / 20;
    for slave in [1, 2] {
        let missed = u64::from(line.status(slave).missed_periods);
        assert!(missed * 50 < periods, "slave {slave}: {missed} of {periods} missed");
    }
}

#[test]
fn a_dead_slave_does_not_slow_down_a_line_that_is_never_idle() {
    // Asked without a pause: each reply is due again at once.
    let patient = |row| Exchange { timeout: MS(200), ..row };
    let table = [read(1, 0, 100, 1), read(2, 0, 100, 1), read(9, 0, 1, 100)].map(patient);
    let mut line = Line::new(SLOW, Echo::Absent, &[1, 2, 9], &table);
    line.nodes.iter_mut().for_each(|node| node.alive = node.address != 9);
    line.run(MS(120_000));
    let asked = line.sent_to(9).len();
    assert!((5..20).contains(&asked), "a dead slave was asked {asked} times");
    let (one, two) = (line.replies(0), line.replies(1));
    assert!(one.abs_diff(two) <= 1, "{one} and {two}");
    assert!(one > 400, "{one}");
}

#[test]
fn a_line_with_too_much_to_do_serves_all_in_turn_and_counts_what_it_missed() {
    let addresses: Vec<u8> = (1..=8).collect();
    let table: Vec<Exchange> = addresses.iter().map(|&slave| read(slave, 0, 8, 50)).collect();
    let mut line = Line::new(SLOW, Echo::Absent, &addresses, &table);
    line.run(MS(60_000));
    assert_eq!(line.collisions, 0);
    let replies: Vec<usize> = (0..8).map(|nth| line.replies(nth)).collect();
    let (fewest, most) = (replies.iter().min().unwrap(), replies.iter().max().unwrap());
    assert!(most - fewest <= 1, "{replies:?}");
    for &slave in &addresses {
        let missed = line.status(slave).missed_periods as usize;
        let served = line.sent_to(slave).len();
        assert!((served + missed).abs_diff(60_000 / 50) <= 4, "slave {slave}: {served} and {missed}");
    }
}

#[test]
fn thirty_two_slaves_with_mixed_periods_are_all_served() {
    let addresses: Vec<u8> = (101..=132).collect();
    let periods = [100, 250, 1000, 5000];
    let row = |(nth, &slave): (usize, &u8)| read(slave, 4, 2, periods[nth % 4]);
    let table: Vec<Exchange> = addresses.iter().enumerate().map(row).collect();
    let mut line = Line::new(FAST, Echo::Absent, &addresses, &table);
    line.run(MS(60_000));
    assert_eq!(line.collisions, 0);
    for (nth, &slave) in addresses.iter().enumerate() {
        assert_eq!(line.status(slave).missed_periods, 0, "slave {slave}");
        let expected = 60_000 / periods[nth % 4] as usize;
        assert!(line.replies(nth).abs_diff(expected) <= 1, "slave {slave}: {}", line.replies(nth));
    }
}

#[test]
fn what_is_requested_goes_before_periods() {
    let mut table: Vec<Exchange> = (1..=6).map(|slave| read(slave, 0, 8, 200)).collect();
    table.push(write(7, 0, 1, When::REQUESTED));
    let mut line = Line::new(SLOW, Echo::Absent, &[1, 2, 3, 4, 5, 6, 7], &table);
    line.values.push((6, vec![0x12, 0x34]));
    line.run(MS(401));
    assert_eq!(line.sent_to(7), [], "nobody has requested it");
    line.take_told();
    line.request(6);
    let requested = line.now;
    line.run(MS(150));
    let waited = line.sent_to(7)[0].saturating_since(requested);
    assert!(waited < MS(30), "five others were due, and one was on the line: waited {waited}");
    assert_eq!(line.node(7).bank.words[0], 0x1234);
}

#[test]
fn requests_without_end_leave_every_fifth_turn_to_periods() {
    let table = [
        read(1, 0, 8, 100),
        read(2, 0, 8, 100),
        write(3, 0, 1, When::REQUESTED),
        write(4, 0, 1, When::REQUESTED),
    ];
    let mut line = Line::new(SLOW, Echo::Absent, &[1, 2, 3, 4], &table);
    line.values = vec![(2, vec![0, 1]), (3, vec![0, 2])];
    for _ in 0..20_000 {
        line.request(2);
        line.request(3);
        line.run(MS(1));
    }
    let [polls, writes] = [[0, 1], [2, 3]].map(|pair| pair.map(|nth| line.replies(nth)));
    assert!(polls[0].abs_diff(polls[1]) <= 1 && writes[0].abs_diff(writes[1]) <= 1, "{polls:?} {writes:?}");
    let ratio = (writes[0] + writes[1]) as f64 / (polls[0] + polls[1]) as f64;
    assert!((3.5..=4.5).contains(&ratio), "{polls:?} {writes:?}");
    assert!(polls[0] > 80, "{polls:?}");
}

#[test]
fn what_is_asked_at_the_start_is_asked_again_when_the_slave_comes_back() {
    let table = [write(5, 10, 2, When::START), read(5, 10, 2, 50)];
    let mut line = Line::new(FAST, Echo::Absent, &[5], &table);
    line.values.push((0, vec![0, 7, 0, 8]));
    line.run(MS(500));
    assert_eq!(line.replies(0), 1);
    assert_eq!(line.node(5).bank.words[10..12], [7, 8]);

    line.node(5).alive = false;
    line.run(MS(5_000));
    assert_eq!(line.status(5).presence, Presence::Down);
    assert_eq!(line.replies(0), 1);
    // Without power it has forgotten what it was told.
    line.node(5).bank.words[10..12].fill(0);
    line.node(5).alive = true;
    line.take_told();
    line.run(MS(4_000));
    assert_eq!(line.status(5).presence, Presence::Up);
    assert_eq!(line.replies(0), 1);
    assert_eq!(line.node(5).bank.words[10..12], [7, 8]);
    assert!(line.replies(1) > 20, "{}", line.replies(1));
}

#[test]
fn a_slave_that_is_switched_on_later_gets_what_was_requested_before() {
    let table = [write(5, 0, 1, When::REQUESTED)];
    let mut line = Line::new(FAST, Echo::Absent, &[5], &table);
    line.node(5).alive = false;
    line.values = vec![(0, vec![0, 1])];
    line.request(0);
    line.run(MS(1_000));
    line.values = vec![(0, vec![0, 2])];
    line.node(5).alive = true;
    line.node(5).bank.words[0] = 0;
    line.run(MS(4_000));
    assert_eq!(line.node(5).bank.words[0], 2, "the newest value");
    assert_eq!(line.replies(0), 1, "once");
}

#[test]
fn an_exchange_without_values_is_passed_over() {
    let table = [write(5, 0, 1, When::every(MS(20))), read(5, 0, 1, 20), write(5, 3, 1, When::START)];
    let mut line = Line::new(FAST, Echo::Absent, &[5], &table);
    line.run(MS(1_000));
    assert_eq!((line.replies(0), line.replies(2)), (0, 0));
    assert!(line.replies(1) >= 49);
    assert!((50..=52).contains(&line.status(5).counters.unprepared), "{:?}", line.status(5));
    line.values.push((2, vec![0, 9]));
    line.request(2);
    line.run(MS(20));
    assert_eq!(line.node(5).bank.words[3], 9);
}

#[test]
fn a_broadcast_reaches_all_and_gives_them_time() {
    let table = [write(0, 3, 1, When::REQUESTED), read(1, 3, 1, 20)];
    let mut line = Line::new(FAST, Echo::Absent, &[1, 2, 3], &table);
    line.values.push((0, vec![0xBE, 0xEF]));
    line.run(MS(50));
    line.take_told();
    line.request(0);
    line.run(MS(200));
    assert!(line.nodes.iter().all(|node| node.bank.words[3] == 0xBEEF));
    let told: Vec<&(_, Told)> = line.told.iter().collect();
    let sent = told.iter().position(|(_, told)| matches!(told, Told::Sent(frame) if frame[0] == 0)).unwrap();
    assert_eq!(told[sent + 1].1, Told::Broadcast(0));
    let waited = told[sent + 1].0.saturating_since(told[sent].0);
    assert!(waited >= MS(100) && waited < MS(103), "{waited}");
    assert_eq!(line.collisions, 0);
    assert_eq!(line.node(2).slave.counters().broadcasts, 1);
}
