//! Images that are read back unchanged, and images that are refused.

use std::string::ToString;
use std::vec;
use std::vec::Vec;

use super::*;
use crate::config::tests::every_kind;

fn image() -> Vec<u8> {
    let mut out = vec![0xA5; 1024];
    let len = encode(&every_kind(), &mut out).unwrap();
    assert!(out[len..].iter().all(|&byte| byte == 0xA5), "nothing is written after the image");
    out.truncate(len);
    out
}

#[test]
fn a_configuration_survives_and_what_follows_does_not_matter() {
    let mut image = image();
    assert_eq!(image_len(&image), Ok(image.len()));
    assert_eq!(decode(&image).as_ref(), Ok(&every_kind()));
    image.extend([0xFF; 200]);
    assert_eq!(decode(&image).as_ref(), Ok(&every_kind()));
}

#[test]
fn the_header_has_its_fixed_layout() {
    let image = image();
    assert_eq!(image[..4], *b"RGCI");
    assert_eq!(image[4..8], [4, 0, 0, 0]);
    assert_eq!(image[8..12], ((image.len() - HEADER) as u32).to_le_bytes());
}

#[test]
fn every_changed_byte_and_bit_is_refused() {
    let image = image();
    for place in 0..image.len() {
        for change in (0..8).map(|bit| 1_u8 << bit).chain([0xFF]) {
            let mut damaged = image.clone();
            damaged[place] ^= change;
            let refused = decode(&damaged).expect_err("a changed byte");
            let expected = match place {
                0..4 => matches!(refused, ImageError::NotAnImage { .. }),
                // Changed to another readable version: wrong CRC.
                4..8 => matches!(refused, ImageError::Version { .. } | ImageError::Crc { .. }),
                // A longer payload: truncated or too long. A shorter one: wrong CRC.
                8..12 => matches!(
                    refused,
                    ImageError::TooShort { .. } | ImageError::TooLong { .. } | ImageError::Crc { .. }
                ),
                _ => matches!(refused, ImageError::Crc { .. }),
            };
            assert!(expected, "byte {place} ^ {change:#04X}: {refused}");
        }
    }
}

#[test]
fn every_cut_is_refused_with_what_is_missing() {
    let image = image();
    for cut in 0..image.len() {
        let needed = if cut < HEADER { HEADER } else { image.len() };
        let expected = ImageError::TooShort { needed, available: cut };
        assert_eq!(decode(&image[..cut]).err(), Some(expected));
    }
}

#[test]
fn nothing_of_the_previous_configuration_remains() {
    let mut config = every_kind();
    let mut small = every_kind();
    small.safe_values.clear();
    small.commands.truncate(1);
    for port in &mut small.ports {
        port.on_timeout = crate::config::Span::default();
    }
    let mut out = [0; 1024];
    let len = encode(&small, &mut out).unwrap();
    assert_eq!(decode_into(&out[..len], &mut config), Ok(()));
    assert_eq!(config, small);
}

/// Lists that an older version lacks are emptied.
#[test]
fn nothing_of_a_newer_configuration_remains_in_an_older_one() {
    let old = include_bytes!("../../../tests/golden/v3/serial.img");
    let newer = include_bytes!("../../../tests/golden/v4/modbus-master.img");
    let mut config = decode(newer).unwrap();
    assert!(!config.exchanges.is_empty());
    assert_eq!(decode_into(old, &mut config), Ok(()));
    assert_eq!(Ok(config), decode(old));
}

/// Scans an image to its end.
fn scanned(image: &[u8]) -> Result<Scan, ImageError> {
    let mut scan = Scan::new();
    while scan.step(image)? {}
    Ok(scan)
}

#[test]
fn a_scan_finds_what_reading_finds_but_for_what_parts_say_together() {
    let whole = image();
    let buses: Vec<_> = every_kind().ports.iter().map(|port| port.bus.clone()).collect();
    assert_eq!(scanned(&whole).unwrap().buses(), buses);
    for cut in 0..whole.len() {
        assert_eq!(scanned(&whole[..cut]).err(), decode(&whole[..cut]).err());
    }
    for place in HEADER..whole.len() {
        for change in [1, 0x80, 0xFF] {
            let mut payload = whole[HEADER..].to_vec();
            payload[place - HEADER] ^= change;
            let changed = around(&payload);
            let read = decode(&changed).err().filter(|error| !matches!(error, ImageError::Config(_)));
            assert_eq!(scanned(&changed).err(), read, "byte {place}");
        }
    }
    for payload in [&[][..], &[0xFF; 40], &[&whole[HEADER..], &[0]].concat()] {
        assert_eq!(scanned(&around(payload)).err(), Some(ImageError::Contents));
    }
}

/// The image can be read in pieces or as a whole.
#[test]
fn the_payload_is_the_configuration_in_postcard() {
    let image = image();
    assert_eq!(postcard::from_bytes::<GatewayConfig>(&image[HEADER..]).as_ref(), Ok(&every_kind()));
}

#[test]
fn erased_flash_is_no_image() {
    for erased in [0x00, 0xFF] {
        let refused = decode(&[erased; 256]).unwrap_err();
        assert_eq!(refused, ImageError::NotAnImage { found: [erased; 4] });
    }
    assert_eq!(
        decode(&[0xFF; 256]).unwrap_err().to_string(),
        "not a configuration image: it begins with [FF, FF, FF, FF]"
    );
}

#[test]
fn a_file_of_text_is_told_what_makes_an_image_of_it() {
    let said = "this is text, not a configuration image; `host-sim image FILE -o OUT` makes the image of a TOML file";
    for toml in ["# Force sensor\n[controller]\naddress = 1", "[controller]\naddress = \"10.0.0.2\""] {
        assert_eq!(decode(toml.as_bytes()).unwrap_err().to_string(), said);
    }
}

/// An image around any payload, with a correct header.
fn around(payload: &[u8]) -> Vec<u8> {
    let length = payload.len() as u32;
    let mut image = MAGIC.to_vec();
    for word in [VERSION, length, checksum(VERSION, length, payload)] {
        image.extend(word.to_le_bytes());
    }
    image.extend(payload);
    image
}

#[test]
fn contents_that_are_no_configuration_are_refused() {
    let image = image();
    assert_eq!(around(&image[HEADER..]), image);
    for payload in [&[][..], &[0xFF; 40], &[&image[HEADER..], &[0]].concat()] {
        assert_eq!(decode(&around(payload)).err(), Some(ImageError::Contents));
    }
}

#[test]
fn a_wrong_configuration_is_refused_with_its_own_reason() {
    let mut config = every_kind();
    config.ports[0].cycle = crate::time::Duration::from_millis(3);
    let mut out = [0; 1024];
    let len = encode(&config, &mut out).unwrap();
    let expected = config.validate().unwrap_err();
    assert_eq!(decode(&out[..len]).err(), Some(ImageError::Config(expected)));
}

#[test]
fn an_image_needs_room() {
    let image = image();
    for room in 0..image.len() {
        let mut out = vec![0; room];
        assert_eq!(encode(&every_kind(), &mut out), Err(NoSpace { available: room }));
    }
}
