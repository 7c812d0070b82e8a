//! The options of a console, right and wrong.

use std::os::unix::fs::PermissionsExt;
use std::process::Output;

use crate::kit::*;

fn refused(extra: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    write_key(&folder);
    let key = folder.path().join("open");
    std::fs::write(&key, KEY).unwrap();
    std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o644)).unwrap();
    std::fs::write(folder.path().join("cell.toml"), config(500)).unwrap();
    std::fs::write(folder.path().join("robot.toml"), ROBOT).unwrap();
    let mut command = BINARY.command();
    let bind = "--bind=device=tcp-listen:127.0.0.1:0";
    command.current_dir(folder.path()).args(extra);
    if extra[0] == "gateway" {
        command.args(["-c", "cell.toml", bind]);
    } else {
        command.args(["-c", "robot.toml"]);
    }
    let Output { status, stdout, stderr } = command.output().unwrap();
    assert_eq!((status.code(), stdout.len()), (Some(2), 0), "{extra:?}");
    String::from_utf8(stderr).unwrap()
}

#[test]
fn what_would_be_open_to_others_is_refused() {
    let other = refused(&["gateway", "--console=0.0.0.0:0"]);
    assert!(other.contains("--console 0.0.0.0:0: other machines are served only with a key"), "{other}");
    let open = refused(&["gateway", "--console=127.0.0.1:0", "--console-key=open"]);
    assert!(open.contains("--console-key open: others may use it, its mode is 0644"), "{open}");
    assert!(!open.contains(KEY));
    let none = refused(&["gateway", "--console=127.0.0.1:0", "--console-key=none"]);
    assert!(none.contains("--console-key none: "), "{none}");
    let other = refused(&["controller", "--console=[::]:0"]);
    assert!(other.contains("other machines are served only with a key"), "{other}");
}

#[test]
fn what_makes_no_sense_is_refused() {
    assert!(refused(&["gateway", "--console-key=key"]).contains("--console"));
    assert!(refused(&["gateway", "--console=8480"]).contains("invalid"));
    let keeps = refused(&["controller", "--console=127.0.0.1:0", "--console-state=state"]);
    assert!(keeps.contains("--console-state: a simulated controller keeps no revisions"), "{keeps}");
    let used = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = used.local_addr().unwrap();
    let taken = refused(&["gateway", &format!("--console={address}")]);
    assert!(taken.contains(&format!("--console {address}: ")), "{taken}");
}

#[test]
fn a_folder_serves_one_gateway() {
    let cell = Cell::new();
    let state = cell.folder.path().join("state").display().to_string();
    let other = refused(&["gateway", "--console=127.0.0.1:0", "--console-state", &state]);
    assert!(other.contains("another process uses this folder"), "{other}");
}
