//! Checksums of field devices' frames: CRCs with any parameters, sums, and exclusive or.
//!
//! In: an algorithm, and the bytes to check, in pieces. Out: the checksum as a number, or as the bytes of a frame. Does
//! not know which bytes of a frame are covered.
//!
//! CRC tables are not kept in memory: for long runs, 16 values for half bytes are computed each time; short runs are
//! computed bit by bit.

use super::order::ByteOrder;

/// The parameters of a CRC, as in catalogues of CRCs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Crc {
    /// Number of bits, 1..=32.
    pub width: u8,
    /// The polynomial without its highest term, highest power first.
    pub poly: u32,
    /// The register before the first byte, not reflected.
    pub init: u32,
    /// Combined with the result by exclusive or.
    pub xorout: u32,
    /// Bytes are taken lowest bit first.
    pub refin: bool,
    /// The result is reflected.
    pub refout: bool,
}

/// How a checksum is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub enum Algorithm {
    /// A cyclic redundancy check.
    Crc(Crc),
    /// The sum of all bytes modulo 256.
    Sum8,
    /// The sum of all bytes modulo 65536.
    Sum16,
    /// Exclusive or of all bytes.
    Xor8,
    /// The value that makes the sum of all bytes zero: the two's complement of [`Algorithm::Sum8`], as in Modbus ASCII.
    Lrc,
}

const fn crc(width: u8, poly: u32, init: u32, reflected: bool, xorout: u32) -> Algorithm {
    Algorithm::Crc(Crc { width, poly, init, xorout, refin: reflected, refout: reflected })
}

/// The named algorithms, with their names in configuration files.
const NAMED: [(&str, Algorithm); 24] = [
    ("crc8", crc(8, 0x07, 0, false, 0)),
    ("crc8-autosar", crc(8, 0x2F, 0xFF, false, 0xFF)),
    ("crc8-gsm-a", crc(8, 0x1D, 0, false, 0)),
    ("crc8-maxim", crc(8, 0x31, 0, true, 0)),
    ("crc8-nrsc-5", crc(8, 0x31, 0xFF, false, 0)),
    ("crc8-sae-j1850", crc(8, 0x1D, 0xFF, false, 0xFF)),
    ("crc16-arc", crc(16, 0x8005, 0, true, 0)),
    ("crc16-ccitt-false", crc(16, 0x1021, 0xFFFF, false, 0)),
    ("crc16-ccitt-aug", crc(16, 0x1021, 0x1D0F, false, 0)),
    ("crc16-dnp", crc(16, 0x3D65, 0, true, 0xFFFF)),
    ("crc16-kermit", crc(16, 0x1021, 0, true, 0)),
    ("crc16-mcrf4xx", crc(16, 0x1021, 0xFFFF, true, 0)),
    ("crc16-modbus", Algorithm::CRC16_MODBUS),
    ("crc16-umts", crc(16, 0x8005, 0, false, 0)),
    ("crc16-usb", crc(16, 0x8005, 0xFFFF, true, 0xFFFF)),
    ("crc16-x25", crc(16, 0x1021, 0xFFFF, true, 0xFFFF)),
    ("crc16-xmodem", crc(16, 0x1021, 0, false, 0)),
    ("crc32", crc(32, 0x04C1_1DB7, 0xFFFF_FFFF, true, 0xFFFF_FFFF)),
    ("crc32-mpeg-2", crc(32, 0x04C1_1DB7, 0xFFFF_FFFF, false, 0)),
    ("crc32c", crc(32, 0x1EDC_6F41, 0xFFFF_FFFF, true, 0xFFFF_FFFF)),
    ("sum8", Algorithm::Sum8),
    ("sum16", Algorithm::Sum16),
    ("xor8", Algorithm::Xor8),
    ("lrc", Algorithm::Lrc),
];

/// From this many bytes on, building the table of half bytes pays off.
const LONG_RUN: usize = 16;

impl Crc {
    /// Whether the parameters describe a CRC: a width of 1 to 32 bits, and no parameter exceeds it.
    pub const fn is_valid(&self) -> bool {
        let numbers = self.poly | self.init | self.xorout;
        matches!(self.width, 1..=32) && numbers.unbounded_shr(self.width as u32) == 0
    }

    /// Unused bits at one end of the register.
    const fn unused(&self) -> u32 {
        32_u32.saturating_sub(self.width as u32)
    }

    /// Aligns `number` with the front of the register: the top, or the bottom with its bits reflected.
    const fn at_front(&self, number: u32) -> u32 {
        let on_top = number.unbounded_shl(self.unused());
        if self.refin { on_top.reverse_bits() } else { on_top }
    }

    /// The register after `steps` zero bits.
    fn shifted(&self, register: u32, steps: u32) -> u32 {
        let poly = self.at_front(self.poly);
        (0..steps).fold(register, |register, _| {
            let (front, shifted) =
                if self.refin { (register & 1, register >> 1) } else { (register >> 31, register << 1) };
            if front == 1 { shifted ^ poly } else { shifted }
        })
    }

    fn update(&self, register: u32, bytes: &[u8]) -> u32 {
        if bytes.len() < LONG_RUN {
            return bytes.iter().fold(register, |register, &byte| {
                let byte = if self.refin { u32::from(byte) } else { u32::from(byte) << 24 };
                self.shifted(register ^ byte, 8)
            });
        }
        let mut table = [0_u32; 16];
        for (half, entry) in (0_u32..).zip(&mut table) {
            *entry = self.shifted(if self.refin { half } else { half << 28 }, 4);
        }
        let entry = |half: u32| table.get((half & 0xF) as usize).copied().unwrap_or(0);
        bytes.iter().fold(register, |register, &byte| {
            if self.refin {
                let register = register ^ u32::from(byte);
                let register = (register >> 4) ^ entry(register);
                (register >> 4) ^ entry(register)
            } else {
                let register = register ^ u32::from(byte) << 24;
                let register = (register << 4) ^ entry(register >> 28);
                (register << 4) ^ entry(register >> 28)
            }
        })
    }

    fn finish(&self, register: u32) -> u32 {
        // In a reflected register the result is already reflected.
        let result = if self.refin { register } else { register.unbounded_shr(self.unused()) };
        let result = if self.refin == self.refout {
            result
        } else {
            result.reverse_bits().unbounded_shr(self.unused())
        };
        result ^ self.xorout
    }
}

impl Algorithm {
    /// The checksum of Modbus RTU.
    pub const CRC16_MODBUS: Self = crc(16, 0x8005, 0xFFFF, true, 0);

    /// The algorithm with this name in configuration files, such as `crc16-modbus`.
    pub fn named(name: &str) -> Option<Self> {
        NAMED.iter().find(|(known, _)| *known == name).map(|&(_, algorithm)| algorithm)
    }

    /// The names of all named algorithms, for messages.
    pub fn names() -> impl ExactSizeIterator<Item = &'static str> {
        NAMED.iter().map(|&(name, _)| name)
    }

    /// The algorithm's name; `None` for a CRC with other parameters than the named ones.
    pub fn name(&self) -> Option<&'static str> {
        NAMED.iter().find(|(_, known)| known == self).map(|&(name, _)| name)
    }

    /// Length of the checksum in a frame, 1..=4 bytes.
    pub const fn len(&self) -> usize {
        match self {
            Self::Crc(crc) => (crc.width as usize).div_ceil(8),
            Self::Sum8 | Self::Xor8 | Self::Lrc => 1,
            Self::Sum16 => 2,
        }
    }

    /// Whether the length is 0: never, if the parameters are valid.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The usual byte order: low byte first for a reflected CRC, otherwise high byte first.
    pub const fn order(&self) -> ByteOrder {
        match self {
            Self::Crc(Crc { refout: true, .. }) => ByteOrder::Little,
            _ => ByteOrder::Big,
        }
    }

    /// The checksum of these consecutive pieces.
    pub fn of<'a>(&self, pieces: impl IntoIterator<Item = &'a [u8]>) -> u32 {
        let pieces = pieces.into_iter();
        let sum =
            |sum: u32, bytes: &[u8]| bytes.iter().fold(sum, |sum, &byte| sum.wrapping_add(u32::from(byte)));
        match self {
            Self::Crc(crc) => {
                let start = crc.at_front(crc.init);
                crc.finish(pieces.fold(start, |register, bytes| crc.update(register, bytes)))
            }
            Self::Sum8 => pieces.fold(0, sum) & 0xFF,
            Self::Sum16 => pieces.fold(0, sum) & 0xFFFF,
            Self::Lrc => pieces.fold(0, sum).wrapping_neg() & 0xFF,
            Self::Xor8 => pieces.flatten().fold(0, |xor, &byte| xor ^ u32::from(byte)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use ::crc::{self as oracle, Crc as Oracle};
    use proptest::prelude::*;

    use super::*;

    /// The checksums of "123456789", from the catalogue of CRCs.
    #[test]
    fn named_algorithms_give_the_catalogues_check_values() {
        let checks = [
            ("crc8", u32::from(oracle::CRC_8_SMBUS.check)),
            ("crc8-autosar", u32::from(oracle::CRC_8_AUTOSAR.check)),
            ("crc8-gsm-a", u32::from(oracle::CRC_8_GSM_A.check)),
            ("crc8-maxim", u32::from(oracle::CRC_8_MAXIM_DOW.check)),
            ("crc8-nrsc-5", u32::from(oracle::CRC_8_NRSC_5.check)),
            ("crc8-sae-j1850", 0x4B),
            ("crc16-arc", u32::from(oracle::CRC_16_ARC.check)),
            ("crc16-ccitt-false", u32::from(oracle::CRC_16_IBM_3740.check)),
            ("crc16-ccitt-aug", u32::from(oracle::CRC_16_SPI_FUJITSU.check)),
            ("crc16-dnp", u32::from(oracle::CRC_16_DNP.check)),
            ("crc16-kermit", u32::from(oracle::CRC_16_KERMIT.check)),
            ("crc16-mcrf4xx", u32::from(oracle::CRC_16_MCRF4XX.check)),
            ("crc16-modbus", u32::from(oracle::CRC_16_MODBUS.check)),
            ("crc16-umts", u32::from(oracle::CRC_16_UMTS.check)),
            ("crc16-usb", u32::from(oracle::CRC_16_USB.check)),
            ("crc16-x25", u32::from(oracle::CRC_16_IBM_SDLC.check)),
            ("crc16-xmodem", u32::from(oracle::CRC_16_XMODEM.check)),
            ("crc32", oracle::CRC_32_ISO_HDLC.check),
            ("crc32-mpeg-2", oracle::CRC_32_MPEG_2.check),
            ("crc32c", oracle::CRC_32_ISCSI.check),
            // By hand: 0x31 + 0x32 + ... + 0x39 is 0x1DD; the exclusive or of all nine is 0x31.
            ("sum8", 0xDD),
            ("sum16", 0x01DD),
            ("xor8", 0x31),
            ("lrc", 0x23),
        ];
        let names: Vec<&str> = Algorithm::names().collect();
        assert_eq!(names, checks.map(|(name, _)| name));
        for (name, check) in checks {
            let algorithm = Algorithm::named(name).unwrap();
            assert_eq!(algorithm.name(), Some(name));
            assert_eq!(algorithm.of([b"123456789".as_slice()]), check, "{name}");
        }
        assert_eq!(Algorithm::named("crc16"), None);
    }

    #[test]
    fn a_checksum_is_as_long_and_ordered_as_its_standard_says() {
        let of = |name| Algorithm::named(name).map(|known| (known.len(), known.order())).unwrap();
        assert_eq!(of("crc16-modbus"), (2, ByteOrder::Little));
        assert_eq!(of("crc16-ccitt-false"), (2, ByteOrder::Big));
        assert_eq!(of("crc32"), (4, ByteOrder::Little));
        assert_eq!(of("crc8-sae-j1850").0, 1);
        assert_eq!(of("sum16"), (2, ByteOrder::Big));
    }

    #[test]
    fn parameters_with_more_bits_than_the_width_are_not_a_crc() {
        let valid = Crc { width: 5, poly: 0x15, init: 0x1F, xorout: 0, refin: false, refout: false };
        assert!(valid.is_valid());
        assert!(!Crc { poly: 0x20, ..valid }.is_valid());
        assert!(!Crc { init: 0x20, ..valid }.is_valid());
        assert!(!Crc { xorout: 0x20, ..valid }.is_valid());
        assert!(!Crc { width: 0, poly: 0, init: 0, xorout: 0, ..valid }.is_valid());
        assert!(!Crc { width: 33, ..valid }.is_valid());
    }

    /// A CRC by its definition, one bit at a time in a wide register.
    fn slow(crc: &Crc, bytes: &[u8]) -> u32 {
        let (width, top) = (u32::from(crc.width), 1_u64 << crc.width);
        let mut register = u64::from(crc.init);
        for &byte in bytes {
            let byte = if crc.refin { byte.reverse_bits() } else { byte };
            for bit in (0..8).rev() {
                register ^= u64::from(byte >> bit & 1) << (width - 1);
                register <<= 1;
                if register & top != 0 {
                    register ^= top | u64::from(crc.poly);
                }
            }
        }
        let register = register as u32;
        let result = if crc.refout { register.reverse_bits() >> (32 - width) } else { register };
        result ^ crc.xorout
    }

    fn any_crc() -> impl Strategy<Value = Crc> {
        (1_u8..=32, any::<[u32; 3]>(), any::<bool>(), any::<bool>()).prop_map(
            |(width, numbers, refin, refout)| {
                let [poly, init, xorout] = numbers.map(|number| number >> (32 - width));
                Crc { width, poly, init, xorout, refin, refout }
            },
        )
    }

    proptest! {
        #[test]
        fn any_crc_is_what_its_definition_says_however_it_is_cut(
            crc in any_crc(),
            bytes in prop::collection::vec(any::<u8>(), 0..80),
            cut in 0_usize..80,
        ) {
            prop_assert!(crc.is_valid());
            let (first, second) = bytes.split_at(cut.min(bytes.len()));
            prop_assert_eq!(Algorithm::Crc(crc).of([first, second]), slow(&crc, &bytes));
        }

        #[test]
        fn a_long_run_agrees_with_the_crate_crc(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
            let modbus = Algorithm::named("crc16-modbus").unwrap();
            let expected = Oracle::<u16>::new(&oracle::CRC_16_MODBUS).checksum(&bytes);
            prop_assert_eq!(modbus.of([bytes.as_slice()]), u32::from(expected));
            let mpeg = Algorithm::named("crc32-mpeg-2").unwrap();
            let expected = Oracle::<u32>::new(&oracle::CRC_32_MPEG_2).checksum(&bytes);
            prop_assert_eq!(mpeg.of([bytes.as_slice()]), expected);
        }
    }
}
