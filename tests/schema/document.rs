//! The document by itself, and against the table of routes.

use std::collections::{BTreeMap, BTreeSet};

use gakp::api::RIGHTS;
use gakp::auth::{Right, Role};
use serde_json::{Value, json};

use super::tools::*;

const METHODS: [&str; 8] = ["get", "put", "post", "delete", "options", "head", "patch", "trace"];

/// Every operation, by method and path.
fn operations(document: &Value) -> BTreeMap<(String, String), &Value> {
    let mut found = BTreeMap::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (key, operation) in item.as_object().unwrap() {
            if METHODS.contains(&key.as_str()) {
                found.insert((key.to_uppercase(), path.clone()), operation);
            } else {
                assert_eq!(key, "parameters", "{path}");
            }
        }
    }
    found
}

#[test]
fn every_route_is_described_and_nothing_else() {
    let document = document();
    let operations = operations(&document);
    let described: BTreeSet<_> = operations.keys().cloned().collect();
    let routes: BTreeSet<_> = RIGHTS.iter().map(|(m, p, _)| (m.to_string(), p.to_string())).collect();
    assert_eq!(described, routes);
    assert_eq!(routes.len(), RIGHTS.len());
    let mut names = BTreeSet::new();
    for (method, path, right) in RIGHTS {
        let operation = operations[&(method.to_owned(), path.to_owned())];
        let what = format!("{method} {path}");
        let needs = match right {
            Right::Nobody => None,
            Right::Role(Role::Viewer) => Some("viewer"),
            Right::Role(Role::Operator) => Some("operator"),
            Right::Role(Role::Admin) => Some("admin"),
            Right::Video => Some("video"),
        };
        let security = needs.map_or(json!([]), |it| json!([{"bearer": [it]}, {"session": [it]}]));
        assert_eq!(operation["security"], security, "{what}");
        let responses = operation["responses"].as_object().unwrap();
        if needs.is_some() {
            assert!(responses.contains_key("401") && responses.contains_key("403"), "{what}");
        }
        // Whatever has a body may be sent too much of it, or none that is JSON.
        let body = operation.get("requestBody").is_some();
        for status in ["413", "415"] {
            assert_eq!(responses.contains_key(status), body, "{what} {status}");
        }
        for text in ["operationId", "summary"] {
            assert!(operation[text].as_str().is_some_and(|text| !text.is_empty()), "{what} {text}");
        }
        assert!(names.insert(operation["operationId"].as_str().unwrap()), "{what}: its id is not unique");
        // The path's names are its parameters.
        let item = &document["paths"][path];
        let lists = [item.get("parameters"), operation.get("parameters")];
        let parameters: BTreeSet<_> = lists
            .into_iter()
            .flatten()
            .flat_map(|list| list.as_array().unwrap())
            .map(|parameter| match parameter["$ref"].as_str() {
                Some(pointer) => document.pointer(pointer.trim_start_matches('#')).unwrap(),
                None => parameter,
            })
            .filter(|parameter| parameter["in"] == "path")
            .map(|parameter| parameter["name"].as_str().unwrap())
            .collect();
        let named: BTreeSet<_> = path.split(['{', '}']).skip(1).step_by(2).collect();
        assert_eq!(parameters, named, "{what}");
    }
    assert_eq!(document["info"]["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(document["openapi"], "3.1.0");
}

#[test]
fn the_document_is_valid_and_so_are_its_examples() {
    assert_eq!(mistakes(&document(), &json!([])), "");
    let mut broken = document();
    broken["components"]["schemas"]["Gap"]["example"]["camera"] = json!("no name");
    broken["paths"]["/healthz"]["get"]["responses"] = json!({});
    let said = mistakes(&broken, &json!([]));
    assert!(said.contains("example at /components/schemas/Gap"), "{said}");
    assert!(said.contains("/healthz"), "{said}");
}
