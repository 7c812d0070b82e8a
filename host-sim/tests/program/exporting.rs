//! What `export` writes where, and what it refuses.

use std::path::Path;
use std::process::Output;

use recipe_test_kit::example;

use super::BINARY;

fn export(arguments: &[&str]) -> (Option<i32>, String) {
    let Output { status, stdout, stderr } = BINARY.command().arg("export").args(arguments).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap() + String::from_utf8(stderr).unwrap().as_str())
}

#[track_caller]
fn write(folder: &Path, name: &str, content: &str) -> String {
    let path = folder.join(name);
    std::fs::write(&path, content).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_file_is_replaced_only_if_that_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let input =
        write(folder.path(), "cell.toml", &std::fs::read_to_string(example("can-hand.toml")).unwrap());
    let output = folder.path().join("cell.dbc");
    let output = output.to_str().unwrap();
    let (code, text) = export(&["dbc", &input, "-o", output]);
    assert!(code == Some(0) && text.contains("cell.dbc: "), "{text}");
    assert!(std::fs::read_to_string(output).unwrap().contains("BO_ 1282 hand__502: 4 hand__device"));
    let (code, text) = export(&["dbc", &input, "-o", output]);
    assert!(code == Some(2) && text.contains("--force"), "{text}");
    let (code, _) = export(&["lua", &input, "-o", output, "--force"]);
    assert_eq!(code, Some(0));
    assert!(std::fs::read_to_string(output).unwrap().starts_with("-- Made by"));
    let (code, text) = export(&["map", &input, "-o", &input, "--force"]);
    assert!(code == Some(2) && text.contains("is made from"), "{text}");
    let (code, text) = export(&["map", &input, "-o", folder.path().to_str().unwrap(), "--force"]);
    assert!(code == Some(2) && text.contains("a folder"), "{text}");
    let link = folder.path().join("link");
    std::os::unix::fs::symlink(folder.path().join("nowhere"), &link).unwrap();
    let (code, text) = export(&["map", &input, "-o", link.to_str().unwrap(), "--force"]);
    assert!(code == Some(2) && text.contains("a link to a file that does not exist"), "{text}");
}

const TWO: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "one"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 5
fields = [{ name = "a", type = "byte" }]

[[recipe]]
name = "other"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 5
fields = [{ name = "b", type = "word" }]

[[port]]
name = "left"
bus = "can"
recipe = "one"

[[port]]
name = "right"
bus = "can"
recipe = "other"
"#;

#[test]
fn two_buses_with_one_id_need_two_databases() {
    let folder = tempfile::tempdir().unwrap();
    let input = write(folder.path(), "two.toml", TWO);
    let (code, text) = export(&["dbc", &input]);
    assert!(
        code == Some(2) && text.contains("ports left and right have different frames with id 0x5"),
        "{text}"
    );
    let (code, text) = export(&["dbc", &input, "--port", "right"]);
    assert!(code == Some(0) && text.contains("BO_ 5 other__005: 2 right__device"), "{text}");
    let (code, text) = export(&["dbc", &input, "--port", "middle"]);
    assert!(code == Some(2) && text.contains("there are left, right"), "{text}");
    let (code, text) = export(&["dbc", example("gripper.toml").to_str().unwrap()]);
    assert!(code == Some(2) && text.contains("no CAN port"), "{text}");
    let (code, text) = export(&["map", "/nowhere.toml"]);
    assert!(code == Some(2) && text.contains("/nowhere.toml"), "{text}");
}
