//! The public interfaces of proto-core: for Rust, and for C.
//!
//!     recipe-public-api items JSON             prints the version and the public items, one per line
//!     recipe-public-api check JSON RELEASE     fails if an item of RELEASE is gone or has changed
//!     recipe-public-api header                 prints the header of capi
//!
//! JSON is rustdoc's description of proto-core (`.ci/run api` has the command). RELEASE is the output of
//! `items` at the last release: `proto-core/api.txt`. A change that is no addition needs a version that
//! Cargo takes as incompatible: `0.3.0` after `0.2.x`, `2.0.0` after `1.x.y`.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::ExitCode;
use std::{env, fs};

mod version;

type AnyError = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let done = match arguments[..] {
        ["items", json] => items(json).map(|items| {
            println!("{}", env!("CARGO_PKG_VERSION"));
            items.iter().for_each(|item| println!("{item}"));
        }),
        ["check", json, release] => check(json, release),
        ["header"] => header(),
        _ => Err("usage: recipe-public-api items JSON | check JSON RELEASE | header".into()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("recipe-public-api: {error}");
            ExitCode::FAILURE
        }
    }
}

fn items(json: &str) -> Result<BTreeSet<String>, AnyError> {
    let builder = public_api::Builder::from_rustdoc_json(json);
    let api = builder.omit_blanket_impls(true).omit_auto_trait_impls(true).build()?;
    let items = api.items().map(ToString::to_string);
    // The pages of docs/ are modules only in the documentation.
    Ok(items.filter(|item| !item.contains("proto_core::docs")).collect())
}

fn check(json: &str, release: &str) -> Result<(), AnyError> {
    let release = fs::read_to_string(release)?;
    let (version, released) = release.split_once('\n').ok_or("the release has no version")?;
    let now = items(json)?;
    let released: BTreeSet<String> = released.lines().map(str::to_owned).collect();
    let gone: Vec<&String> = released.difference(&now).collect();
    let added = now.difference(&released).count();
    let current = env!("CARGO_PKG_VERSION");
    println!("{} public items; since {version}: {added} added, {} gone or changed", now.len(), gone.len());
    if gone.is_empty() || !version::is_compatible(version, current)? {
        return Ok(());
    }
    gone.iter().for_each(|item| println!("- {item}"));
    Err(format!("{current} promises what {version} had, and the items above are gone or changed").into())
}

fn header() -> Result<(), AnyError> {
    let capi = Path::new(env!("CARGO_MANIFEST_DIR")).join("../capi");
    let config = cbindgen::Config::from_file(capi.join("cbindgen.toml"))?;
    let bindings = cbindgen::Builder::new().with_config(config).with_crate(capi).generate()?;
    bindings.write(std::io::stdout());
    Ok(())
}
