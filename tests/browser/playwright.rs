//! Runs a file of the page's Playwright tests (`web/tests`) in Debian's Chromium.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const CHROMIUM: &str = "/usr/bin/chromium";

fn web() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("web")
}

fn runner() -> PathBuf {
    web().join("node_modules/@playwright/test/cli.js")
}

/// Whether there is all that the tests need; said loudly when not. Where the environment has `CI` that is a
/// failure.
pub fn ready() -> bool {
    let page = option_env!("GAKP_PAGE").is_some();
    let missing = [
        (Path::new(CHROMIUM).exists(), "Chromium is missing", "test-packages"),
        (runner().exists(), "the page's npm packages are missing", "page"),
        (page, "these tests were compiled before the page was built", "page"),
    ];
    let Some((_, what, part)) = missing.into_iter().find(|(there, ..)| !there) else { return true };
    assert!(std::env::var_os("CI").is_none(), "{what}; CI must have it");
    eprintln!("SKIPPED: {what}: run `bash deploy/setup.sh {part}`");
    false
}

/// Runs the tests in `web/tests/{name}.spec.ts`, which must pass. Blocks. Its pictures of the page are kept for people to
/// look at.
#[track_caller]
pub fn run(name: &str, url: &str, settings: &[(&str, &str)]) {
    let pictures = Path::new(env!("CARGO_TARGET_TMPDIR")).join("page").join(name);
    std::fs::create_dir_all(&pictures).unwrap();
    let output = Command::new("node")
        .arg(runner())
        .args(["test", &format!("tests/{name}.spec.ts")])
        .current_dir(web())
        .env("GAKP_URL", url)
        .env("GAKP_CHROMIUM", CHROMIUM)
        .env("GAKP_PICTURES", &pictures)
        .env("PLAYWRIGHT_SKIP_BROWSER_DOWNLOAD", "1")
        .envs(settings.iter().copied())
        .stdin(Stdio::null())
        .output()
        .expect("node starts");
    let said = String::from_utf8_lossy(&output.stdout);
    eprintln!("{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "web/tests/{name}.spec.ts fails; pictures in {}", pictures.display());
    eprintln!("pictures of the page: {}", pictures.display());
}
