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

/// The variants or fields of each public type of this name, in their order.
fn names_in_source(sources: &[String], name: &str) -> Vec<Vec<String>> {
    let name_of = |line: &str| -> String {
        let line = line.strip_prefix("pub ").unwrap_or(line);
        line.chars().take_while(|next| next.is_alphanumeric() || *next == '_').collect()
    };
    let mut found = Vec::new();
    for source in sources {
        for kind in ["enum", "struct"] {
            let head = format!("\npub {kind} {name}");
            for (at, _) in source.match_indices(&head) {
                let rest = &source[at + head.len()..];
                if rest.starts_with(|next: char| next.is_alphanumeric() || next == '(') {
                    continue;
                }
                // What stands four blanks in, at the beginning of a line.
                let body = rest.split_once("{\n").and_then(|(_, body)| body.split_once("\n}")).unwrap().0;
                let own = body.lines().filter_map(|line| line.strip_prefix("    "));
                let own = own.filter(|line| line.starts_with(|first: char| first.is_alphabetic()));
                found.push(own.map(name_of).collect());
            }
        }
    }
    found
}

/// An image holds variants by their number and fields by their place. Whoever sorts them, or puts a new one between,
/// makes boards read other things from the images that they have.
#[test]
fn variants_and_fields_stand_in_the_order_of_the_newest_version() {
    let mut sources = Vec::new();
    let mut folders = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("src")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                sources.push(std::fs::read_to_string(path).unwrap());
            }
        }
    }
    let types = std::fs::read_to_string(golden().join(format!("v{VERSION}/types.txt"))).unwrap();
    let mut kept: Vec<(String, Vec<String>)> = Vec::new();
    for line in types.lines() {
        if let Some((name, kind)) = line.split_once(": ").filter(|_| !line.starts_with(' ')) {
            if kind.starts_with("Enum") || kind.starts_with("Struct") {
                kept.push((name.to_owned(), Vec::new()));
            }
        } else if let Some(name) =
            line.strip_prefix("            name: \"").and_then(|rest| rest.strip_suffix("\","))
        {
            kept.last_mut().unwrap().1.push(name.to_owned());
        }
    }
    assert!(kept.len() > 50, "{} types", kept.len());
    for (name, names) in kept {
        let found = names_in_source(&sources, &name);
        assert!(
            found.contains(&names),
            "{name}: was {names:?}, is {found:?}; that needs a new version of images"
        );
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
