//! The document, and the Python tools that judge it.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

/// The document as it is in the repository.
pub fn document() -> Value {
    serde_json::from_str(include_str!("../../src/api/openapi.json")).unwrap()
}

/// The document with every object closed: within version 1 fields are only added, so clients must expect more than
/// it names; what the service sends now is all named.
pub fn closed() -> Value {
    let mut document = document();
    close(&mut document["components"]["schemas"]);
    document
}

fn close(node: &mut Value) {
    match node {
        Value::Object(map) => {
            map.values_mut().for_each(close);
            let object =
                map.get("type").is_some_and(|kind| kind == "object") && map.contains_key("properties");
            if object && !map.contains_key("additionalProperties") {
                map.insert("unevaluatedProperties".into(), json!(false));
            }
        }
        Value::Array(list) => list.iter_mut().for_each(close),
        _ => {}
    }
}

/// A program of the tests' own Python environment.
pub fn tool(name: &str) -> PathBuf {
    let tool = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv-tests/bin").join(name);
    assert!(tool.exists(), "{} is missing: run `bash deploy/setup.sh test-packages`", tool.display());
    tool
}

/// Runs a tool in `folder`; what it printed, and whether it ended well. One that takes too long is killed.
pub fn run(command: &mut Command, folder: &Path, input: &str, limit: Duration) -> (bool, String) {
    let output = folder.join("output.txt");
    let file = File::create(&output).unwrap();
    let mut child = command
        .current_dir(folder)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .env("NO_PROXY", "*")
        .stdin(Stdio::piped())
        .stdout(file.try_clone().unwrap())
        .stderr(file)
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let since = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if since.elapsed() > limit {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("{command:?} took too long:\n{}", std::fs::read_to_string(output).unwrap());
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    (status.success(), String::from_utf8_lossy(&std::fs::read(output).unwrap()).into_owned())
}

/// What is wrong with a document, the examples in it and messages, each `{schema, message, valid}`.
pub fn mistakes(document: &Value, messages: &Value) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("openapi.json");
    std::fs::write(&path, document.to_string()).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/schema/check.py");
    let mut command = Command::new(tool("python"));
    let (well, said) =
        run(command.arg(script).arg(path), folder.path(), &messages.to_string(), Duration::from_secs(60));
    assert_eq!(well, said.is_empty(), "{said}");
    said
}
