//! Frames of devices: encodings, checksums, layouts, framing.

use core::hint::black_box;

use proto_core::config::{DeviceFrame, FieldSpec};
use proto_core::device::{
    Algorithm, Boundary, ByteOrder, Carrier, Checksum, Cutter, Element, Encoding, Escape, FrameLayout,
    Framer, Overflow, Text, TextWidth,
};
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;

use crate::{any, bytes, out_buf};

pub(crate) fn all() {
    device_encoding(any(Encoding::scalar(ScalarType::Byte)));
    device_order(any(ByteOrder::Little));
    if let Some(algorithm) = any(Algorithm::named(any("crc16-modbus"))) {
        device_checksum(&algorithm);
        if let Some(layout) = device_layout(Checksum::standard(algorithm)) {
            let layout = black_box(&layout);
            device_codec(layout);
            device_framer(black_box(&mut Framer::new()), layout);
        }
    }
    device_frame();
    device_cutter();
    device_text();
}

fn elements() -> &'static [Element] {
    static ELEMENTS: [Element; 4] = [Element::value(Encoding::scalar(ScalarType::Byte)); 4];
    black_box(&ELEMENTS[..])
}

#[inline(never)]
fn device_encoding(encoding: Encoding) {
    let mut out = [0; 32];
    black_box((encoding.size(), encoding.until(), encoding.is_integer(), encoding.range()));
    let _ = black_box(encoding.read(bytes()));
    if let Some(value) = encoding.fit(any(0.5), any(Overflow::Wrap)) {
        black_box(encoding.write(value, out_buf(&mut out)));
    }
    // A value outside the range of every encoding.
    black_box(encoding.write(any(f64::INFINITY), out_buf(&mut out)));
}

#[inline(never)]
fn device_order(order: ByteOrder) {
    let mut out = [0; 8];
    black_box((order.read(bytes()), order.swaps_words()));
    order.write(any(7), out_buf(&mut out));
}

#[inline(never)]
fn device_checksum(algorithm: &Algorithm) {
    black_box((algorithm.name(), algorithm.len(), algorithm.is_empty(), algorithm.order()));
    black_box(algorithm.of([bytes(), bytes()]));
    Algorithm::names().for_each(|name| _ = black_box(name));
    let sum = any(Checksum::standard(*algorithm)).over(any(1), any(None));
    black_box((sum.len(), sum.is_empty()));
}

#[inline(never)]
fn device_layout(sum: Checksum) -> Option<FrameLayout> {
    let checksum = any(Some((sum, 4)));
    let layout =
        FrameLayout::new(any(Carrier::Stream), any(Direction::Input), bytes(), bytes(), elements(), checksum);
    match layout {
        Ok(layout) => Some(layout),
        Err(error) => {
            black_box((error.element(), error.is_of_checksum()));
            None
        }
    }
}

#[inline(never)]
fn device_codec(layout: &FrameLayout) {
    let mut out = [0; 512];
    black_box((layout.lengths(), layout.probe(elements(), bytes())));
    layout.values(elements(), bytes()).for_each(|value| _ = black_box(value));
    black_box(layout.probe_whole(elements(), bytes()));
    black_box(layout.text(elements(), bytes(), any(1)));
    layout.parts(elements(), |part, place| _ = black_box((part, place)));
    black_box((layout.checksums(elements(), bytes()), layout.tail()));
    black_box(layout.encode(elements(), |_| any(0.5), out_buf(&mut out)));
    black_box(layout.encode_with(elements(), |_| any(0.5), |_, _| any(Some(3)), out_buf(&mut out)));
}

#[inline(never)]
fn device_framer(framer: &mut Framer, layout: &FrameLayout) {
    let mut chunk = bytes();
    while let Some(found) = framer.next_frame(&mut chunk, any(9), |bytes| layout.probe(elements(), bytes)) {
        black_box(found);
    }
    // A checksum probe that returns arbitrary values.
    black_box(framer.next_frame(&mut chunk, any(9), |_| any(proto_core::device::Probe::No(1))));
    black_box(framer.held());
    black_box((framer.discard(), framer.stats()));
}

#[inline(never)]
fn device_frame() {
    static FIELDS: [FieldSpec; 4] = [FieldSpec::Padding { len: 1, fill: 0 }; 4];
    let fields = black_box(&FIELDS[..]);
    for field in fields {
        black_box((field.is_device(), field.element()));
    }
    let (carrier, direction) = (any(Carrier::Can), any(Direction::Input));
    if let Ok(frame) = DeviceFrame::new(carrier, direction, (bytes(), bytes()), fields) {
        black_box(&frame);
    }
}

#[inline(never)]
fn device_cutter() {
    let Some(mut cutter) = Cutter::new(any(Boundary::Fields), any(Some(Escape::Slip))) else { return };
    let (cutter, mut chunk, mut out) = (black_box(&mut cutter), bytes(), [0; 512]);
    while let Some(piece) = cutter.next_piece(&mut chunk, bytes()) {
        black_box(piece);
    }
    black_box(cutter.silence());
    black_box((cutter.held(), cutter.has_begun(), cutter.ends_by_silence()));
    black_box((cutter.discard(), cutter.skipped_bytes()));
    let escape = any(Escape::Slip);
    black_box((escape.longest(any(7)), escape.stuff(any(7), out_buf(&mut out))));
}

#[inline(never)]
fn device_text() {
    let text = any(Text { width: TextWidth::Fixed(8), fill: None });
    black_box(text.trimmed(bytes()));
}
