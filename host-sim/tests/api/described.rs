//! docs/api/openapi.json is what the server does: every path and method of the table of routes, and every
//! answer as its schema says.

use recipe_api::request::Method;
use recipe_api::route::{Access, BodyType, ROUTES, Route, Served};
use recipe_test_kit::repository;
use serde_json::{Value, json};

use crate::kit::*;
use crate::live::{frames_of, send_frame};

fn description() -> Value {
    let text = std::fs::read_to_string(repository().join("docs/api/openapi.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// The value behind `$ref`, or the value itself.
fn resolved<'a>(root: &'a Value, value: &'a Value) -> &'a Value {
    match value["$ref"].as_str() {
        Some(path) => root.pointer(path.strip_prefix('#').unwrap()).unwrap_or_else(|| panic!("{path}")),
        None => value,
    }
}

/// Checks a value by what of JSON Schema the description uses, and that it uses nothing else.
fn check(root: &Value, schema: &Value, value: &Value, place: &str) -> Result<(), String> {
    let schema = resolved(root, schema);
    let known = ["type", "properties", "required", "additionalProperties", "items", "enum", "description"];
    for key in schema.as_object().unwrap().keys() {
        assert!(known.contains(&key.as_str()), "{place}: this test does not know {key}");
    }
    let is_right = match schema["type"].as_str() {
        Some("object") => value.is_object(),
        Some("array") => value.is_array(),
        Some("string") => value.is_string(),
        Some("boolean") => value.is_boolean(),
        Some("integer") => value.is_i64() || value.is_u64(),
        Some("number") => value.is_number(),
        None => true,
        Some(other) => panic!("{place}: {other}"),
    };
    if !is_right || schema.get("enum").is_some_and(|allowed| !allowed.as_array().unwrap().contains(value)) {
        return Err(format!("{place}: {value} is not {schema}"));
    }
    for name in schema["required"].as_array().into_iter().flatten() {
        if value.get(name.as_str().unwrap()).is_none() {
            return Err(format!("{place}: {name} is missing in {value}"));
        }
    }
    for (name, inner) in value.as_object().into_iter().flatten() {
        match (schema["properties"].get(name), schema.get("additionalProperties")) {
            (Some(schema), _) => check(root, schema, inner, &format!("{place}.{name}"))?,
            (None, Some(Value::Bool(true)) | None) if schema["type"] != "object" => {}
            (None, Some(Value::Bool(true))) => {}
            (None, Some(schema @ Value::Object(_))) => {
                check(root, schema, inner, &format!("{place}.{name}"))?
            }
            (None, _) => return Err(format!("{place}: {name} is not described")),
        }
    }
    for (nth, inner) in value.as_array().into_iter().flatten().enumerate() {
        check(root, &schema["items"], inner, &format!("{place}[{nth}]"))?;
    }
    Ok(())
}

/// What a host serves; the board's own are in docs/api.md section 8.
fn routes() -> impl Iterator<Item = &'static Route> {
    let is_of_host = |route: &&Route| route.served.iter().any(|served| *served != Served::Board);
    ROUTES.iter().filter(is_of_host)
}

fn method_of(method: Method) -> String {
    method.name().to_lowercase()
}

#[test]
fn every_route_is_described_and_nothing_else() {
    let description = description();
    let mut described: Vec<(String, String)> = Vec::new();
    for (path, methods) in description["paths"].as_object().unwrap() {
        for (method, operation) in methods.as_object().unwrap() {
            described.push((path.clone(), method.clone()));
            let route = routes().find(|route| route.path == path && method_of(route.method) == *method);
            let route = route.unwrap_or_else(|| panic!("{method} {path} is not served"));
            let needs_key = operation["security"] != json!([]);
            assert_eq!(needs_key, route.access != Access::Open, "{method} {path}");
            let body = operation["requestBody"]["content"].as_object();
            let types: Vec<_> = body.into_iter().flatten().map(|(name, _)| name.as_str()).collect();
            let expected = if route.body == BodyType::None { vec![] } else { vec![route.body.name()] };
            assert_eq!(types, expected, "{method} {path}");
        }
    }
    for route in routes() {
        let pair = (route.path.to_owned(), method_of(route.method));
        assert!(described.contains(&pair), "{pair:?} is not described");
    }
}

/// The answer is one that the description knows.
#[track_caller]
fn is_described(description: &Value, path: &str, method: &str, answer: &Response) {
    let place = format!("{method} {path}: {}", answer.status);
    let answers = &description["paths"][path][method]["responses"];
    let described = answers.get(answer.status.to_string()).or_else(|| answers.get("default"));
    let described = resolved(description, described.unwrap_or_else(|| panic!("{place} is not described")));
    let kind = answer.field("Content-Type").unwrap();
    let kind = kind.split(';').next().unwrap();
    let contents = described["content"].as_object().unwrap_or_else(|| panic!("{place}: nothing described"));
    let content = contents.get(kind).unwrap_or_else(|| panic!("{place}: {kind} is not described"));
    if kind == "application/json" {
        check(description, &content["schema"], &answer.json(), &place).unwrap();
    }
}

#[test]
fn every_answer_is_as_described() {
    let description = description();
    let cell = Cell::new();
    let mut panel = cell.panel();
    std::io::Write::write_all(&mut panel, &frame(5)).unwrap();
    cell.outputs_are(5);
    let mut seen = Vec::new();
    let mut look = |path: &str, method: &str, answer: Response| {
        is_described(&description, path, method, &answer);
        seen.push((path.to_owned(), method.to_owned()));
        answer
    };
    for route in routes().filter(|route| route.method == Method::Get && !route.operation.is_endless()) {
        look(route.path, "get", request(cell.console, &format!("GET {}", route.path), "", ""));
    }
    look("/api/v1/config", "get", get(cell.console, "config?revision=9").must_be(404));
    let toml = "Content-Type: application/toml";
    for text in [config(100), "wrong".to_owned()] {
        look("/api/v1/check", "post", request(cell.console, "POST /api/v1/check", toml, &text).must_be(200));
    }
    look("/api/v1/config", "put", put(cell.console, &cell.base(), &config(400)).must_be(201));
    look("/api/v1/config", "put", put(cell.console, "\"9-00000000\"", &config(400)).must_be(412));
    look("/api/v1/config", "put", put(cell.console, &cell.base(), "wrong").must_be(422));
    look("/api/v1/apply", "post", post(cell.console, "apply", "").must_be(200));
    look("/api/v1/apply", "post", post(cell.console, "apply", "").must_be(409));
    look("/api/v1/revisions", "get", get(cell.console, "revisions"));
    look("/api/v1/confirm", "post", post(cell.console, "confirm", "").must_be(200));
    look("/api/v1/confirm", "post", post(cell.console, "confirm", "{").must_be(400));
    look("/api/v1/rollback", "post", post(cell.console, "rollback", "").must_be(200));
    look("/api/v1/rollback", "post", request(cell.console, "POST /api/v1/rollback", "", "").must_be(401));
    look("/api/v1/identify", "post", post(cell.console, "identify", "").must_be(200));
    look("/api/v1/identify", "post", post(cell.console, "identify", r#"{"s": 0}"#).must_be(400));
    let octets = format!("Authorization: Bearer {KEY}\nContent-Type: application/octet-stream");
    let piece = request(cell.console, "PUT /api/v1/update?offset=0", &octets, "x");
    look("/api/v1/update", "put", piece.must_be(501));
    look("/api/v1/edge", "get", get(cell.console, "edge").must_be(501));
    look("/api/v1/edge", "put", request(cell.console, "PUT /api/v1/edge", &octets, "x").must_be(501));
    for operation in ["update/try", "update/confirm", "update/back"] {
        look(&format!("/api/v1/{operation}"), "post", post(cell.console, operation, "").must_be(501));
    }
    look("/api/v1/log", "get", get(cell.console, "log?lines=0").must_be(400));
    look("/api/v1/export/dbc", "get", get(cell.console, "export/dbc?port=none").must_be(404));
    // The panel's connection stays over all that.
    let event = frames_of(&cell, "", |frame| frame["port"] == "device", || send_frame(&mut panel));
    let schema = json!({ "$ref": "#/components/schemas/Frames" });
    check(&description, &schema, &event, "frames").unwrap();
    let robot = cell.folder.path().join("robot.toml");
    let key = cell.folder.path().join("key").display().to_string();
    let robot = BINARY.controller(&robot, &["--console", "127.0.0.1:0", "--console-key", &key]);
    let console = robot.at("console");
    look("/api/v1/pendant", "post", post(console, "pendant", r#"{"do": "state"}"#).must_be(200));
    look("/api/v1/pendant", "post", post(console, "pendant", r#"{"do": "x"}"#).must_be(422));
    look("/api/v1/status", "get", get(console, "status").must_be(200));
    look("/api/v1/log", "get", get(console, "log").must_be(200));
    look("/api/v1/bundle", "get", get(console, "bundle").must_be(200));
    for route in routes().filter(|route| !route.operation.is_endless()) {
        let pair = (route.path.to_owned(), method_of(route.method));
        assert!(seen.contains(&pair), "{pair:?} was not tried");
    }
}

#[test]
fn a_wrong_answer_is_noticed() {
    let description = description();
    let schema = json!({ "$ref": "#/components/schemas/Nonce" });
    let right = json!({ "nonce": "00", "scheme": "x", "max_age_s": 30 });
    check(&description, &schema, &right, "").unwrap();
    for (key, value) in [("nonce", json!(1)), ("max_age_s", json!("30")), ("more", json!(1))] {
        let mut wrong = right.clone();
        wrong[key] = value;
        assert!(check(&description, &schema, &wrong, "").is_err(), "{wrong}");
    }
    assert!(check(&description, &schema, &json!({ "nonce": "00" }), "").is_err());
}
