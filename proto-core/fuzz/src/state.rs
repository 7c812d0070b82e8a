//! The 2001 stream: any bytes in any pieces, against the tables of docs/wire/state.md section 2 and
//! docs/wire/sysvars.md as they are printed there.

use proto_core::sysvar::{IMAGE_BYTES, SysVar, VarRange};
use proto_core::wire::scalar::Scalar;
use proto_core::wire::state::{LEN, Misaligned, StatePacket, StateStream, StateView};

use crate::source::{Source, cut};

/// Bytes of stream that one input may lead to.
const LONGEST: usize = 6 * LEN;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let how = input.u8();
    let (mut stream, mut bytes) = (StateStream::new(), Vec::new());
    let mut expected = Expected::default();
    while !input.is_empty() && bytes.len() < LONGEST {
        let op = input.u8();
        match op % 4 {
            // A moving robot's packet with bytes changed.
            0 | 1 => {
                let mut packet = vector();
                for _ in 0..op >> 4 {
                    let at = usize::from(input.u16()) % LEN;
                    packet[at] = input.u8();
                }
                bytes.extend(packet);
            }
            // Bytes that are lost or too many.
            2 => bytes.extend(input.run()),
            _ => {
                expected.receive(&mut stream, &bytes, how);
                bytes.clear();
                if op & 16 == 0 {
                    stream.reset();
                    (expected.held, expected.in_a_row) = (Vec::new(), 0);
                }
            }
        }
    }
    expected.receive(&mut stream, &bytes, how);
}

#[derive(Default)]
struct Expected {
    held: Vec<u8>,
    good: u32,
    bad: u32,
    in_a_row: u32,
}

impl Expected {
    fn receive(&mut self, stream: &mut StateStream, bytes: &[u8], how: u8) {
        for chunk in cut(bytes, how) {
            let mut rest = chunk;
            self.held.extend(chunk);
            let mut before = rest.len();
            while let Some(found) = stream.next_packet(&mut rest) {
                assert!(rest.len() < before, "a packet was found and nothing was taken");
                before = rest.len();
                let packet: Vec<u8> = self.held.drain(..LEN).collect();
                let right = is_aligned(&packet);
                match found {
                    Ok(view) => {
                        assert_eq!(view.as_bytes()[..], packet[..]);
                        self.good += 1;
                        self.in_a_row = 0;
                    }
                    Err(_) => {
                        self.bad += 1;
                        self.in_a_row += 1;
                    }
                }
                assert_eq!(found.is_ok(), right, "{found:?}");
                if self.good + self.bad <= 2 {
                    look_into(&packet);
                }
                assert_eq!(stream.is_lost(), self.in_a_row >= 3);
            }
            assert!(rest.is_empty(), "None means that all was taken");
            assert!(self.held.len() < LEN);
            assert_eq!(stream.pending(), self.held.len());
            assert_eq!((stream.packets(), stream.misaligned()), (self.good, self.bad));
            assert_eq!(stream.misaligned_in_a_row(), self.in_a_row);
        }
    }
}

/// D8, section 3.
fn is_aligned(packet: &[u8]) -> bool {
    let position = |joint: usize| f32::from_le_bytes(packet[4 * joint..][..4].try_into().unwrap());
    let still = (0..6).all(|joint| position(joint).is_finite() && position(joint).abs() <= 1000.0);
    // First offset and number of the bool bytes that are not reserved.
    let bools = [(720, 16), (736, 32), (1088, 32), (1120, 128), (1408, 2), (1416, 2), (1440, 2)];
    let all: Vec<u8> = bools.iter().flat_map(|&(from, len)| packet[from..from + len].to_vec()).collect();
    assert_eq!(all.len(), 214);
    still && all.iter().filter(|&&byte| byte > 1).count() <= 8
}

fn look_into(packet: &[u8]) {
    let view = StateView::new(packet).expect("it has the length of a packet");
    assert!(StateView::new(&packet[1..]).is_err());
    match view.check_alignment() {
        Err(Misaligned::JointPosition { joint, .. }) => assert!((1..=6).contains(&joint)),
        Err(Misaligned::Bools { wrong, .. }) => assert!(wrong > 8),
        _ => {}
    }
    // Reserved items included, every packet survives decoding and encoding.
    let value = StatePacket::parse(packet).expect("it has the length of a packet");
    assert_eq!(value.to_bytes()[..], *packet);
    let mut image = [0x5A; IMAGE_BYTES];
    view.copy_to_image(&mut image);
    let mut expected = [0x5A; IMAGE_BYTES];
    for &(names, output, offset, mask) in PLACES {
        let range = VarRange::parse(names).expect("a row of the table");
        for (nth, var) in range.iter().enumerate() {
            let got = expected_value(var, packet, offset, nth, mask);
            assert_eq!(
                format!("{:?}", view.read_var(var)),
                format!("{:?}", Scalar::decode(var.ty(), &got)),
                "{var}"
            );
            if output {
                expected[var.image_offset()..][..got.len()].copy_from_slice(&got);
            }
        }
    }
    assert_eq!(image, expected);
    assert_eq!(
        SysVar::all().filter(|&var| view.read_var(var).is_none()).count(),
        12 + 7,
        "forces and RobotState[26..32]"
    );
}

/// Section 5.
fn expected_value(var: SysVar, packet: &[u8], offset: usize, nth: usize, mask: u8) -> Vec<u8> {
    if var.size() > 1 {
        return packet[offset + nth * var.size()..][..var.size()].to_vec();
    }
    let bools = &packet[offset + 8 * nth..][..8];
    let mut byte = 0;
    for (bit, &bool) in bools.iter().enumerate() {
        if bool != 0 && mask >> bit & 1 == 1 {
            byte |= 1 << bit;
        }
    }
    vec![byte]
}

/// docs/wire/sysvars.md sections 1 and 2: variables, whether they are outputs, where the first stands
/// in the packet, and a byte's bits that mean something.
const PLACES: &[(&str, bool, usize, u8)] = &[
    ("DigitalOutputCommand[1..2]", false, 752, 0xFF),
    ("DigitalOutputCommand[3]", false, 1416, 0x03),
    ("BitInputReg[1..2]", false, 1088, 0xFF),
    ("BitInputReg[3..10]", false, 1120, 0xFF),
    ("WordInputReg[1..32]", false, 1248, 0xFF),
    ("FloatInputReg[1..32]", false, 832, 0xFF),
    ("DigitalSignalStatus[1..2]", true, 736, 0xFF),
    ("DigitalSignalStatus[3]", true, 1408, 0x03),
    ("DigitalSignalStatus[4..5]", true, 752, 0xFF),
    ("DigitalSignalStatus[6]", true, 1416, 0x03),
    ("DigitalSignalStatus[7]", true, 720, 0xFF),
    ("DigitalSignalStatus[8]", true, 728, 0xFF),
    ("RobotState[1..7]", true, 0, 0xFF),
    ("RobotState[8..13]", true, 368, 0xFF),
    ("RobotState[14..19]", true, 440, 0xFF),
    ("RobotState[20..25]", true, 608, 0xFF),
    ("BitOutputReg[1..2]", true, 1104, 0xFF),
    ("BitOutputReg[3..10]", true, 1184, 0xFF),
    ("WordOutputReg[1..32]", true, 1312, 0xFF),
    ("FloatOutputReg[1..32]", true, 960, 0xFF),
];

/// The frozen packet of `tests/wire_v1_state.rs`; its joint positions are small.
fn vector() -> Vec<u8> {
    let text = include_str!("../../tests/vectors/state_v1.hex");
    let digits: Vec<u8> =
        text.bytes().filter_map(|digit| char::from(digit).to_digit(16)).map(|digit| digit as u8).collect();
    digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect()
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let nan = [3_u16, 0x7F, 2, 0xC0].map(|word| word as u8);
    let change = |at: u16, to: u8| [at as u8, (at >> 8) as u8, to];
    let bools: Vec<u8> = (720..729).flat_map(|at| change(at, 7)).collect();
    // ±1000 rad, and the next floats beyond.
    let far = |last: u8, sign: u8| {
        [&[0, 0x40][..], &change(20, last), &change(21, 0), &change(22, 0x7A), &change(23, 0x44 | sign)]
            .concat()
    };
    vec![
        far(0, 0),
        far(1, 0),
        far(0, 0x80),
        far(1, 0x80),
        vec![0, 0],
        vec![200, 0, 0, 0],
        [&[130, 0x20], &change(3, nan[1])[..], &change(2, 0xC0), &[0, 0]].concat(),
        [&[0, 0x90][..], &bools, &[0x90], &bools, &[0x90], &bools, &[0]].concat(),
        [&[0, 0x80][..], &bools[..24]].concat(),
        vec![70, 0, 2, 3, 1, 2, 3, 0, 0, 3, 0],
        [&[255, 0x30][..], &change(1408, 1), &change(1409, 200), &change(1410, 1), &[0x13, 0, 3, 0]].concat(),
    ]
}
