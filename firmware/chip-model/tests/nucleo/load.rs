//! The same cell under load, alone and beside something that takes time of the board: what it did must be the same.

use recipe_chip_model::device::{MICRO, MILLI, Picos, SECOND};
use recipe_chip_model::models::can_bus::Frame;
use recipe_chip_model::models::line::Format;
use serde_json::Value;

use crate::Bench;
use crate::cell::off_the_grid;
use crate::client::ask_signed;
use crate::serial::word;

/// Of each port: what is the same in both.
const COUNTERS: [&str; 5] = ["frames_in", "skipped_cycles", "resync_bytes", "discarded_bytes", "timeouts"];
const FORMAT: Format = Format { baud: 115_200, odd_parity: None, stop_bits: 1 };

/// What a cell did during the load.
pub(crate) struct LoadReport {
    span: Picos,
    /// Of each bus: frames that left, and how much one was off its time at most.
    out: [(&'static str, usize, Picos); 2],
    /// The document `status` at the end.
    status: Value,
    instructions: u64,
}

/// Aligns the test's frames, one every 8 ms, with the middle between those of the board, one every 4 ms on the same
/// line, so that they never collide even if the board is a millisecond late.
fn align(bench: &mut Bench) {
    let sent = &bench.chip.devices().usart2.line.sent;
    let last = sent.chunks_exact(7).next_back().expect("it sends every 4 ms")[0].start;
    let phase = (bench.now() - last) % (4 * MILLI);
    bench.run(6 * MILLI - phase);
}

/// Frames come on the line every 8 ms and on CAN every 2 ms; `others` do what they do in between.
pub(crate) fn work(bench: &mut Bench, span: Picos, mut others: impl FnMut(&mut Bench)) -> LoadReport {
    align(bench);
    let (begin, instructions) = (bench.now(), bench.chip.instructions());
    let mut number = 0_u8;
    for step in 0..span / (2 * MILLI) {
        let now = begin + step * 2 * MILLI;
        number = number.wrapping_add(1);
        if step % 4 == 0 {
            bench.chip.devices().usart2.line.send(now, &[255, 255, number, 0, 7, 238, 238], FORMAT);
        }
        bench.chip.devices().can.bus.send(now + 500 * MICRO, Frame::standard(1, &[number]));
        others(bench);
        bench.run(now + 2 * MILLI - bench.now());
    }
    let out = off_the_grid(bench, begin);
    let instructions = bench.chip.instructions() - instructions;
    // The newest ones are with the controller.
    bench.run(20 * MILLI);
    assert_eq!(word(bench, "WordInputReg[4]"), f64::from(number));
    // Connections of the others are gone, or given up.
    bench.run(7 * SECOND);
    let status = ask_signed(bench, "GET /api/v1/status").json();
    LoadReport { span, out, status, instructions }
}

impl LoadReport {
    fn print(&self, what: &str) {
        let millions = self.instructions as f64 * SECOND as f64 / self.span as f64 / 1e6;
        println!("{what}: {millions:.1} million instructions a second");
        for (bus, frames, off) in self.out {
            println!("  {bus}: {frames} frames out, off by {} us at most", off / MICRO);
        }
        for (name, histogram) in self.status["latency"].as_object().expect("an object") {
            let [count, median, most] = ["count", "p50_us", "max_us"].map(|key| &histogram[key]);
            println!("  {name}: {count}, median {median} us, at most {most} us");
        }
    }

    /// As many frames and cycles as `alone`, none of them `later` more off its time, and nothing lost.
    #[track_caller]
    pub(crate) fn is_like(&self, alone: &Self, what: &str, later: Picos) {
        alone.print("alone");
        self.print(what);
        for ((bus, usual, usual_off), (_, frames, off)) in alone.out.into_iter().zip(self.out) {
            assert!(usual.abs_diff(frames) <= 1, "{bus}: {frames} cycles of {usual}");
            assert!(
                off < usual_off + later,
                "{bus}: off by {} us instead of {}",
                off / MICRO,
                usual_off / MICRO
            );
        }
        for port in ["rs485-1", "can-1"] {
            for counter in COUNTERS {
                let [usual, counted] = [alone, self].map(|did| {
                    let counters = &did.status["ports"][port]["counters"];
                    counters[counter].as_u64().unwrap_or_else(|| panic!("no {port}.{counter}: {counters}"))
                });
                assert_eq!(usual, counted, "{port}.{counter} of {}", self.status);
            }
        }
        assert_eq!(self.status["sleeps"], 0);
    }
}
