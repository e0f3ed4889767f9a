//! Nothing that the service says holds a password, a token or another secret. `tests/soak/soak.py` does it for an hour.

use std::path::Path;
use std::process::Command;

use super::support::*;

#[test]
fn no_secret_is_told() {
    let (Some(film), Some(_)) = (film(), models()) else { return };
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join(".venv-tests/bin/python");
    if !needed(&python, "test-packages") || !needed("/usr/bin/mosquitto_sub", "test-packages") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let output = Command::new(python)
        .arg(root.join("tests/soak/soak.py"))
        .args(["--gakp", env!("CARGO_BIN_EXE_gakp"), "--seconds", "10", "--film"])
        .arg(film)
        .arg("--folder")
        .arg(folder.path())
        .current_dir(root)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    println!("{said}");
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("found 0 times"), "{said}");
}
