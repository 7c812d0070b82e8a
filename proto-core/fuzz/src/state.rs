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
            // A moving robot's packet, or one of zeros, with bytes changed.
            0 | 1 => {
                let mut packet = if op.is_multiple_of(4) { vector() } else { vec![0; LEN] };
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
                    (expected.held, expected.in_a_row, expected.before) = (Vec::new(), 0, None);
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
    /// Codes of the newest packet of a started controller, and the newest packet.
    before: Option<([u8; 4], Vec<u8>)>,
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
                let right = is_aligned(&packet) && self.fits(&packet);
                match found {
                    Ok(view) => {
                        assert_eq!(view.as_bytes()[..], packet[..]);
                        self.good += 1;
                        self.in_a_row = 0;
                        let codes = self.before.take().map(|before| before.0);
                        let codes = if has_started(&packet) { Some(codes_of(&packet)) } else { codes };
                        self.before = codes.map(|codes| (codes, packet.clone()));
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

impl Expected {
    /// D8, section 3, beside the packets before.
    fn fits(&self, packet: &[u8]) -> bool {
        let Some((codes, before)) = &self.before else { return true };
        let near = |at: usize| {
            let way = f64::from(float(packet, at)) - f64::from(float(before, at));
            !way.is_finite() || way.abs() <= 0.5
        };
        *codes == codes_of(packet)
            || (0..6).all(|joint| near(4 * joint))
                && (has_started(packet) || [368, 372, 376].into_iter().all(near))
    }
}

fn float(packet: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(packet[at..at + 4].try_into().unwrap())
}

fn codes_of(packet: &[u8]) -> [u8; 4] {
    packet[1448..1452].try_into().unwrap()
}

/// Section 3: not starting, and one code at most that section 4 does not have.
fn has_started(packet: &[u8]) -> bool {
    let [mode, robot, program, safety] = codes_of(packet);
    let known = [
        (0..=2).contains(&mode),
        (0..=7).contains(&robot),
        (0..=5).contains(&program),
        (0..=15).contains(&safety) || safety == 99,
    ];
    known.iter().filter(|known| **known).count() >= 3 && robot != 0 && !matches!(safety, 0 | 1)
}

/// D8, section 3, for a packet alone.
fn is_aligned(packet: &[u8]) -> bool {
    let at_most = |at: usize, most: f32| float(packet, at).abs() <= most;
    let joints = (0..6).filter(|joint| at_most(4 * joint, 1000.0)).count();
    // First offset and number of the bool bytes that are not reserved.
    let bools = [(720, 16), (736, 32), (1088, 32), (1120, 128), (1408, 2), (1416, 2), (1440, 2)];
    let all: Vec<u8> = bools.iter().flat_map(|&(from, len)| packet[from..from + len].to_vec()).collect();
    assert_eq!(all.len(), 214);
    // First offset, number and largest of the quantities.
    let quantities = [
        (0, 6, 1000.0),
        (28, 6, 20.0),
        (56, 6, 2000.0),
        (84, 6, 2000.0),
        (112, 6, 1000.0),
        (140, 6, 20.0),
        (168, 6, 2000.0),
        (196, 6, 2000.0),
        (252, 6, 20_000.0),
        (368, 12, 20.0),
        (416, 6, 2000.0),
        (464, 12, 20.0),
        (512, 6, 2000.0),
        (608, 12, 20.0),
        (768, 8, 100.0),
    ];
    let strange = quantities.iter().flat_map(|&(from, count, most)| {
        (0..count).filter(move |nth| {
            let (at, least) = (from + 4 * nth, 2_f32.powi(-119));
            !(at_most(at, most) && (float(packet, at) == 0.0 || !at_most(at, least.next_down())))
        })
    });
    joints >= 4
        && all.iter().filter(|&&byte| byte > 1).count() <= 8
        && (has_started(packet) || strange.count() <= 2)
}

fn look_into(packet: &[u8]) {
    let view = StateView::new(packet).expect("it has the length of a packet");
    assert!(StateView::new(&packet[1..]).is_err());
    match view.check_alignment() {
        Err(Misaligned::JointPosition { wrong, joint, .. }) => {
            assert!(wrong > 2 && (1..=6).contains(&joint));
        }
        Err(Misaligned::Bools { wrong, .. }) => assert!(wrong > 8),
        Err(Misaligned::Quantities { wrong, .. }) => assert!(wrong > 2 && !has_started(packet)),
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
    // ±1000 rad, and the next floats beyond, three times.
    let far = |last: u8, sign: u8| {
        let joint = |at: u16| {
            [change(at, last), change(at + 1, 0), change(at + 2, 0x7A), change(at + 3, 0x44 | sign)].concat()
        };
        [&[0, 0xC0][..], &joint(4), &joint(12), &joint(20)].concat()
    };
    let started = [change(1449, 6), change(1451, 5)].concat();
    let at_one_rad = [change(2, 0x80), change(3, 0x3F)].concat();
    let subnormal = [change(28, 1), change(432, 1), change(796, 1)].concat();
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
        [&[0, 0x21][..], &started, &[0x21], &at_one_rad, &[0x21], &at_one_rad, &[0x21], &at_one_rad].concat(),
        [&[0, 0x21][..], &started, &[0x41], &started, &at_one_rad, &[0x01]].concat(),
        [&[0, 0x31][..], &subnormal, &[0x21], &subnormal[3..], &[0x51], &subnormal, &started].concat(),
        vec![70, 0, 2, 3, 1, 2, 3, 0, 0, 3, 0],
        [&[255, 0x30][..], &change(1408, 1), &change(1409, 200), &change(1410, 1), &[0x13, 0, 3, 0]].concat(),
    ]
}
