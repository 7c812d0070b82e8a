//! The order of a number's bytes on the wire.

/// The order of a number's bytes, named after those of a 32-bit number, A the highest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum ByteOrder {
    /// DCBA: lowest byte first.
    #[default]
    Little,
    /// ABCD: highest byte first.
    Big,
    /// CDAB: 16-bit words, lowest first; within a word the highest byte first. Common where Modbus registers hold 32
    /// bits.
    BigSwapped,
    /// BADC: 16-bit words, highest first; within a word the lowest byte first.
    LittleSwapped,
}

impl ByteOrder {
    /// Whether the order is neither little nor big.
    pub const fn swaps_words(self) -> bool {
        matches!(self, Self::BigSwapped | Self::LittleSwapped)
    }

    /// The significance of the byte at `at` in a number of `len` bytes, as a power of 256.
    const fn power(self, at: usize, len: usize) -> usize {
        let from_end = len.saturating_sub(1).saturating_sub(at);
        match self {
            Self::Little => at,
            Self::Big => from_end,
            // The other byte of the same word.
            Self::BigSwapped => at ^ 1,
            Self::LittleSwapped => from_end ^ 1,
        }
    }

    /// Reads a number of at most eight bytes. If the order swaps words, `bytes` must be whole words.
    pub fn read(self, bytes: &[u8]) -> u64 {
        (0..).zip(bytes).fold(0, |number, (at, &byte)| number | place(self.power(at, bytes.len()), byte))
    }

    /// Writes the lowest bytes of a number; the inverse of [`Self::read`].
    pub fn write(self, number: u64, bytes: &mut [u8]) {
        let len = bytes.len();
        for (at, byte) in (0..).zip(bytes) {
            *byte = number.unbounded_shr(bits(self.power(at, len))) as u8;
        }
    }
}

const fn place(power: usize, byte: u8) -> u64 {
    (byte as u64).unbounded_shl(bits(power))
}

const fn bits(bytes: usize) -> u32 {
    (bytes as u32).saturating_mul(8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_order_is_what_its_letters_say() {
        for (order, bytes) in [
            (ByteOrder::Little, *b"DCBA"),
            (ByteOrder::Big, *b"ABCD"),
            (ByteOrder::BigSwapped, *b"CDAB"),
            (ByteOrder::LittleSwapped, *b"BADC"),
        ] {
            assert_eq!(order.read(&bytes), u64::from(u32::from_be_bytes(*b"ABCD")), "{order:?}");
            let mut out = [0; 4];
            order.write(u64::from(u32::from_be_bytes(*b"ABCD")), &mut out);
            assert_eq!(out, bytes, "{order:?}");
        }
    }

    #[test]
    fn numbers_of_every_length_survive() {
        for order in [ByteOrder::Little, ByteOrder::Big, ByteOrder::BigSwapped, ByteOrder::LittleSwapped] {
            for len in (1..=8).filter(|len| !order.swaps_words() || len % 2 == 0) {
                let number = 0x1122_3344_5566_7788_u64 >> (64 - 8 * len);
                let mut bytes = [0; 8];
                order.write(number, &mut bytes[..len]);
                assert_eq!(order.read(&bytes[..len]), number, "{order:?} of {len} bytes");
            }
        }
        let mut bytes = [0; 8];
        ByteOrder::BigSwapped.write(0x1122_3344_5566_7788, &mut bytes);
        assert_eq!(bytes, [0x77, 0x88, 0x55, 0x66, 0x33, 0x44, 0x11, 0x22]);
    }
}
