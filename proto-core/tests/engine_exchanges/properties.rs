//! Any table, any slaves, any trouble, against a line that remembers everything.
//!
//! The line keeps what was asked and what came, and judges without the engine's own state: values come
//! only from good replies to requests for them, one request is on the line at a time, every exchange of
//! a live slave keeps being asked, and the counters add up.

use proptest::collection::vec;
use proptest::prelude::*;
use proto_core::config::*;
use proto_core::engine::{Input, PortId};
use proto_core::modbus::rtu::Operation;
use proto_core::time::{Duration, Instant};

use crate::line::*;
use crate::rig::*;

const TIMEOUT: Duration = Duration::from_millis(20);
/// Silence of the line before a request.
const SILENCE: Duration = Duration::from_micros(1_750);

/// What a slave does with a request.
#[derive(Debug, Clone, Copy)]
enum Does {
    Answers {
        after: u64,
    },
    Refuses,
    Garbles {
        at: u8,
        change: u8,
    },
    /// Its reply comes behind the timeout, and within two: a later one cannot be told from others.
    IsLate {
        by: u64,
    },
    Nothing,
    /// Bytes without a meaning, then the reply, if there is still time.
    Babbles(u8),
    /// Another slave answers, or with another length.
    MistakesIt(bool),
}

fn deed() -> impl Strategy<Value = Does> {
    prop_oneof![
        6 => (1..15_u64).prop_map(|after| Does::Answers { after }),
        1 => Just(Does::Refuses),
        1 => (any::<u8>(), 1..=255_u8).prop_map(|(at, change)| Does::Garbles { at, change }),
        1 => (0..19_u64).prop_map(|by| Does::IsLate { by }),
        1 => Just(Does::Nothing),
        1 => any::<u8>().prop_map(Does::Babbles),
        1 => any::<bool>().prop_map(Does::MistakesIt),
    ]
}

#[derive(Debug, Clone)]
struct Table {
    /// Slave, period in ms, repetitions, pause in ms; each reads its own register into its own variable.
    polls: Vec<(u8, u64, u8, u64)>,
    dead: Option<u8>,
    has_echo: bool,
}

fn table() -> impl Strategy<Value = Table> {
    let poll = (
        1..5_u8,
        prop_oneof![Just(40), Just(100), Just(250)],
        0..3_u8,
        prop_oneof![3 => Just(0), 1 => Just(5)],
    );
    (vec(poll, 1..7), proptest::option::of(1..5_u8), any::<bool>())
        .prop_map(|(polls, dead, has_echo)| Table { polls, dead, has_echo })
}

/// The register that an exchange reads, and its variable's.
const FIRST: u16 = 100;

fn cell(table: &Table) -> (Cell, PortId) {
    let mut cell = Cell::new();
    let exchanges: Vec<_> = (0..)
        .zip(&table.polls)
        .map(|(nth, &(slave, every, retries, pause))| {
            let name = format!("WordInputReg[{}]", nth + 1);
            let poll = reads(&mut cell, slave, &[&name], Triggers::every(MS(every)));
            let Transaction::Rtu { read, written, .. } = poll.transaction else { panic!() };
            let operation = Operation::ReadHoldingRegisters { address: FIRST + nth, count: 1 };
            let transaction = Transaction::Rtu { operation, written, read };
            Exchange { transaction, timeout: TIMEOUT, late: None, retries, pause: MS(pause), ..poll }
        })
        .collect();
    let port = talking(&mut cell, &exchanges);
    let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!() };
    (line.turnaround, line.echo) = (SILENCE, if table.has_echo { Echo::Yes } else { Echo::No });
    cell.last_port().timeout = MS(60_000);
    (cell, port)
}

/// What the line remembers.
struct Memory {
    /// The newest request, when it left, and whether it may still be answered.
    asked: Option<(u16, Instant)>,
    /// The last byte on the line.
    heard: Instant,
    /// For each register: what good replies to requests for it have said.
    said: Vec<Vec<u16>>,
    /// When each exchange was asked.
    times: Vec<Vec<Instant>>,
    coming: Vec<(Instant, Vec<u8>)>,
    value: u16,
}

impl Memory {
    /// Every reply has a value of its own.
    fn reply(&mut self, slave: u8) -> Vec<u8> {
        self.value += 1;
        registers(slave, &[self.value])
    }
}

/// Runs the cell until `end` or until the deeds are used up; then every slave answers at once.
fn play(table: &Table, deeds: &[Does], span: Duration) -> Result<(), TestCaseError> {
    let (cell, port) = cell(table);
    let mut rig = cell.rig();
    let start = rig.now;
    let mut memory = Memory {
        asked: None,
        heard: Instant::ZERO,
        said: vec![Vec::new(); table.polls.len()],
        times: vec![Vec::new(); table.polls.len()],
        coming: Vec::new(),
        value: 0,
    };
    let mut deeds = deeds.iter().copied();
    let mut faults_end = None;
    let mut requests = 0_u32;
    while rig.now < start + span {
        for request in rig.sent_to(port) {
            requests += 1;
            let nth = usize::from(u16::from_be_bytes([request[2], request[3]]) - FIRST);
            let slave = request[0];
            prop_assert_eq!(slave, table.polls[nth].0);
            prop_assert_eq!(&request, &with_crc(&request[..6]));
            // (b) One at a time, and behind the silence.
            if let Some((_, left)) = memory.asked {
                prop_assert!(rig.now >= left + TIMEOUT, "asked while a reply may come");
            }
            prop_assert!(rig.now >= memory.heard + SILENCE, "asked before the line was silent");
            memory.asked = Some((nth as u16, rig.now));
            memory.times[nth].push(rig.now);
            let deed = deeds.next();
            if deed.is_none() {
                faults_end.get_or_insert(rig.now);
            }
            let mut deed = deed.unwrap_or(Does::Answers { after: 2 });
            if table.dead == Some(slave) {
                deed = Does::Nothing;
            }
            let good = memory.reply(slave);
            let (after, bytes) = match deed {
                Does::Answers { after } => (MS(after), good.clone()),
                Does::Refuses => (MS(1), with_crc(&[slave, 0x83, 2])),
                Does::Garbles { at, change } => {
                    let mut wrong = good.clone();
                    let at = usize::from(at) % wrong.len();
                    wrong[at] ^= change;
                    (MS(3), wrong)
                }
                Does::IsLate { by } => (TIMEOUT + Duration::from_micros(1) + MS(by), good.clone()),
                Does::Nothing => (MS(1), Vec::new()),
                Does::Babbles(byte) => (MS(2), [&[byte, byte, byte][..], &good].concat()),
                Does::MistakesIt(true) => (MS(2), registers(slave ^ 8, &[9_999])),
                Does::MistakesIt(false) => (MS(2), registers(slave, &[9_999, 9_998])),
            };
            if table.has_echo {
                memory.coming.push((rig.now + Duration::from_micros(700), request.clone()));
            }
            if !bytes.is_empty() {
                memory.coming.push((rig.now + after, bytes));
            }
            memory.said[nth].push(memory.value);
        }
        memory.coming.sort_by_key(|(at, _)| *at);
        let next = memory.coming.first().map_or(Instant::NEVER, |(at, _)| *at);
        if next <= rig.wake {
            rig.now = next.max(rig.now);
            let (_, bytes) = memory.coming.remove(0);
            let before = rig.counters(port);
            memory.heard = rig.now;
            rig.bytes(port, &bytes);
            let after = rig.counters(port);
            let is_over = after.frames_in != before.frames_in || after.refused != before.refused;
            // A wrong reply ends it too, once the line is silent: what counts it is the engine's word.
            if is_over || after.rejected_checksum != before.rejected_checksum {
                memory.asked = None;
            }
        } else {
            rig.now = rig.wake.max(rig.now);
            rig.input(Input::Tick);
        }
        // (a) No value from anywhere but a reply to a request for it.
        for written in rig.take_written() {
            let Written::Registers(address, words) = written else { panic!() };
            for (at, word) in (address..).zip(words) {
                let nth = usize::from(at - 8);
                prop_assert!(memory.said[nth].contains(&word), "register {} was never {}", nth, word);
            }
        }
    }
    // (c) Long after the last fault, every exchange of a live slave is asked.
    if let Some(end) = faults_end {
        let settled = end + MS(5_000);
        for (nth, &(slave, every, ..)) in table.polls.iter().enumerate() {
            let late = memory.times[nth].iter().filter(|at| **at >= settled).count() as u64;
            let wanted = (start + span).saturating_since(settled).as_millis() / every;
            if table.dead == Some(slave) {
                prop_assert!(memory.times[nth].len() > 1, "a dead slave is asked again");
            } else {
                prop_assert!(late + 2 >= wanted * 3 / 4, "exchange {}: {} of {}", nth, late, wanted);
            }
        }
    }
    // (d) The counters add up, with what was sent at the end.
    requests += rig.sent_to(port).len() as u32;
    let now = rig.now;
    let status = rig.engine.status(now).ports().next().unwrap();
    let (mut sent, mut ended) = (0, 0);
    for peer in status.peers() {
        let counters = peer.counters;
        sent += counters.requests;
        let of_peer = counters.replies + counters.refused + counters.timeouts + counters.checksums;
        prop_assert!(counters.requests - of_peer <= 1, "{:?}", counters);
        ended += of_peer;
    }
    prop_assert_eq!(sent, requests);
    prop_assert!(sent - ended <= 1, "{} sent, {} ended", sent, ended);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn a_line_keeps_its_promises(table in table(), deeds in vec(deed(), 0..120)) {
        play(&table, &deeds, MS(20_000))?;
    }
}
