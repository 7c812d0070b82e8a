//! Every file under `configs/` loads and is what its name says.

use recipe_config::file::{self, Config};
use recipe_test_kit::{example, examples};

#[test]
fn every_example_file_is_valid() {
    let files = examples();
    assert!(files.len() >= 18, "only {} files", files.len());
    for path in files {
        let config = file::load(&path, &[]).unwrap_or_else(|error| panic!("{error}"));
        let is_controller = path.to_string_lossy().ends_with("-controller.toml");
        assert_eq!(matches!(config, Config::Controller(_)), is_controller, "{}", path.display());
    }
}

#[test]
fn a_controller_and_its_gateway_mean_the_same_recipe() {
    // Both ends of a recipe link must agree on every byte.
    let recipe = |file: &str, name: &str| {
        let recipes = file::load_recipes(&example(file), &[]).unwrap();
        recipes.into_iter().find(|recipe| recipe.name() == name).unwrap()
    };
    for (gateway, controller, name) in [
        ("force-sensor.toml", "force-sensor-controller.toml", "up"),
        ("udp-server.toml", "udp-server-controller.toml", "system"),
        ("client.toml", "client-controller.toml", "system"),
        ("rs485-user.toml", "rs485-user-controller.toml", "three-bytes"),
        ("rs485-system.toml", "rs485-system-controller.toml", "system"),
        ("can-user.toml", "can-user-controller.toml", "three-bytes"),
        ("can-system.toml", "can-system-controller.toml", "system"),
    ] {
        assert_eq!(recipe(gateway, name), recipe(controller, name), "{gateway}");
    }
}
