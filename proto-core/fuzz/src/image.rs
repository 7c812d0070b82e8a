//! Configuration images: anything that flash can hold (docs/configuration.md section 6).

use proto_core::config::image::{
    HEADER, ImageError, MAGIC, MAX_IMAGE, OLDEST_VERSION, Scan, VERSION, decode, decode_into, encode,
    image_len,
};
use proto_core::config::{ControllerLink, GatewayConfig};
use proto_core::engine::{BuildError, Engine};

use crate::any_config;
use crate::any_engine;
use crate::model;
use crate::source::Source;

/// How many versions are read.
const READ: u32 = VERSION - OLDEST_VERSION + 1;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let kind = input.u8();
    let mut bytes = match kind % 4 {
        // Anything.
        0 => input.rest().to_vec(),
        // Any contents, with the header that they need, of any version that is read.
        1 => with_header(OLDEST_VERSION + u32::from(kind >> 2) % READ, input.rest()),
        // A configuration, right or wrong, with bytes changed but for the checksum, or with it.
        _ => {
            let Some(config) = any_config::config(&mut input) else { return };
            let Some(mut bytes) = image_of(&config) else { return };
            while !input.is_empty() {
                let at = usize::from(input.u16()) % bytes.len();
                bytes[at] ^= input.u8();
            }
            if kind % 4 == 2 { with_header(VERSION, &bytes[HEADER..]) } else { bytes }
        }
    };
    look_at(&bytes);
    // Flash is erased in whole sectors: what follows does not matter. What is missing does.
    let read = decode(&bytes);
    bytes.extend([0xFF; 9]);
    if bytes.starts_with(&MAGIC) && read.is_ok() {
        assert_eq!(decode(&bytes), read);
        let len = image_len(&bytes).expect("it was read");
        for short in [len - 1, HEADER, HEADER - 1, 0] {
            assert!(
                matches!(decode(&bytes[..short]), Err(ImageError::TooShort { .. })),
                "{short} of {len} bytes"
            );
        }
    }
}

fn look_at(bytes: &[u8]) {
    let read = decode(bytes);
    // What was there before does not show.
    let mut over = model::cell();
    assert_eq!(decode_into(bytes, &mut over).map(|()| over), read);
    // A scan finds the same, but for what the parts say together.
    let found = read.as_ref().err().copied().filter(|error| !matches!(error, ImageError::Config(_)));
    assert_eq!(scanned(bytes), found);
    match (payload(bytes), &read) {
        (Err(()), Err(ImageError::Contents | ImageError::TooMany { .. } | ImageError::Config(_)) | Ok(_)) => {
            panic!("taken: {read:?}")
        }
        (Err(()), Err(_)) => {}
        (Ok((VERSION, payload)), _) => match postcard::take_from_bytes::<GatewayConfig>(payload) {
            Ok((config, [])) => match config.validate() {
                Ok(()) => assert_eq!(read.as_ref(), Ok(&config)),
                Err(error) => assert_eq!(read, Err(ImageError::Config(error))),
            },
            _ => assert!(matches!(read, Err(ImageError::Contents | ImageError::TooMany { .. })), "{read:?}"),
        },
        (Ok(_), _) => assert!(!matches!(read, Err(ImageError::Crc { .. } | ImageError::Version { .. }))),
    }
    if let Ok(config) = read {
        let again = image_of(&config).expect("it was in an image");
        assert_eq!(decode(&again), Ok(config.clone()));
        assert!(encode(&config, &mut vec![0; again.len() - 1]).is_err());
        let engine = Engine::<8, 4, 512>::new(&config);
        assert!(!matches!(engine, Err(BuildError::Config(_))), "{:?}", engine.map(|_| ()));
    }
}

/// What a scan refuses.
fn scanned(bytes: &[u8]) -> Option<ImageError> {
    let mut scan = Scan::new();
    // A list of each, and a byte of each entry at least.
    for _ in 0..MAX_IMAGE {
        match scan.step(bytes) {
            Ok(true) => {}
            Ok(false) => return None,
            Err(error) => return Some(error),
        }
    }
    panic!("it has no end")
}

/// `None` for the largest configurations.
fn image_of(config: &GatewayConfig) -> Option<Vec<u8>> {
    let mut bytes = vec![0xA5; MAX_IMAGE];
    let len = encode(config, &mut bytes).ok()?;
    bytes.truncate(len);
    Some(bytes)
}

/// Section 6: `RGCI`, version, length and CRC-32, four bytes each. The version and the payload.
fn payload(bytes: &[u8]) -> Result<(u32, &[u8]), ()> {
    let word = |nth: usize| {
        bytes.get(4 * nth..4 * nth + 4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).ok_or(())
    };
    if bytes.get(..4) != Some(b"RGCI")
        || !(OLDEST_VERSION..=VERSION).contains(&word(1)?)
        || word(2)? as usize > MAX_IMAGE - 16
    {
        return Err(());
    }
    let payload = bytes.get(16..16 + word(2)? as usize).ok_or(())?;
    let covered = [&bytes[4..12], payload].concat();
    if word(3)? == crc32(&covered) { Ok((word(1)?, payload)) } else { Err(()) }
}

fn with_header(version: u32, payload: &[u8]) -> Vec<u8> {
    let covered = [&version.to_le_bytes()[..], &(payload.len() as u32).to_le_bytes(), payload].concat();
    [b"RGCI", &covered[..8], &crc32(&covered).to_le_bytes(), payload].concat()
}

/// The CRC-32 of Ethernet and zip, bit by bit.
pub(crate) fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for &byte in bytes {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = crc >> 1 ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
        }
    }
    !crc
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let cell = image_of(&model::cell()).expect("a small configuration");
    let mut seeds = vec![[&[0], &cell[..]].concat(), [&[5], &cell[HEADER..]].concat(), vec![0]];
    // Kind 1 is of version 1.
    let network = postcard::take_from_bytes::<ControllerLink>(&cell[HEADER..]).expect("it begins so").1;
    let controller = &cell[HEADER..cell.len() - network.len()];
    seeds.push([&[1], controller, &network[1..]].concat());
    // Another magic, version, length and checksum.
    for at in [0, 4, 8, 10, 12, HEADER, cell.len() - 1] {
        let mut wrong = cell.clone();
        wrong[at] ^= 1;
        seeds.push([&[0], &wrong[..]].concat());
    }
    for seed in any_engine::seeds() {
        seeds.push([&[2], &seed[..seed.len().min(60)]].concat());
        seeds.push([&[3], &seed[..seed.len().min(60)]].concat());
        if let Some(image) = any_config::config(&mut Source::new(&seed)).and_then(|config| image_of(&config))
        {
            seeds.push([&[5], &image[HEADER..]].concat());
        }
    }
    seeds
}
