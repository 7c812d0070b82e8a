//! Configuration images of every version, one of each kind.
//!
//! Never change an image in `tests/golden`: boards in the field hold such bytes. A change of a
//! serialized type needs a new version, with images of its own beside these. The text beside an image
//! is its configuration; it grows when a configuration gets new fields. The types of the newest version are compared by
//! `proto-core/public-api/tests/image_types.rs`.
#![cfg(feature = "image")]

use std::path::{Path, PathBuf};

use proto_core::config::GatewayConfig;
use proto_core::config::image::{
    ImageError, MAX_IMAGE, OLDEST_VERSION, VERSION, decode, decode_into, encode, image_len,
};

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden")
}

/// Every image of a version, with its name.
fn images(version: u32) -> Vec<(String, Vec<u8>)> {
    let folder = golden().join(format!("v{version}"));
    let mut images: Vec<_> = std::fs::read_dir(&folder)
        .unwrap_or_else(|error| panic!("every version has images: {}: {error}", folder.display()))
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "img"))
        .map(|path| (path.file_stem().unwrap().to_str().unwrap().to_owned(), std::fs::read(&path).unwrap()))
        .collect();
    images.sort();
    images
}

/// Writes what is missing with `GOLDEN=write`.
fn write_missing(path: &Path, bytes: &[u8]) {
    if !path.exists() && std::env::var_os("GOLDEN").is_some_and(|value| value == "write") {
        std::fs::write(path, bytes).unwrap();
    }
}

/// Compares with a stored text.
#[track_caller]
fn matches_text(path: &Path, said: &str) {
    write_missing(path, said.as_bytes());
    let kept = std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    if kept != said {
        let line = kept.lines().zip(said.lines()).position(|(kept, said)| kept != said);
        panic!("{} differs from line {:?}; it is now:\n{said}", path.display(), line.map(|line| line + 1));
    }
}

#[test]
fn every_kept_image_means_what_it_meant() {
    for version in OLDEST_VERSION..=VERSION {
        let images = images(version);
        assert!(images.len() >= 4, "version {version}: {} kinds of configuration", images.len());
        for (name, bytes) in images {
            assert_eq!(bytes[4..8], version.to_le_bytes(), "v{version}/{name}");
            assert_eq!(image_len(&bytes), Ok(bytes.len()), "v{version}/{name}");
            let config = decode(&bytes).unwrap_or_else(|error| panic!("v{version}/{name}: {error}"));
            // An image of an older version gives the same configuration today.
            matches_text(&golden().join(format!("{name}.txt")), &format!("{config:#?}\n"));
        }
    }
}

/// If this fails, a serialized type has changed, which needs a new version.
#[test]
fn the_newest_version_is_written_as_it_always_was() {
    for (name, bytes) in images(VERSION) {
        let config = decode(&bytes).unwrap();
        let mut out = [0; MAX_IMAGE];
        let len = encode(&config, &mut out).unwrap();
        assert_eq!(out[..len], bytes, "{name}");
    }
}

/// An image of an older version that is written again has the newest version.
#[test]
fn migrated_images_are_of_the_newest_version() {
    for version in OLDEST_VERSION..VERSION {
        for (name, bytes) in images(version) {
            let config = decode(&bytes).unwrap();
            let mut out = [0; MAX_IMAGE];
            let len = encode(&config, &mut out).unwrap();
            write_missing(&golden().join(format!("v{VERSION}/{name}.img")), &out[..len]);
            let (_, newest) = images(VERSION).into_iter().find(|(other, _)| *other == name).unwrap();
            assert_eq!(out[..len], newest, "{name} of version {version}");
        }
    }
}

#[test]
fn every_damaged_older_image_is_refused() {
    for (name, bytes) in images(OLDEST_VERSION) {
        for place in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[place] ^= 0x10;
            assert!(decode(&damaged).is_err(), "{name}: byte {place}");
            assert!(decode(&bytes[..place]).is_err(), "{name}: cut at {place}");
        }
    }
}

#[test]
fn a_newer_version_is_refused_with_its_number() {
    for version in [0, VERSION + 1, 7, u32::MAX] {
        let (_, mut bytes) = images(VERSION).remove(0);
        bytes[4..8].copy_from_slice(&version.to_le_bytes());
        assert_eq!(decode(&bytes).err(), Some(ImageError::Version { found: version }));
        assert_eq!(image_len(&bytes), Err(ImageError::Version { found: version }));
    }
    let said = ImageError::Version { found: 7 }.to_string();
    assert_eq!(said, format!("the image has version 7; this program reads {OLDEST_VERSION} to {VERSION}"));
}

#[test]
fn a_small_configuration_takes_what_it_has_room_for() {
    let (_, bytes) = images(VERSION).into_iter().find(|(name, _)| name == "can").unwrap();
    let mut small: GatewayConfig<1, 1, 6, 0, 0> = GatewayConfig::empty();
    decode_into(&bytes, &mut small).unwrap();
    assert_eq!(small.view(), decode(&bytes).unwrap().view());
    let mut too_small: GatewayConfig<1, 1, 5, 0, 0> = GatewayConfig::empty();
    let refused = decode_into(&bytes, &mut too_small).unwrap_err();
    assert!(matches!(refused, ImageError::TooMany { needed: 6, room: 5, .. }), "{refused}");
    let said = "the image has 6 fields in all recipes together; there is room for 5";
    assert_eq!(refused.to_string(), said);
}
