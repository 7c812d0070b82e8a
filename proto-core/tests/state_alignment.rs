//! No packet that a controller can send is called misaligned (docs/wire/state.md section 3):
//! packets and whole streams by chance, from fixed seeds.

use proto_core::wire::scalar::ScalarType;
use proto_core::wire::state::{Content, FIELDS, FieldPlace, LEN, MAX_MISALIGNED, StateStream, StateView};

/// Xorshift.
struct Chance(u64);

impl Chance {
    fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    fn bits(&mut self) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 32) as u32
    }

    fn below(&mut self, end: u32) -> u32 {
        self.bits() % end
    }

    /// -1..=1.
    fn part(&mut self) -> f32 {
        self.bits() as f32 / u32::MAX as f32 * 2.0 - 1.0
    }

    /// A quantity: nothing, one of the ends, noise of any size, or anything between.
    fn quantity(&mut self, most: f32) -> f32 {
        match self.below(6) {
            0 => 0.0,
            1 => -0.0,
            2 => most,
            3 => -most,
            4 => self.part().signum() * (1.0 + self.part().abs()) * 10_f32.powi(-(self.below(31) as i32)),
            _ => self.part() * most,
        }
    }

    /// A float that a user wrote.
    fn finite(&mut self) -> f32 {
        loop {
            let float = f32::from_bits(self.bits());
            if float.is_finite() {
                return float;
            }
        }
    }

    fn unreadable(&mut self) -> f32 {
        [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY][self.below(4) as usize]
    }

    fn strange(&mut self) -> f32 {
        [self.unreadable(), f32::from_bits(1), 1e30][self.below(3) as usize]
    }
}

/// The largest that a robot shows, for the quantities that have a unit.
fn most(field: &FieldPlace) -> Option<f32> {
    Some(match field.name {
        "joint_position" | "target_joint_position" => 40.0,
        "joint_velocity" | "target_joint_velocity" | "tcp_velocity" | "target_tcp_velocity" => 10.0,
        "joint_acceleration" | "target_joint_acceleration" | "tcp_acceleration" => 1_000.0,
        "target_tcp_acceleration" | "joint_torque" | "target_joint_torque" => 1_000.0,
        "joint_current" => 5_000.0,
        "tcp_pose" | "target_tcp_pose" | "tool_frame" | "work_object_frame" => 10.0,
        "analog_inputs" => 24.0,
        _ => return None,
    })
}

fn put(packet: &mut [u8; LEN], at: usize, value: f32) {
    packet[at..at + 4].copy_from_slice(&value.to_le_bytes());
}

/// Anything that a controller can send: registers, reserved items, dwords and codes of any kind, a
/// few bools that are something else, and so many quantities that are.
fn any_packet(chance: &mut Chance, strange: u32) -> [u8; LEN] {
    let mut packet = std::array::from_fn(|_| chance.bits() as u8);
    let (mut quantities, mut bools) = (vec![], vec![]);
    for field in FIELDS {
        let first = usize::from(field.offset);
        let places = (0..usize::from(field.count)).map(|nth| first + nth * field.ty.size());
        match (field.content, field.ty) {
            (Content::Bools { real }, _) => {
                for place in places.take(usize::from(real)) {
                    packet[place] = chance.bits() as u8 & 1;
                    bools.push(place);
                }
            }
            (Content::Values, ScalarType::Float) => {
                let items = if field.count == 7 { 6 } else { usize::from(field.count) };
                for place in places.take(items) {
                    let value = match most(field) {
                        Some(most) => chance.quantity(most),
                        None => chance.finite(),
                    };
                    put(&mut packet, place, value);
                    quantities.push(place);
                }
            }
            _ => {}
        }
    }
    if chance.below(2) == 0 {
        packet[1448..1452].copy_from_slice(&[2, 6, 0, 5]);
    }
    for _ in 0..strange {
        let place = quantities[chance.below(quantities.len() as u32) as usize];
        put(&mut packet, place, chance.strange());
    }
    for _ in 0..chance.below(9) {
        packet[bools[chance.below(bools.len() as u32) as usize]] = chance.bits() as u8;
    }
    packet
}

#[test]
fn whatever_a_controller_can_show_is_a_packet() {
    let mut chance = Chance::new(1);
    for nth in 0..10_000 {
        let strange = chance.below(3);
        let packet = any_packet(&mut chance, strange);
        assert_eq!(StateView::from_array(&packet).check_alignment(), Ok(()), "packet {nth}");
    }
}

/// A robot that moves while its controller's states change as they like, and whose filters run out
/// when it rests.
#[test]
fn a_moving_robots_stream_is_never_lost() {
    for seed in 0..25 {
        let mut chance = Chance::new(seed);
        let mut stream = StateStream::new();
        let mut joints = [0.0_f32; 6];
        let mut tcp = [0.5_f32, 0.2, 0.4];
        for nth in 0..400 {
            let mut packet = any_packet(&mut chance, 0);
            let (codes, is_started) = match chance.below(4) {
                0 => ([0; 4], false),
                1 => (chance.bits().to_le_bytes(), false),
                _ => ([chance.below(3) as u8, 1 + chance.below(7) as u8, chance.below(6) as u8, 5], true),
            };
            packet[1448..1452].copy_from_slice(&codes);
            for (nth, joint) in joints.iter_mut().enumerate() {
                *joint = (*joint + 0.4 * chance.part()).clamp(-6.0, 6.0);
                put(&mut packet, 4 * nth, *joint);
            }
            for (nth, item) in tcp.iter_mut().enumerate() {
                *item = (*item + 0.3 * chance.part()).clamp(-1.3, 1.3);
                put(&mut packet, 368 + 4 * nth, *item);
            }
            if chance.below(4) == 0 {
                put(&mut packet, 4 * chance.below(6) as usize, chance.unreadable());
                put(&mut packet, 368 + 4 * chance.below(3) as usize, chance.unreadable());
            }
            if is_started && chance.below(4) == 0 {
                // It has just come to rest.
                for place in (28..84).chain(392..440).filter(|place| place % 4 == 0) {
                    put(&mut packet, place, f32::from_bits(1 + chance.below(1 << 20)));
                }
            }
            let mut rest = &packet[..];
            let result = stream.next_packet(&mut rest).expect("a whole packet");
            assert!(result.is_ok(), "seed {seed}, packet {nth}: {result:?}");
        }
        assert_eq!((stream.packets(), stream.misaligned()), (400, 0));
    }
}

#[test]
fn bytes_by_chance_are_no_packet() {
    let mut chance = Chance::new(7);
    let mut stream = StateStream::new();
    for _ in 0..2_000 {
        let garbage: [u8; LEN] = std::array::from_fn(|_| chance.bits() as u8);
        assert!(stream.next_packet(&mut &garbage[..]).expect("a whole packet").is_err());
    }
    assert!(stream.is_lost());
    assert!(stream.misaligned_in_a_row() > MAX_MISALIGNED);
}
