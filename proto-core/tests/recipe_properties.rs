//! Any valid recipe, any values: what is encoded, cut, polluted and decoded is exactly what was sent
//! (docs/wire/recipes.md sections 2 to 7).

mod reference;

use proptest::collection::vec as many;
use proptest::prelude::*;
use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{CanLayout, Deframer, StreamLayout, datagram};
use proto_core::sysvar::{Direction, IMAGE_BYTES, SysVar};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::{Scalar, ScalarType};
use reference::PlainDeframer;

/// A part that keeps every rule, and its fields.
type Recipe = (StreamLayout, Vec<Field>);

fn rules() -> impl Strategy<Value = Rules> {
    let mode = prop::sample::select(vec![Mode::Realtime, Mode::User]);
    let direction = prop::sample::select(vec![Direction::Input, Direction::Output]);
    (mode, direction).prop_map(|(mode, direction)| Rules { mode, direction })
}

/// As many of `picks` as are fields of such a part and have room in `space` bytes; never none.
fn fields(rules: Rules, picks: &[usize], most: usize, space: usize) -> Vec<Field> {
    let vars: Vec<SysVar> = SysVar::all().filter(|var| var.direction() == rules.direction).collect();
    let (mut fields, mut len) = (Vec::new(), 0);
    for &pick in picks {
        let field = match rules.mode {
            Mode::Realtime => Field::System(vars[pick % vars.len()]),
            Mode::User => Field::User(ScalarType::ALL[pick % 8]),
        };
        let twice = rules.mode == Mode::Realtime && fields.contains(&field);
        if fields.len() < most && len + field.ty().size() <= space && !twice {
            len += field.ty().size();
            fields.push(field);
        }
    }
    fields
}

/// How full a part is: a few fields, or all that fit in 512 bytes.
fn picks() -> impl Strategy<Value = Vec<usize>> {
    let some = many(any::<usize>(), 1..12);
    let neighbours = (any::<usize>(), 1..128_usize)
        .prop_map(|(first, count)| (0..count).map(|nth| first / 2 + nth).collect());
    let all_that_fit = many(any::<usize>(), 400..401);
    prop_oneof![4 => some, 2 => neighbours, 1 => all_that_fit]
}

fn recipe(delimiter: BoxedStrategy<Vec<u8>>) -> impl Strategy<Value = Recipe> {
    (rules(), picks(), delimiter.clone(), delimiter).prop_filter_map(
        "a part needs a head or a tail",
        |(rules, picks, head, tail)| {
            let fields = fields(rules, &picks, 128, 512 - head.len() - tail.len());
            let layout =
                StreamLayout::new(rules, &head, &tail, fields.iter().copied(), Framing::Bytes).ok()?;
            Some((layout, fields))
        },
    )
}

/// Heads and tails of 0..=8 bytes that overlap with themselves and each other.
fn any_recipe() -> impl Strategy<Value = Recipe> {
    recipe(many(prop_oneof![4 => Just(0xFF_u8), 2 => Just(0xFE), 1 => any::<u8>()], 0..=8).boxed())
}

/// Values that may be used, from any bytes.
fn values(fields: &[Field], bytes: &[u8]) -> Vec<Scalar> {
    let mut source = bytes.iter().copied().cycle();
    let value = |field: &Field| {
        let mut raw: Vec<u8> = source.by_ref().take(field.ty().size()).collect();
        match (field, field.ty()) {
            // An exponent that is not all ones.
            (_, ScalarType::Float) => raw[3] &= 0xBF,
            (_, ScalarType::Double) => raw[7] &= 0xBF,
            (Field::System(var), ScalarType::Byte) => raw[0] &= var.valid_bits(),
            _ => {}
        }
        Scalar::decode(field.ty(), &raw).unwrap()
    };
    fields.iter().map(value).collect()
}

fn encode((layout, fields): &Recipe, values: &[Scalar]) -> Vec<u8> {
    let mut out = vec![0xA5; layout.frame_len() + 1];
    assert_eq!(layout.encode_values(values, &mut out), Ok(layout.frame_len()));
    assert_eq!(out.pop(), Some(0xA5), "nothing past the frame is written");
    if layout.rules().mode == Mode::Realtime {
        // The same by the process image.
        let mut image = [0x5A; IMAGE_BYTES];
        for (field, value) in fields.iter().zip(values) {
            let Field::System(var) = field else { panic!("a realtime part") };
            value.encode(&mut image[var.image_offset()..]).unwrap();
        }
        let mut by_image = vec![0; out.len()];
        assert_eq!(layout.encode(&image, &mut by_image), Ok(out.len()));
        assert_eq!(by_image, out);
    }
    out
}

fn deliver(deframer: &mut Deframer, layout: &StreamLayout, mut chunk: &[u8]) -> Vec<Vec<u8>> {
    let mut payloads = Vec::new();
    while let Some(payload) = deframer.next_frame(layout, &mut chunk) {
        payloads.push(payload.to_vec());
    }
    assert!(chunk.is_empty());
    payloads
}

/// Pieces of these sizes, over and over.
fn cut<'l>(line: &'l [u8], sizes: &[usize]) -> Vec<&'l [u8]> {
    let (mut pieces, mut rest) = (Vec::new(), line);
    for &size in sizes.iter().cycle() {
        if rest.is_empty() {
            break;
        }
        let (piece, behind) = rest.split_at(size.min(rest.len()));
        pieces.push(piece);
        rest = behind;
    }
    pieces
}

fn sizes() -> impl Strategy<Value = Vec<usize>> {
    many(prop_oneof![Just(1_usize), 1..40_usize, 1..1500_usize], 1..20)
}

/// The payload's values are the ones that were sent, in the frame and in the image.
fn assert_carries((layout, fields): &Recipe, payload: &[u8], sent: &[Scalar]) -> Result<(), TestCaseError> {
    prop_assert!(layout.values(payload).eq(sent.iter().copied()));
    let mut image = [0x5A; IMAGE_BYTES];
    let expected = reference::apply(fields, payload, &image).map(|(after, _)| after);
    prop_assert!(layout.apply(payload, &mut image).is_ok());
    prop_assert_eq!(Ok(image.to_vec()), expected);
    Ok(())
}

proptest! {
    /// Without pollution every recipe is decoded exactly, also one without a head, and one whose
    /// payload is full of heads and tails: the decoder is never out of step.
    #[test]
    fn what_is_sent_is_received(
        recipe in any_recipe(),
        all in many(many(prop_oneof![Just(0xFF_u8), Just(0xFE), any::<u8>()], 1..40), 1..12),
        sizes in sizes(),
    ) {
        let sent: Vec<_> = all.iter().map(|bytes| values(&recipe.1, bytes)).collect();
        let frames: Vec<_> = sent.iter().map(|values| encode(&recipe, values)).collect();
        let mut deframer = Deframer::new();
        let line = frames.concat();
        let pieces = cut(&line, &sizes);
        let found: Vec<_> = pieces.iter().flat_map(|piece| deliver(&mut deframer, &recipe.0, piece)).collect();
        prop_assert_eq!(found.len(), sent.len());
        for ((payload, values), frame) in found.iter().zip(&sent).zip(&frames) {
            assert_carries(&recipe, payload, values)?;
            prop_assert_eq!(datagram(&recipe.0, frame), Ok(&payload[..]));
        }
        let stats = deframer.stats();
        prop_assert_eq!((stats.skipped_bytes, stats.tail_mismatches, deframer.pending()), (0, 0, 0));
    }

    /// Between the frames stands what cannot begin one: bytes without the head's first byte. Behind a
    /// cut frame the line is silent.
    #[test]
    fn pollution_between_frames_costs_no_frame(
        recipe in recipe(many(any::<u8>(), 0..=8).boxed()).prop_filter("a head to be found by", |(layout, _)| !layout.head().is_empty()),
        all in many((many(any::<u8>(), 1..40), many(any::<u8>(), 0..60), prop::option::of(any::<u8>())), 1..12),
        sizes in sizes(),
    ) {
        let mut deframer = Deframer::new();
        let first = recipe.0.head()[0];
        let mut polluted = 0;
        for (bytes, pollution, broken) in &all {
            let values = values(&recipe.1, bytes);
            let frame = encode(&recipe, &values);
            if let Some(part) = broken {
                let kept = &frame[..frame.len() * usize::from(*part) / 256];
                prop_assert!(cut(kept, &sizes).iter().all(|piece| deliver(&mut deframer, &recipe.0, piece).is_empty()));
                deframer.discard();
                polluted += kept.len();
            }
            let pollution: Vec<u8> = pollution.iter().copied().filter(|&byte| byte != first).collect();
            polluted += pollution.len();
            let line = [&pollution[..], &frame].concat();
            let found: Vec<_> = cut(&line, &sizes).iter().flat_map(|piece| deliver(&mut deframer, &recipe.0, piece)).collect();
            prop_assert_eq!(found.len(), 1);
            assert_carries(&recipe, &found[0], &values)?;
        }
        let stats = deframer.stats();
        prop_assert_eq!(stats.frames, all.len() as u64);
        prop_assert_eq!(stats.skipped_bytes + stats.discarded_bytes, polluted as u64);
    }

    /// Whatever stands on the line, D19 read literally says what is found.
    #[test]
    fn any_pollution_is_read_as_the_rules_say(
        recipe in any_recipe(),
        all in many((many(prop_oneof![Just(0xFF_u8), Just(0xFE), any::<u8>()], 1..60), 0..6_u8, any::<u16>()), 1..20),
        sizes in sizes(),
    ) {
        let (mut deframer, mut line) = (Deframer::new(), PlainDeframer::new(&recipe.0));
        for (bytes, kind, at) in &all {
            let mut piece = encode(&recipe, &values(&recipe.1, bytes));
            let at = usize::from(*at) % piece.len();
            match kind {
                0 => piece = bytes.clone(),
                1 => piece.truncate(at),
                2 => piece[at] ^= bytes[0],
                3 => drop(piece.remove(at)),
                _ => {}
            }
            for chunk in cut(&piece, &sizes) {
                let head = recipe.0.head().len();
                let expected = line.receive(chunk).into_iter().map(|frame| frame[head..head + recipe.0.payload_len()].to_vec());
                prop_assert_eq!(deliver(&mut deframer, &recipe.0, chunk), expected.collect::<Vec<_>>());
                let stats = deframer.stats();
                prop_assert_eq!((stats.frames, stats.skipped_bytes, stats.tail_mismatches), (line.frames, line.dropped, line.wrong_tails));
            }
        }
    }

    /// CAN: each declared frame carries its own values and nothing else.
    #[test]
    fn can_frames_carry_what_is_sent(
        rules in rules(),
        all in many((any::<u32>(), any::<bool>(), many(any::<usize>(), 1..10), many(any::<u8>(), 8..9)), 1..=32),
    ) {
        let mut picked: Vec<Field> = Vec::new();
        let mut part: Vec<(CanId, Vec<Field>)> = Vec::new();
        for (id, extended, picks, _) in &all {
            let id = if *extended { CanId::Extended(id & 0x1FFF_FFFF) } else { CanId::Standard(*id as u16 & 0x7FF) };
            let mut fields = fields(rules, picks, 128 - picked.len(), 8);
            fields.retain(|field| rules.mode == Mode::User || !picked.contains(field));
            if !fields.is_empty() && part.iter().all(|(other, _)| *other != id) {
                picked.extend(&fields);
                part.push((id, fields));
            }
        }
        prop_assume!(!part.is_empty());
        let layout = CanLayout::new(rules, part.iter().map(|(id, fields)| (*id, fields.iter().copied()))).unwrap();
        for (nth, (id, fields)) in part.iter().enumerate() {
            let sent = values(fields, &all[nth].3);
            let frame = layout.frame(nth).unwrap().encode_values(&sent).unwrap();
            prop_assert_eq!(frame.id(), *id);
            prop_assert_eq!(layout.accept(&frame), Ok(nth));
            prop_assert_eq!(layout.accept_frame(&frame), Ok(nth));
            let accepted = layout.frame(nth).unwrap();
            prop_assert!(accepted.values(frame.data()).eq(sent.iter().copied()));
            let mut image = [0x5A; IMAGE_BYTES];
            let expected = reference::apply(fields, frame.data(), &image).map(|(after, _)| after);
            prop_assert!(accepted.apply(frame.data(), &mut image).is_ok());
            prop_assert_eq!(Ok(image.to_vec()), expected);
        }
    }
}
