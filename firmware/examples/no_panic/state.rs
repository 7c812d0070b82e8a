//! The state packet: deframed, as a view, as a value, applied to the image.

use core::hint::black_box;

use proto_core::sysvar::{IMAGE_BYTES, SysVar};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::{LEN, StatePacket, StateStream, StateView};

use crate::{any, bytes, out_buf};

pub(crate) fn all() {
    state_stream();
    if let Ok(view) = any(StateView::new(bytes())) {
        state_view(view);
    }
    state_packet();
}

#[inline(never)]
fn state_stream() {
    let mut stream = StateStream::new();
    let stream = black_box(&mut stream);
    let mut chunk = bytes();
    while let Some(packet) = stream.next_packet(&mut chunk) {
        let _ = black_box(packet);
    }
    black_box((stream.is_lost(), stream.packets(), stream.misaligned(), stream.pending()));
    stream.reset();
}

#[inline(never)]
fn state_view(view: StateView<'_>) {
    let mut image = [0; IMAGE_BYTES];
    view.copy_to_image(black_box(&mut image));
    let _ = black_box(view.check_alignment());
    let dialect = any(Dialect::V2_3);
    black_box((view.states(&dialect), view.global_speed(&dialect)));
    for var in SysVar::all() {
        black_box(view.read_var(var));
    }
}

#[inline(never)]
fn state_packet() {
    let mut packet = StatePacket::ZERO;
    let packet = black_box(&mut packet);
    if let Ok(view) = any(StateView::new(bytes())) {
        view.read_into(packet);
    }
    let mut out = [0; LEN];
    let _ = black_box(packet.encode(out_buf(&mut out)));
    let _ = black_box(StatePacket::parse(bytes()));
    black_box(packet.to_bytes());
}
