//! The fuzz target with its corpus and a fixed number of random inputs (docs/fuzzing.md).

use std::path::Path;

#[test]
fn toml() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    host_sim_fuzz::target("toml").check(&corpus);
}
