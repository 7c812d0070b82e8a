//! What is done with a state packet, each beside a bare copy of its 1468 bytes in the same run.
//! `-- instructions` counts instructions instead of measuring time.

mod instructions;

use std::hint::black_box;
use std::process::ExitCode;

use divan::Bencher;
use instructions::Work;
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::wire::state::{LEN, StatePacket, StateStream, StateView};

/// Three times what a bare copy takes.
const IMAGE_LIMIT: u64 = 564;

fn main() -> ExitCode {
    let works = [
        Work { name: "bare copy", limit: None, run: |n| repeat(n, Bench::bare_copy) },
        Work { name: "into the image", limit: Some(IMAGE_LIMIT), run: |n| repeat(n, Bench::image) },
        Work { name: "into typed fields", limit: None, run: |n| repeat(n, Bench::fields) },
        Work { name: "into a new value", limit: None, run: |n| repeat(n, Bench::value) },
        Work { name: "alignment check", limit: None, run: |n| repeat(n, Bench::check) },
        Work { name: "alignment check, closer look", limit: None, run: |n| repeat(n, Bench::closer) },
        Work { name: "stream, whole packets, image", limit: None, run: |n| repeat(n, Bench::stream) },
        Work { name: "stream, 536-byte pieces, image", limit: None, run: |n| repeat(n, Bench::pieces) },
        Work { name: "typed fields into bytes", limit: None, run: |n| repeat(n, Bench::encode) },
    ];
    instructions::main(&works).unwrap_or_else(|| {
        divan::main();
        ExitCode::SUCCESS
    })
}

#[divan::bench]
fn bare_copy(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::bare_copy);
}

#[divan::bench]
fn into_the_image(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::image);
}

#[divan::bench]
fn into_typed_fields(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::fields);
}

#[divan::bench]
fn into_a_new_value(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::value);
}

#[divan::bench]
fn alignment_check(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::check);
}

#[divan::bench]
fn alignment_check_closer_look(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::closer);
}

#[divan::bench]
fn stream_of_whole_packets_into_the_image(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::stream);
}

#[divan::bench]
fn stream_in_536_byte_pieces_into_the_image(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::pieces);
}

#[divan::bench]
fn typed_fields_into_bytes(bencher: Bencher<'_, '_>) {
    time(bencher, Bench::encode);
}

fn time(bencher: Bencher<'_, '_>, work: fn(&mut Bench)) {
    let mut bench = Bench::default();
    bencher.bench_local(|| work(black_box(&mut bench)));
}

fn repeat(iterations: u64, work: fn(&mut Bench)) {
    let mut bench = Bench::default();
    for _ in 0..iterations {
        work(black_box(&mut bench));
    }
}

struct Bench {
    bytes: [u8; LEN],
    /// The same from a controller that has not started yet.
    starting: [u8; LEN],
    target: [u8; LEN],
    image: [u8; IMAGE_BYTES],
    packet: StatePacket,
    stream: StateStream,
}

impl Default for Bench {
    /// A packet with something in every kind of field.
    fn default() -> Self {
        let mut packet = StatePacket::ZERO;
        packet.joint_position = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1, 0.0];
        packet.tcp_pose = [0.41, -0.2, 0.63, 3.1, 0.02, -1.57];
        packet.float_outputs = std::array::from_fn(|nth| nth as f32 * 1.7);
        packet.word_outputs = std::array::from_fn(|nth| nth as u16 * 517);
        packet.digital_inputs = std::array::from_fn(|nth| u8::from(nth % 3 == 0));
        packet.bool_outputs = std::array::from_fn(|nth| u8::from(nth % 5 == 0));
        let starting = packet.to_bytes();
        [packet.operation_mode, packet.robot_state, packet.program_state, packet.safety_state] = [2, 6, 2, 5];
        Self {
            bytes: packet.to_bytes(),
            starting,
            target: [0; LEN],
            image: [0; IMAGE_BYTES],
            packet,
            stream: StateStream::new(),
        }
    }
}

impl Bench {
    fn bare_copy(&mut self) {
        self.target.copy_from_slice(black_box(&self.bytes[..]));
    }

    fn image(&mut self) {
        let view = StateView::new(black_box(&self.bytes[..])).expect("a whole packet");
        view.copy_to_image(&mut self.image);
    }

    fn fields(&mut self) {
        let view = StateView::new(black_box(&self.bytes[..])).expect("a whole packet");
        view.read_into(&mut self.packet);
    }

    fn value(&mut self) {
        self.packet = StatePacket::parse(black_box(&self.bytes[..])).expect("a whole packet");
    }

    fn check(&mut self) {
        let view = StateView::new(black_box(&self.bytes[..])).expect("a whole packet");
        assert!(view.check_alignment().is_ok());
    }

    fn closer(&mut self) {
        let view = StateView::new(black_box(&self.starting[..])).expect("a whole packet");
        assert!(view.check_alignment().is_ok());
    }

    fn stream(&mut self) {
        let mut chunk = black_box(&self.bytes[..]);
        while let Some(packet) = self.stream.next_packet(&mut chunk) {
            packet.expect("aligned").copy_to_image(&mut self.image);
        }
    }

    /// 576 bytes are what every IPv4 host takes; 40 of them are headers.
    fn pieces(&mut self) {
        for mut chunk in black_box(&self.bytes[..]).chunks(536) {
            while let Some(packet) = self.stream.next_packet(&mut chunk) {
                packet.expect("aligned").copy_to_image(&mut self.image);
            }
        }
    }

    fn encode(&mut self) {
        self.packet.encode(black_box(&mut self.target[..])).expect("enough space");
    }
}
