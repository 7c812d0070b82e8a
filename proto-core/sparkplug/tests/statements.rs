//! docs/fleet.md section 5: every test that it names exists, and no statement is there twice.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

fn sources(folder: &Path) -> String {
    let mut text = String::new();
    for entry in fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display())) {
        let path = entry.unwrap().path();
        text += &if path.is_dir() { sources(&path) } else { fs::read_to_string(&path).unwrap() };
    }
    text
}

#[test]
fn the_tests_of_the_statements_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let page = fs::read_to_string(root.join("docs/fleet.md")).unwrap();
    let (_, table) = page.split_once("| statement | test |\n|---|---|\n").expect("the table");
    let folders = ["proto-core/sparkplug/tests/node", "proto-core/sparkplug/src", "host-sim/tests/fleet"];
    let code: String = folders.iter().map(|folder| sources(&root.join(folder))).collect();
    let (mut rows, mut statements) = (0, BTreeSet::new());
    for row in table.lines().take_while(|line| line.starts_with('|')) {
        let [_, left, right, _] = row.split('|').collect::<Vec<_>>()[..] else { panic!("{row}") };
        let named = right.split('`').skip(1).step_by(2).filter_map(|text| text.rsplit_once("::"));
        for (_, test) in named {
            assert!(
                code.contains(&format!("fn {test}()")) || code.contains(&format!("fn {test}(")),
                "{test}"
            );
        }
        assert!(right.contains("::") || right.contains("(cell)") || right.contains("section"), "{row}");
        // A name that begins with `-` goes on from the one before.
        for statement in left.split('`').skip(1).step_by(2).filter(|name| !name.starts_with('-')) {
            assert!(statements.insert(statement.to_owned()), "{statement} twice");
        }
        rows += 1;
    }
    assert!(rows > 30 && statements.len() > 50, "{rows} rows, {} statements", statements.len());
}
