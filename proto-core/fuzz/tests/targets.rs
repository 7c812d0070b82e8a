//! Every fuzz target with what is kept for it and a fixed number of inputs by chance
//! (docs/fuzzing.md).

use std::path::Path;

macro_rules! targets {
    ($($name:ident)*) => {
        $(
            #[test]
            fn $name() {
                let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
                recipe_fuzz::target(stringify!($name)).check(&corpus);
            }
        )*

        #[test]
        fn none_is_forgotten() {
            let names: Vec<_> = recipe_fuzz::TARGETS.iter().map(|target| target.name).collect();
            assert_eq!(names, [$(stringify!($name)),*]);
        }
    };
}

targets! { deframer framer can state slcan modbus_server modbus_client command_server command_client engine any_engine http_head http_guard edge mqtt image store update }
