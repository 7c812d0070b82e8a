//! Every fuzz target with its corpus and a fixed number of random inputs (docs/fuzzing.md).

use std::path::Path;

macro_rules! targets {
    ($($name:ident)*) => {
        $(
            #[test]
            fn $name() {
                let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
                recipe_fuzz_host::target(stringify!($name)).check(&corpus);
            }
        )*

        #[test]
        fn none_is_forgotten() {
            let names: Vec<_> = recipe_fuzz_host::TARGETS.iter().map(|target| target.name).collect();
            assert_eq!(names, [$(stringify!($name)),*]);
        }
    };
}

targets! { toml inventory sparkplug operations timeline recording }
