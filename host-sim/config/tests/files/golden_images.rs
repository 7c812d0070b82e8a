//! The golden images of the newest version are what their TOML says.
//!
//! `GOLDEN=write` writes those that are missing; `config_golden` of proto-core reads them.

use std::fs;

use proto_core::config::image::{MAX_IMAGE, VERSION, encode};
use recipe_config::file::load_gateway;
use recipe_test_kit::repository;

#[test]
fn every_golden_image_is_what_its_file_says() {
    let golden = repository().join("proto-core/tests/golden");
    let mut count = 0;
    for entry in fs::read_dir(&golden).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let config = load_gateway(&path, &[]).unwrap_or_else(|error| panic!("{error}"));
        let mut out = [0; MAX_IMAGE];
        let len = encode(&*config, &mut out).unwrap();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let image = golden.join(format!("v{VERSION}/{name}.img"));
        if !image.exists() && std::env::var_os("GOLDEN").is_some_and(|value| value == "write") {
            fs::write(&image, &out[..len]).unwrap();
        }
        assert_eq!(fs::read(&image).unwrap(), out[..len], "{}", image.display());
        count += 1;
    }
    assert!(count >= 8, "only {count} golden files");
}
