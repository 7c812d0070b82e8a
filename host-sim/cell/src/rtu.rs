//! The CRC of Modbus RTU, from proto-core/docs/wire/modbus-rtu.md: for the model and the simulated devices of a soak
//! run, independent of the engine's implementation.

/// A frame with its CRC, the low byte first.
pub(crate) fn sealed(bytes: &[u8]) -> Vec<u8> {
    [bytes, &crc(bytes)].concat()
}

/// The CRC, the low byte first.
fn crc(bytes: &[u8]) -> [u8; 2] {
    let crc = bytes.iter().fold(0xFFFF_u16, |crc, &byte| {
        (0..8).fold(crc ^ u16::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    });
    crc.to_le_bytes()
}

/// Whether the last two bytes are the CRC of the others.
pub(crate) fn is_right(frame: &[u8]) -> bool {
    let (bytes, own) = frame.split_at(frame.len() - 2);
    crc(bytes) == own
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_specifications_example_has_its_crc() {
        assert_eq!(sealed(&[2, 7]), [2, 7, 0x41, 0x12]);
        assert!(is_right(&[2, 7, 0x41, 0x12]) && !is_right(&[2, 7, 0x41, 0x13]));
    }
}
