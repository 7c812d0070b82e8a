//! Addresses and seeds derived from a chip's unique number.

use core::fmt::Write;

use heapless::String;

/// A locally administered unicast Ethernet address.
pub fn ethernet_address(unique: &[u8]) -> [u8; 6] {
    let [_, _, first, rest @ ..] = hash(unique).to_be_bytes();
    let [b, c, d, e, f] = rest;
    // Bit 1: locally administered. Bit 0: multicast.
    [first & !0b11 | 0b10, b, c, d, e, f]
}

/// Host name of a board: `rgw-` and the last three bytes of its Ethernet address.
pub fn host_name(address: [u8; 6]) -> String<NAME> {
    let [.., a, b, c] = address;
    let mut name = String::new();
    // The capacity suffices.
    let _ = write!(name, "rgw-{a:02x}{b:02x}{c:02x}");
    name
}

/// Length of a host name.
pub const NAME: usize = 10;

/// FNV-1a.
pub fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xCBF2_9CE4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01B3)
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn hash_is_the_published_one() {
        assert_eq!(hash(b""), 0xCBF2_9CE4_8422_2325);
        assert_eq!(hash(b"foobar"), 0x8594_4171_F739_67E8);
    }

    #[test]
    fn the_name_is_that_of_the_address() {
        assert_eq!(host_name([2, 0x11, 0x22, 0x03, 0xAB, 0xFF]), "rgw-03abff");
    }

    #[test]
    fn chips_of_one_wafer_have_different_addresses_of_one_station_each() {
        let mut seen = BTreeSet::new();
        for x in 0..100 {
            for y in 0..100 {
                let address = ethernet_address(&[x, 0, y, 0, 5, 0x51, 0x33, 0x31, 0x38, 0x39, 0x33, 0x37]);
                assert_eq!(address[0] & 0b11, 0b10);
                assert!(seen.insert(address), "{address:02X?} twice");
            }
        }
    }
}
