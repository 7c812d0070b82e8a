//! Other configurations: stored, tried, confirmed, taken back.

use crc::{CRC_32_ISO_HDLC, Crc};
use proto_core::config::image;
use recipe_test_kit::http::Response;
use serde_json::{Value, json};

use crate::board::{QemuBoard, make_image, panel};

#[test]
#[ignore = "needs QEMU and the firmware"]
fn what_is_confirmed_runs_after_a_restart_and_what_is_not_does_not() {
    let mut board = QemuBoard::claimed(&panel(500));
    assert_eq!(board.put(&panel(600)), 2);
    let revisions = board.revisions();
    assert_eq!((&revisions["waiting"], &revisions["running"]), (&json!(2), &json!(1)));
    board.client.post("confirm", "").must_be(409);
    let applied = board.client.post("apply", "{\"confirm_s\": 120}").must_be(200).json();
    assert_eq!(applied["revision"], 2);
    let tried = board.until_revisions("2 runs", |shown| shown["running"] == 2);
    assert_eq!((&tried["trial"]["revision"], &tried["live"]), (&json!(2), &json!(1)));
    assert!((1.0..120.0).contains(&tried["trial"]["left_s"].as_f64().unwrap()), "{tried}");
    assert!(board.client.post("apply", "{\"revision\": 1}").must_be(409).text().contains("on trial"));
    let confirmed = board.client.post("confirm", "{}").must_be(200).json();
    assert_eq!((&confirmed["live"], &confirmed["previous"]), (&json!(2), &json!(1)));
    assert_eq!(confirmed["last"], json!({ "revision": 2, "ended": "confirmed" }));
    board.power_cycle();
    board.until_log("configuration 2 of the store, the live one");

    // Nobody confirms it.
    assert_eq!(board.put(&panel(700)), 3);
    board.client.post("apply", "{\"confirm_s\": 2}").must_be(200);
    let is_back = |shown: &Value| shown["last"]["revision"] == 3 && shown["running"] == 2;
    let back = board.until_revisions("2 runs again", is_back);
    assert_eq!((&back["live"], &back["last"]["ended"]), (&json!(2), &json!("not-confirmed")));

    // Somebody takes it back.
    board.client.post("apply", "{\"revision\": 3}").must_be(200);
    board.until_revisions("3 runs", |shown| shown["running"] == 3);
    board.client.post("rollback", "").must_be(200);
    let is_back = |shown: &Value| shown["last"]["ended"] == "taken-back" && shown["running"] == 2;
    board.until_revisions("2 runs again", is_back);

    // What is live, too.
    board.client.post("rollback", "").must_be(200);
    let back = board.until_revisions("1 runs again", |shown| shown["running"] == 1);
    assert_eq!((&back["live"], &back["previous"]), (&json!(1), &json!(2)));
}

/// A recipe that there is not: what the parts of a configuration say together is found at the start.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn what_cannot_run_gives_way_at_once_and_says_why() {
    let board = QemuBoard::claimed(&panel(500));
    let image = std::fs::read(make_image(board.folder.path(), "next", &panel(600))).unwrap();
    let mut config = image::decode(&image).unwrap();
    config.ports[0].recipe = 7;
    let mut wrong = [0; image::MAX_IMAGE];
    let len = image::encode(&config, &mut wrong).unwrap();
    assert_eq!(board.put_image(&wrong[..len]).must_be(201).json()["revision"], 2);
    board.client.post("apply", "").must_be(200);
    let back = board.until_revisions("the board is back", |shown| shown["last"]["revision"] == 2);
    assert_eq!((&back["running"], &back["last"]["ended"]), (&json!(1), &json!("failed")));
    assert!(back["failure"].as_str().unwrap().contains("there is no recipe"), "{back}");
}

/// It is the network that brings the first configuration.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn an_empty_board_is_claimed_and_gets_its_first_configuration() {
    let mut board = QemuBoard::empty();
    board.until_log("nothing runs: ");
    board.claim();
    let revisions = board.revisions();
    assert_eq!(revisions, json!({ "kept": [], "base": "\"0-00000000\"" }));
    board.client.get("status").must_be(503);
    board.client.get("config").must_be(404);
    board.client.post("rollback", "").must_be(409);
    assert_eq!(board.put(&panel(500)), 1);
    // Not confirmed, it goes again.
    board.client.post("apply", "{\"confirm_s\": 12}").must_be(200);
    board.until_revisions("1 runs", |shown| shown["running"] == 1);
    let is_over = |shown: &Value| shown["last"]["ended"] == "not-confirmed" && shown["running"].is_null();
    assert_eq!(board.until_revisions("nothing runs", is_over)["live"], Value::Null);
    board.client.post("apply", "{\"revision\": 1}").must_be(200);
    board.until_revisions("1 runs", |shown| shown["running"] == 1);
    let confirmed = board.client.post("confirm", "").must_be(200).json();
    assert_eq!((&confirmed["live"], &confirmed["previous"]), (&json!(1), &Value::Null));
    board.power_cycle();
    board.until_log("configuration 1 of the store, the live one");
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn wrong_images_are_refused_with_a_reason_and_nothing_is_kept() {
    let board = QemuBoard::claimed(&panel(500));
    let right_one = std::fs::read(make_image(board.folder.path(), "next", &panel(600))).unwrap();
    let base = board.revisions()["base"].as_str().unwrap().to_owned();
    // What only the configuration itself shows, behind a right checksum: entries that are none, and ports that the
    // board does not have.
    let port = |name: &str| format!("\n[[port]]\nname = \"{name}\"\nbus = \"rs485\"\nrecipe = \"second\"\n");
    let second = "\n[[recipe]]\nname = \"second\"\nkind = \"stream\"\nmode = \"user\"\n[recipe.output]\nhead = [1]\n\
                  tail = [2]\nfields = [{ name = \"o\", type = \"byte\", value = 1 }]\n";
    let three = format!("{}{second}{}{}", panel(600), port("b"), port("c"));
    let three = std::fs::read(make_image(board.folder.path(), "three", &three)).unwrap();
    let mut nonsense = right_one.clone();
    let last = nonsense.len() - 1;
    nonsense[last] = 9;
    let crc =
        Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&[&nonsense[4..12], &nonsense[image::HEADER..]].concat());
    nonsense[12..16].copy_from_slice(&crc.to_le_bytes());
    let put =
        |image: &[u8], fields: &str| -> Response { board.client.signed("PUT /api/v1/config", fields, image) };
    let right = format!("Content-Type: application/octet-stream\nIf-Match: {base}");
    let mut damaged = right_one.clone();
    damaged[40] ^= 1;
    let mut newer = right_one.clone();
    newer[4] = 99;
    for (wrong, why) in [
        (&damaged[..], "the image is damaged"),
        (&right_one[..right_one.len() - 1], "the image is cut short"),
        (&newer, "version 99"),
        (&right_one[..10], "the image is cut short"),
        (b"[controller]", "the image is cut short"),
        (b"[controller] and more", "not a configuration image"),
        (b"", "the image is cut short"),
        (&nonsense, "does not contain a configuration"),
        (&three, "this board has 2 RS-485 ports"),
    ] {
        let refused = put(wrong, &right).must_be(422);
        assert!(refused.text().contains(why), "{}", refused.text());
    }
    put(&right_one, "Content-Type: application/octet-stream").must_be(428);
    put(&right_one, "Content-Type: application/octet-stream\nIf-Match: *").must_be(412);
    let changed =
        put(&right_one, "Content-Type: application/octet-stream\nIf-Match: \"9-00000000\"").must_be(412);
    assert_eq!(changed.field("ETag"), Some(&*base));
    put(&right_one, &format!("Content-Type: application/toml\nIf-Match: {base}")).must_be(415);
    put(&[0; 16385], &right).must_be(413);
    assert_eq!(board.revisions()["kept"].as_array().unwrap().len(), 1);
    // The longest that is taken at all.
    let mut padded = right_one;
    padded.resize(16384, 0xFF);
    put(&padded, &right).must_be(201);
    assert_eq!(board.revisions()["waiting"], 2);
}
