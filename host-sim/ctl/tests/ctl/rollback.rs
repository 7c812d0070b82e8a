//! `rollback` takes back a trial, and nothing else unless that is asked for.

use recipe_ctl::WithoutTrial;
use serde_json::{Value, json};

use crate::server::*;

/// A gateway with these revisions, which does as the API says.
fn gateway(revisions: Value) -> Server {
    Server::start(move |asked| match asked.path.as_str() {
        "revisions" => ok(&revisions),
        "rollback" => ok(&json!({ "running": 1, "live": 1, "kept": [] })),
        "nonce" => ok(&json!({ "nonce": "0".repeat(48) })),
        _ => not_found(),
    })
}

fn was_asked(server: &Server) -> bool {
    server.paths().iter().any(|path| path == "POST rollback")
}

#[test]
fn a_trial_that_has_ended_is_not_taken_back_again() {
    let last = json!({ "revision": 3, "ended": "failed" });
    let server = gateway(json!({ "running": 2, "live": 2, "previous": 1, "kept": [], "last": last }));
    let error = recipe_ctl::rollback(&server.client(true), WithoutTrial::Refuse).unwrap_err();
    assert!(matches!(error, recipe_ctl::Failure::Refused(_)), "{error:?}");
    let words = "no revision is on trial; revision 2 is live. The last trial, of revision 3: it did not start. \
                 `apply --revision 1` tries the one before, `rollback --previous` makes it live at once";
    assert!(error.message().ends_with(words), "{error:?}");
    assert!(!was_asked(&server), "{:?}", server.paths());
    let answer = recipe_ctl::rollback(&server.client(true), WithoutTrial::Previous).unwrap();
    assert!(was_asked(&server));
    assert!(answer.text(WIDE).starts_with("revision 1 runs and is live\n"), "{}", answer.text(WIDE));
}

#[test]
fn a_trial_is_taken_back() {
    let trial = json!({ "revision": 2, "left_s": 12.5 });
    let server = gateway(json!({ "running": 2, "live": 1, "trial": trial, "kept": [] }));
    recipe_ctl::rollback(&server.client(true), WithoutTrial::Refuse).unwrap();
    assert!(was_asked(&server));
}

#[test]
fn without_another_revision_none_is_named() {
    for (revisions, words) in [
        (json!({ "running": 1, "live": 1 }), "no revision is on trial; revision 1 is live"),
        (json!({ "live": 1 }), "no revision is on trial; revision 1 is live, and does not run at the moment"),
        (json!({ "kept": [] }), "no revision is on trial, and none was confirmed"),
    ] {
        let server = gateway(revisions);
        let error = recipe_ctl::rollback(&server.client(true), WithoutTrial::Refuse).unwrap_err();
        assert!(error.message().ends_with(words), "{error:?}");
        assert!(!was_asked(&server));
    }
}
