//! The state packet: each use of it beside a bare copy of its 1468 bytes, in one run.
//!
//! `cargo bench -p proto-core --bench state`

use divan::{Bencher, black_box};
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::wire::state::{LEN, StatePacket, StateStream, StateView};

fn main() {
    divan::main();
}

/// A packet with something in every kind of field.
fn packet() -> [u8; LEN] {
    let mut packet = StatePacket::ZERO;
    packet.joint_position = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1, 0.0];
    packet.tcp_pose = [0.41, -0.2, 0.63, 3.1, 0.02, -1.57];
    packet.float_outputs = core::array::from_fn(|nth| nth as f32 * 1.7);
    packet.word_outputs = core::array::from_fn(|nth| nth as u16 * 517);
    packet.digital_inputs = core::array::from_fn(|nth| (nth % 3 == 0) as u8);
    packet.bool_outputs = core::array::from_fn(|nth| (nth % 5 == 0) as u8);
    packet.to_bytes()
}

#[divan::bench]
fn bare_copy(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    let mut target = [0u8; LEN];
    bencher.bench_local(|| {
        black_box(&mut target).copy_from_slice(black_box(&bytes[..]));
    });
}

#[divan::bench]
fn into_the_image(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    let mut image = [0u8; IMAGE_BYTES];
    bencher.bench_local(|| {
        StateView::new(black_box(&bytes[..])).unwrap().copy_to_image(black_box(&mut image));
    });
}

#[divan::bench]
fn into_typed_fields(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    let mut target = StatePacket::ZERO;
    bencher.bench_local(|| {
        *black_box(&mut target) = StatePacket::parse(black_box(&bytes[..])).unwrap();
    });
}

#[divan::bench]
fn into_existing_typed_fields(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    let mut target = StatePacket::ZERO;
    bencher.bench_local(|| {
        StateView::new(black_box(&bytes[..])).unwrap().read_into(black_box(&mut target));
    });
}

#[divan::bench]
fn alignment_check(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    bencher.bench_local(|| StateView::new(black_box(&bytes[..])).unwrap().check_alignment().is_ok());
}

/// What a link does with each packet that arrives in one piece.
#[divan::bench]
fn stream_check_and_image(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    let mut stream = StateStream::new();
    let mut image = [0u8; IMAGE_BYTES];
    bencher.bench_local(|| {
        let mut chunk = black_box(&bytes[..]);
        while let Some(Ok(view)) = stream.next_packet(&mut chunk) {
            view.copy_to_image(black_box(&mut image));
        }
    });
}

/// The same, with packets that arrive in pieces of 536 bytes, the least an IPv4 host must take.
#[divan::bench]
fn stream_in_pieces(bencher: Bencher<'_, '_>) {
    let bytes = packet();
    let mut stream = StateStream::new();
    let mut image = [0u8; IMAGE_BYTES];
    bencher.bench_local(|| {
        for mut chunk in black_box(&bytes[..]).chunks(536) {
            while let Some(Ok(view)) = stream.next_packet(&mut chunk) {
                view.copy_to_image(black_box(&mut image));
            }
        }
    });
}

#[divan::bench]
fn typed_fields_into_bytes(bencher: Bencher<'_, '_>) {
    let packet = StatePacket::parse(&packet()).unwrap();
    let mut target = [0u8; LEN];
    bencher.bench_local(|| black_box(&packet).encode(black_box(&mut target[..])).is_ok());
}
