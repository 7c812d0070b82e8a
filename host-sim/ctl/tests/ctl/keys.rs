//! The key: what is signed, what is not, and what is never sent.

use std::sync::Mutex;

use recipe_ctl::Failure;
use serde_json::json;

use crate::server::*;

/// Nonces that are valid once.
#[derive(Default)]
struct Nonces {
    given: Mutex<Vec<String>>,
}

impl Nonces {
    fn next(&self) -> String {
        let mut given = self.given.lock().unwrap();
        let nonce = format!("{:048x}", given.len() + 1);
        given.push(nonce.clone());
        nonce
    }

    fn take(&self, nonce: Option<String>) -> bool {
        let mut given = self.given.lock().unwrap();
        nonce.is_some_and(|nonce| {
            given.iter_mut().any(|one| {
                *one == nonce && {
                    one.clear();
                    true
                }
            })
        })
    }
}

/// A gateway that takes signed requests only, and gives the next nonce if it `continues`.
fn gateway(continues: bool) -> Server {
    let nonces = Nonces::default();
    Server::start(move |asked| {
        if asked.path == "nonce" {
            return ok(&json!({ "nonce": nonces.next() }));
        }
        if !nonces.take(asked.signed_nonce()) {
            return document(401, "", &json!({ "error": "the key is needed" }));
        }
        let next = if continues { format!("Next-Nonce: {}\r\n", nonces.next()) } else { String::new() };
        document(200, &next, &json!({ "live": 1, "kept": [] }))
    })
}

#[test]
fn a_change_is_signed_and_the_next_nonce_saves_a_request() {
    for (continues, expected) in [
        (true, &["GET nonce", "POST confirm", "POST confirm"][..]),
        (false, &["GET nonce", "POST confirm", "GET nonce", "POST confirm"]),
    ] {
        let server = gateway(continues);
        let client = server.client(true);
        recipe_ctl::confirm(&client).unwrap();
        recipe_ctl::confirm(&client).unwrap();
        assert_eq!(server.paths(), expected);
        for asked in server.asked() {
            assert!(!asked.head.to_lowercase().contains(KEY), "{asked:?}");
            assert!(!String::from_utf8_lossy(&asked.body).contains(KEY), "{asked:?}");
        }
    }
}

#[test]
fn reading_on_this_machine_is_signed_only_if_it_has_to_be() {
    // A forwarded port: the other machine wants the key.
    let server = gateway(true);
    recipe_ctl::revisions(&server.client(true)).unwrap();
    assert_eq!(server.paths(), ["GET revisions", "GET nonce", "GET revisions"]);
    let keyless = recipe_ctl::revisions(&server.client(false)).unwrap_err();
    assert!(keyless.message().ends_with("the key is needed; give its key with --key FILE"), "{keyless:?}");
    let open = Server::start(|_| ok(&json!({ "kept": [] })));
    recipe_ctl::revisions(&open.client(true)).unwrap();
    assert!(open.asked().iter().all(|asked| asked.field("Authorization").is_none()));
}

#[test]
fn a_wrong_key_is_shown_once() {
    let server = Server::start(|asked| match asked.path.as_str() {
        "nonce" => ok(&json!({ "nonce": "0".repeat(48) })),
        _ => document(401, "", &json!({ "error": "wrong key" })),
    });
    let error = recipe_ctl::confirm(&server.client(true)).unwrap_err();
    assert!(matches!(&error, Failure::Refused(message) if message.contains("wrong key")), "{error:?}");
    // Five of them lock an address out.
    assert_eq!(server.paths(), ["GET nonce", "POST confirm"]);
}

#[test]
fn a_nonce_that_became_old_is_replaced() {
    let nonces = Nonces::default();
    let count = Mutex::new(0);
    let server = Server::start(move |asked| {
        if asked.path == "nonce" {
            return ok(&json!({ "nonce": nonces.next() }));
        }
        *count.lock().unwrap() += 1;
        // What came with the first answer is too old by now.
        match nonces.take(asked.signed_nonce()) {
            true => document(200, &format!("Next-Nonce: {}\r\n", "f".repeat(48)), &json!({ "live": 1 })),
            false => document(401, "", &json!({ "error": "this nonce is not valid any more" })),
        }
    });
    let client = server.client(true);
    recipe_ctl::confirm(&client).unwrap();
    recipe_ctl::confirm(&client).unwrap();
    assert_eq!(server.paths(), ["GET nonce", "POST confirm", "POST confirm", "GET nonce", "POST confirm"]);
}

#[test]
fn a_nonce_cannot_add_to_a_request() {
    let server = Server::start(|asked| match asked.path.as_str() {
        "nonce" => ok(&json!({ "nonce": "0000000000000000\r\nX: y" })),
        _ => ok(&json!({})),
    });
    let error = recipe_ctl::confirm(&server.client(true)).unwrap_err();
    assert!(error.message().contains("has no nonce"), "{error:?}");
    assert_eq!(server.paths(), ["GET nonce"]);
}
