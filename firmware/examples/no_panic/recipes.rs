//! Recipes: layouts, frames in bytes and datagrams, CAN frames, values.

use core::hint::black_box;

use proto_core::recipe::CanLayout;
use proto_core::recipe::StreamLayout;
use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{Deframer, datagram};
use proto_core::sysvar::{Direction, IMAGE_BYTES};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};

use crate::{any, bytes, out_buf};

const RULES: Rules = Rules { mode: Mode::User, direction: Direction::Input };

pub(crate) fn all() {
    if let Some(layout) = stream_layout() {
        let layout = black_box(&layout);
        let mut deframer = Deframer::new();
        deframer_next_frame(black_box(&mut deframer), layout);
        stream_codec(layout);
    }
    if let Some(layout) = can_layout() {
        can_codec(black_box(&layout));
    }
    can_frame();
}

fn fields() -> impl Iterator<Item = Field> {
    static FIELDS: [Field; 4] = [Field::User(ScalarType::Byte); 4];
    black_box(&FIELDS[..]).iter().copied()
}

fn values() -> &'static [Scalar] {
    static VALUES: [Scalar; 4] = [Scalar::Byte(0); 4];
    black_box(&VALUES[..])
}

#[inline(never)]
fn stream_layout() -> Option<StreamLayout> {
    StreamLayout::new(any(RULES), bytes(), bytes(), fields(), any(Framing::Bytes)).ok()
}

#[inline(never)]
fn deframer_next_frame(deframer: &mut Deframer, layout: &StreamLayout) {
    let mut chunk = bytes();
    while let Some(payload) = deframer.next_frame(layout, &mut chunk) {
        black_box(payload);
    }
    black_box((deframer.pending(), deframer.discard(), deframer.stats()));
    let _ = black_box(datagram(layout, bytes()));
}

#[inline(never)]
fn stream_codec(layout: &StreamLayout) {
    let (mut image, mut out) = ([0; IMAGE_BYTES], [0; 512]);
    let image = black_box(&mut image);
    let _ = black_box(layout.check(bytes()));
    let _ = black_box(layout.apply(bytes(), image));
    layout.values(bytes()).for_each(|value| _ = black_box(value));
    layout.fields().for_each(|field| _ = black_box(field));
    let _ = black_box(layout.encode(image, out_buf(&mut out)));
    let _ = black_box(layout.encode_values(values(), out_buf(&mut out)));
    black_box((layout.head(), layout.tail(), layout.rules()));
}

#[inline(never)]
fn can_layout() -> Option<CanLayout> {
    let ids = [(); 2].map(|()| (any(CanId::Standard(1)), fields()));
    CanLayout::new(any(RULES), ids).ok()
}

#[inline(never)]
fn can_codec(layout: &CanLayout) {
    let Some(frame) = any(CanFrame::new(any(CanId::Standard(1)), bytes())) else { return };
    let mut image = [0; IMAGE_BYTES];
    let image = black_box(&mut image);
    let _ = black_box((layout.accept(&frame), layout.accept_frame(&frame)));
    layout.ids().for_each(|id| _ = black_box(id));
    for frame in layout.frames() {
        let _ = black_box(frame.check(bytes()));
        let _ = black_box(frame.apply(bytes(), image));
        frame.values(bytes()).for_each(|value| _ = black_box(value));
        frame.fields().for_each(|field| _ = black_box(field));
        black_box(frame.encode(image));
        let _ = black_box(frame.encode_values(values()));
    }
}

#[inline(never)]
fn can_frame() {
    use embedded_can::Frame;
    black_box(CanFrame::remote(any(CanId::Standard(1)), any(8)));
    if let Some(frame) = any(CanFrame::new(any(CanId::Extended(1)), bytes())) {
        black_box((Frame::id(&frame), frame.dlc(), frame.data(), frame.is_extended()));
        black_box(<CanFrame as Frame>::new(Frame::id(&frame), bytes()));
        black_box(CanFrame::new_remote(Frame::id(&frame), any(9)));
    }
}
