//! Faults of field devices, seen from both ends: the gateway counts them, the controller gets only values
//! that were sent, and the next valid frame reaches its registers.

use proto_core::engine::{LinkId, PortCounters};
use proto_core::time::Duration;
use recipe_cell::{Cell, Chunking, LineId, Rng, Wiring};

use crate::kit::*;

/// Values that differ from frame to frame.
fn values(n: u32) -> [f32; 6] {
    std::array::from_fn(|axis| 1.5 + n as f32 + 10.0 * axis as f32)
}

/// A force sensor that has not sent yet.
fn sensor() -> (Cell, LineId) {
    let cell = cell("force-sensor");
    let line = cell.line_of("force");
    (cell, line)
}

/// What a fault added to the port's counters.
#[track_caller]
fn faulty(fault: impl FnOnce(&mut Cell, LineId)) -> PortCounters {
    let (mut cell, line) = sensor();
    next_good_frame(&mut cell, line, 1);
    fault(&mut cell, line);
    // Longer than the line's idle gap.
    cell.run_ms(10);
    let mut counters = *cell.port("force");
    next_good_frame(&mut cell, line, 2);
    assert_eq!(cell.port("force").frames_in, counters.frames_in + 1);
    counters.frames_in -= 1;
    counters.bytes_in -= 28;
    counters
}

#[track_caller]
fn next_good_frame(cell: &mut Cell, line: LineId, n: u32) {
    let arrived = cell.controller().counters().ports["udp2011"].frames_in;
    cell.send(line, &force_frame(values(n)));
    cell.run_ms(3);
    assert_eq!(force(cell), values(n), "frame {n} does not reach the controller");
    assert_eq!(cell.controller().counters().ports["udp2011"].frames_in, arrived + 1);
}

#[test]
fn garbage_between_frames() {
    let counters = faulty(|cell, line| {
        for n in 0..20 {
            cell.send(line, &[0x00, 0x13, 0xAA, 0x0D, 0x0A, 0x47, 0x99]);
            cell.send(line, &force_frame(values(100 + n)));
            cell.run_ms(3);
            assert_eq!(force(cell), values(100 + n));
        }
    });
    assert_eq!((counters.frames_in, counters.resync_bytes, counters.tail_mismatches), (20, 20 * 7, 0));
    assert_eq!(counters.discarded_bytes, 0);
}

#[test]
fn garbage_that_begins_like_a_frame() {
    let counters = faulty(|cell, line| {
        // A head, and a valid frame in place of the payload.
        cell.send(line, &[0x48, 0xAA, 0x01]);
        cell.send(line, &force_frame(values(100)));
        cell.run_ms(3);
        assert_eq!(force(cell), values(100));
    });
    assert_eq!((counters.frames_in, counters.tail_mismatches, counters.resync_bytes), (1, 1, 3));
}

#[test]
fn noise_that_nobody_sent_never_reaches_the_controller_as_a_value() {
    let (mut cell, line) = sensor();
    let mut rng = Rng::new(20);
    for n in 0..300 {
        // It cannot contain a head.
        let noise: Vec<u8> = rng.bytes(40).into_iter().map(|byte| byte & !0x08).collect();
        cell.send(line, &noise[..rng.between(1, 40) as usize]);
        next_good_frame(&mut cell, line, n);
    }
    assert_eq!(cell.port("force").frames_in, 300);
    assert_eq!(cell.link(LinkId::RECIPE_UDP).counters.malformed, 0);
}

#[test]
fn a_frame_cut_at_every_byte_and_silence() {
    for cut in 1..28_u32 {
        let counters = faulty(|cell, line| {
            cell.send(line, &force_frame(values(100))[..cut as usize]);
            cell.run_ms(10);
            assert_eq!(force(cell), values(1), "cut at {cut}");
        });
        assert_eq!((counters.frames_in, counters.discarded_bytes), (0, cut), "cut at {cut}");
        assert_eq!((counters.resync_bytes, counters.tail_mismatches), (0, 0), "cut at {cut}");
    }
}

#[test]
fn a_frame_cut_at_every_byte_and_the_next_at_its_heels() {
    for cut in 1..28_u32 {
        let counters = faulty(|cell, line| {
            let mut bytes = force_frame(values(100))[..cut as usize].to_vec();
            bytes.extend(force_frame(values(101)));
            cell.send(line, &bytes);
            cell.run_ms(3);
            assert_eq!(force(cell), values(101), "cut at {cut}");
        });
        assert_eq!((counters.frames_in, counters.resync_bytes), (1, cut), "cut at {cut}");
        // The first byte alone is no head yet.
        assert_eq!(counters.tail_mismatches, u32::from(cut >= 2), "cut at {cut}");
    }
}

#[test]
fn a_frame_that_pauses_at_every_byte_for_less_than_the_gap() {
    for cut in 1..28 {
        let counters = faulty(|cell, line| {
            let frame = force_frame(values(100));
            cell.send(line, &frame[..cut]);
            cell.run_ms(4);
            cell.send(line, &frame[cut..]);
            cell.run_ms(3);
            assert_eq!(force(cell), values(100), "cut at {cut}");
        });
        assert_eq!((counters.frames_in, counters.discarded_bytes, counters.resync_bytes), (1, 0, 0));
    }
}

#[test]
fn head_and_tail_inside_the_payload() {
    let counters = faulty(|cell, line| {
        let tricky = [
            [0x48, 0xAA, 0x48, 0xAA],
            [0x0D, 0x0A, 0x0D, 0x0A],
            [0x48, 0xAA, 0x0D, 0x0A],
            [0x0D, 0x0A, 0x48, 0xAA],
        ];
        for bytes in tricky {
            let value = f32::from_le_bytes(bytes);
            for chunk in 1..=28 {
                cell.line(line).chunking = Chunking::Pieces(chunk);
                cell.send(line, &force_frame([value; 6]));
                cell.run_ms(2);
                assert_eq!(force(cell), [value; 6]);
                cell.send(line, &force_frame(values(100)));
                cell.run_ms(2);
            }
        }
    });
    assert_eq!((counters.frames_in, counters.resync_bytes, counters.tail_mismatches), (4 * 28 * 2, 0, 0));
}

#[test]
fn joining_in_the_middle_of_a_frame_with_heads_in_it() {
    for start in 1..28 {
        faulty(|cell, line| {
            let value = f32::from_le_bytes([0x48, 0xAA, 0x48, 0xAA]);
            let mut bytes = force_frame([value; 6])[start..].to_vec();
            for n in 100..104 {
                bytes.extend(force_frame(values(n)));
            }
            cell.send(line, &bytes);
            cell.run_ms(5);
            assert_eq!(force(cell), values(103), "joined at {start}");
        });
    }
}

#[test]
fn a_wrong_tail() {
    let counters = faulty(|cell, line| {
        for (at, wrong) in [(26, 0x0A), (27, 0x0D), (26, 0x00), (27, 0xFF)] {
            let mut frame = force_frame(values(100));
            frame[at] = wrong;
            cell.send(line, &frame);
            cell.run_ms(3);
            assert_eq!(force(cell), values(1), "no value of a broken frame is taken");
        }
    });
    assert_eq!((counters.frames_in, counters.tail_mismatches, counters.resync_bytes), (0, 4, 4 * 28));
}

#[test]
fn two_frames_in_one_chunk() {
    let (mut cell, line) = sensor();
    cell.send(line, &[force_frame(values(7)), force_frame(values(8))].concat());
    cell.run_ms(3);
    assert_eq!(force(&cell), values(8), "the newest wins");
    assert_eq!(cell.port("force").frames_in, 2);
    let sent = cell.link(LinkId::RECIPE_UDP).counters.sent;
    assert_eq!(sent, 1, "of analog values only the newest is worth a datagram");
    next_good_frame(&mut cell, line, 9);
}

#[test]
fn bits_in_two_frames_of_one_chunk_are_both_written() {
    let mut cell = cell("rs485-system");
    let line = cell.line_of("rs485-1");
    outputs_get_through(&mut cell, line);
    let before = cell.controller().counters().modbus.requests;
    cell.send(line, &[outputs(1), outputs(0)].concat());
    cell.run_ms(20);
    assert_eq!(cell.controller().counters().modbus.requests, before + 2, "the edge is not lost");
    assert_eq!(cell.value("DO[1]"), 0.0);
    assert_eq!(cell.port("rs485-1").edges_lost, 0);
}

#[test]
fn one_frame_in_28_chunks() {
    let counters = faulty(|cell, line| {
        cell.line(line).chunking = Chunking::Pieces(1);
        for n in 100..150 {
            cell.send(line, &force_frame(values(n)));
            cell.run_ms(1);
            assert_eq!(force(cell), values(n));
        }
    });
    assert_eq!((counters.frames_in, counters.bytes_in, counters.resync_bytes), (50, 50 * 28, 0));
}

#[test]
fn a_recipe_swap_and_back() {
    let (mut cell, line) = sensor();
    next_good_frame(&mut cell, line, 1);
    // For a second the device sends frames of the worked examples.
    let before = cell.controller().counters().ports["udp2011"].frames_in;
    for n in 0..250_u32 {
        cell.send(line, &outputs(n as u8));
        cell.run_ms(4);
    }
    let counters = *cell.port("force");
    assert_eq!((counters.frames_in, counters.timeouts), (1, 1));
    assert_eq!(counters.resync_bytes + counters.discarded_bytes, 250 * 5);
    assert_eq!(force(&cell), [0.0; 6], "the safe values: nobody measures");
    let after = cell.controller().counters().ports["udp2011"].frames_in;
    // Nothing shows whether they have arrived, so they are repeated each 4 ms for a second.
    assert!((240..=250).contains(&(after - before)), "the safe values, {} times", after - before);
    next_good_frame(&mut cell, line, 2);
}

#[test]
fn a_swap_to_a_longer_recipe_with_the_same_head_takes_nothing_wrong() {
    // The same head and tail around eight floats: the tail is not where the recipe has it.
    let longer = |n: f32| {
        let mut frame = vec![0x48, 0xAA];
        frame.extend([n; 8].iter().flat_map(|value| value.to_le_bytes()));
        frame.extend([0x0D, 0x0A]);
        frame
    };
    let counters = faulty(|cell, line| {
        for n in 0..100_u8 {
            cell.send(line, &longer(f32::from(n)));
            cell.run_ms(1);
            assert!([values(1), [0.0; 6]].contains(&force(cell)), "held, then safe: {:?}", force(cell));
        }
    });
    assert_eq!((counters.frames_in, counters.tail_mismatches), (0, 100));
    assert_eq!(counters.resync_bytes + counters.discarded_bytes, 100 * 36);
}

#[test]
fn a_value_that_is_no_number_rejects_its_frame_alone() {
    let counters = faulty(|cell, line| {
        for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for axis in 0..6 {
                let mut sent = values(100);
                sent[axis] = wrong;
                cell.send(line, &force_frame(sent));
                cell.run_ms(1);
                assert!(force(cell).iter().all(|value| value.is_finite()));
                assert_ne!(force(cell)[5 - axis], sent[5 - axis], "nothing of the frame is taken");
            }
        }
    });
    assert_eq!((counters.frames_in, counters.rejected_not_finite), (0, 18));
}

#[test]
fn a_noisy_line_passes_on_only_what_it_cannot_tell() {
    // With one bit flipped in every thousandth byte, a frame is intact, or rejected, or has a wrong bit that
    // no check of the format can detect. The counters account for all of them.
    let (mut cell, line) = sensor();
    cell.line(line).noise_ppm = 1_000;
    for n in 0..2_000 {
        cell.send(line, &force_frame(values(n)));
        cell.run(Duration::from_micros(1_041));
    }
    cell.line(line).noise_ppm = 0;
    cell.run_ms(10);
    let counters = *cell.port("force");
    let garbled = cell.line(line).counters.garbled_bytes;
    assert!(garbled > 20, "{garbled}");
    assert!((1_960..2_000).contains(&counters.frames_in), "{counters:?}");
    let accounted = counters.frames_in * 28
        + counters.resync_bytes
        + counters.discarded_bytes
        + counters.rejected_not_finite * 28;
    assert_eq!(accounted, counters.bytes_in);
    next_good_frame(&mut cell, line, 5);
}

#[test]
fn a_line_that_is_cut_and_repaired() {
    let (mut cell, line) = sensor();
    for round in 0..3 {
        next_good_frame(&mut cell, line, round);
        cell.cut(line);
        for n in 0..50 {
            cell.send(line, &force_frame(values(100 + n)));
            cell.run_ms(1);
        }
        assert_eq!(force(&cell), [0.0; 6]);
        assert_eq!(cell.port("force").timeouts, round + 1);
        cell.repair(line);
    }
    next_good_frame(&mut cell, line, 9);
}

#[test]
fn an_adapter_pulled_out_and_back() {
    let mut cell = cell("rs485-system");
    let line = cell.line_of("rs485-1");
    outputs_get_through(&mut cell, line);
    let sent = cell.port("rs485-1").frames_out;
    cell.unplug(line);
    cell.run_ms(1_000);
    assert!(cell.port("rs485-1").frames_out <= sent + 1, "nothing is sent into the air");
    // A wire that is repaired meanwhile leads nowhere.
    cell.repair(line);
    let received = cell.port("rs485-1").frames_in;
    cell.send(line, &outputs(1));
    cell.run_ms(40);
    assert_eq!(cell.port("rs485-1").frames_in, received);
    cell.line(line).take_heard();
    cell.plug_in(line);
    cell.run_ms(40);
    assert!((9..=10).contains(&heard(&mut cell, line).len()));
    assert_eq!(cell.port("rs485-1").downs, 1);
    outputs_get_through(&mut cell, line);
}

#[test]
fn two_on_one_pair_still_get_something_through() {
    // On two wires a device that sends without a request collides with the cyclic output. Garbled frames are
    // dropped, the others get through.
    let mut cell = cell("rs485-system");
    let line = cell.line_of("rs485-1");
    cell.line(line).wiring = Wiring::TwoWire;
    for n in 0..500_u32 {
        cell.send(line, &outputs(n as u8 & 1));
        cell.run(Duration::from_micros(3_300));
    }
    let counters = *cell.port("rs485-1");
    assert!((50..450).contains(&counters.frames_in), "{counters:?}");
    assert!(cell.line(line).counters.overlaps > 100);
    cell.line(line).wiring = Wiring::FourWire;
    cell.run_ms(100);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_can_bus_that_loses_goes_off_and_carries_strangers() {
    let mut cell = cell("can-system");
    let bus = cell.bus_of("can-1");
    let switch = |cell: &mut Cell, byte: u8| {
        cell.send_can(bus, can(1, &[byte]));
        cell.run_ms(5);
        assert_eq!(cell.value("DigitalOutputCommand[1]"), f64::from(byte));
    };
    switch(&mut cell, 1);
    // Unknown ids, wrong lengths, a remote frame.
    cell.send_can(bus, can(9, &[0]));
    cell.send_can(bus, can(1, &[]));
    cell.send_can(bus, can(1, &[0, 0]));
    let id = proto_core::wire::can::CanId::Standard(1);
    cell.send_can(bus, proto_core::wire::can::CanFrame::remote(id, 1).unwrap());
    let id = proto_core::wire::can::CanId::Extended(1);
    cell.send_can(bus, proto_core::wire::can::CanFrame::new(id, &[0]).unwrap());
    cell.run_ms(10);
    assert_eq!(cell.value("DO[1]"), 1.0);
    let counters = *cell.port("can-1");
    assert_eq!((counters.rejected_id, counters.rejected_length, counters.rejected_remote), (2, 2, 1));
    // Bus-off: nothing is sent; afterwards the cycles go on.
    cell.bus_off(bus);
    cell.bus(bus).take_heard();
    cell.run_ms(400);
    let sent = cell.bus(bus).take_heard().len();
    assert!(sent <= 1, "{sent}: at most what was on the bus");
    cell.bus_on(bus);
    cell.run_ms(40);
    assert!((27..=30).contains(&cell.bus(bus).take_heard().len()));
    assert_eq!(cell.port("can-1").bus_offs, 1);
    switch(&mut cell, 2);
    cell.bus(bus).loss_ppm = 500_000;
    for n in 0..100 {
        cell.send_can(bus, can(1, &[n]));
        cell.run_ms(1);
    }
    cell.bus(bus).loss_ppm = 0;
    let counters = *cell.port("can-1");
    assert!((20..80).contains(&(counters.frames_in - 2)), "{counters:?}");
    switch(&mut cell, 3);
}
