//! The fuzz target with what is kept for it and a fixed number of inputs by chance
//! (docs/fuzzing.md).

use std::path::Path;

#[test]
fn toml() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    host_sim_fuzz::target("toml").check(&corpus);
}
