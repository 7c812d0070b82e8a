//! Any file and any override is read, or refused with a message of one line.

use proptest::prelude::*;
use recipe_config::file::{Text, parse, parse_recipes};
use recipe_test_kit::examples;
use recipe_test_kit::toml::PIECES;

fn configs() -> Vec<String> {
    examples().iter().map(|path| std::fs::read_to_string(path).unwrap()).collect()
}

/// Cuts a text at a character near `place`.
fn split(text: &str, place: usize) -> (&str, &str) {
    let place = (0..=place.min(text.len())).rev().find(|&place| text.is_char_boundary(place)).unwrap_or(0);
    text.split_at(place)
}

proptest! {
    #[test]
    fn a_damaged_file_is_refused_in_one_line_or_good(
        file in any::<prop::sample::Index>(),
        damage in prop::collection::vec((any::<prop::sample::Index>(), 0_usize..40, 0..PIECES.len()), 1..5),
    ) {
        let configs = configs();
        let mut text = file.get(&configs).clone();
        for (place, taken, piece) in damage {
            let (before, after) = split(&text, place.index(text.len() + 1));
            let (_, after) = split(after, taken);
            text = format!("{before}{}{after}", PIECES[piece]);
        }
        let text = Text { name: "damaged.toml", toml: &text };
        for refused in [parse(text, &[]).err(), parse_recipes(text, &[]).err()].into_iter().flatten() {
            let message = refused.to_string();
            prop_assert!(message.starts_with("damaged.toml:"), "{message}");
            prop_assert!(!message.contains('\n'), "{message:?}");
        }
    }

    #[test]
    fn a_strange_override_is_refused_in_one_line_or_good(key in "[a-z0-9.\"\\[\\]-]{0,20}", value in ".{0,20}", known in any::<prop::sample::Index>()) {
        let known = *known.get(&["", "controller.", "port.rs485-1.", "recipe.system.", "recipe.system.output.", "port.1."]);
        let configs = configs();
        let toml = configs.iter().find(|text| text.contains("rs485-1") && text.contains("RobotState[8..11]")).unwrap();
        let text = Text { name: "cell.toml", toml };
        if let Err(refused) = parse(text, &[format!("{known}{key}={value}")]) {
            let message = refused.to_string();
            prop_assert!(message.starts_with("--set ") || message.starts_with("cell.toml:"), "{message}");
        }
    }
}

#[test]
fn a_line_break_in_an_override_or_a_name_stays_in_its_line() {
    let refused =
        parse(Text { name: "a\nb.toml", toml: "[controller]\n" }, &["x=1\r\n2".to_owned()]).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "--set x=1\\r\\n2: x: unknown key; allowed: controller, network, recipe, port"
    );
    let refused = parse(Text { name: "a\nb.toml", toml: "[controller" }, &[]).unwrap_err();
    assert!(refused.to_string().starts_with("a\\nb.toml:1:"), "{refused}");
}
