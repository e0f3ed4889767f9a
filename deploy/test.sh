#!/usr/bin/env bash
# Sets up what the tests need and runs all of them: formatting, lints, documentation, tests of every feature, tests
# of the pure core alone, and the dependency policy where cargo-deny is installed.
#
#   deploy/test.sh
#
#   GAKP_SHARED=DIR   MOTChallenge data for the tests that want it; without it they say so and skip
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

run() {
    local started=$SECONDS
    echo "==> $*"
    "$@"
    echo "<== $* ($((SECONDS - started)) s)"
}

bash deploy/setup.sh rust packages test-packages models footage page
# Nothing here is built twice, so what a second build would want is not kept.
export CARGO_INCREMENTAL=0
run npm --prefix web run check
run cargo fmt --check
run cargo clippy --locked --all-targets --features learn -- -D warnings
run env RUSTDOCFLAGS="-D warnings" cargo doc --no-deps --locked --features learn
run cargo test --locked --features learn
# Last: it shares the dependencies that are built by now. Without GStreamer and ONNX Runtime it
# would build just the same.
run cargo test --locked --no-default-features
if cargo deny --version >/dev/null 2>&1; then
    run cargo deny --all-features check bans licenses sources
    # The advisories are a repository of their own, which not every machine reaches.
    if cargo deny --log-level off fetch db; then
        run cargo deny --all-features check advisories
    else
        echo "SKIPPED: advisories about dependencies; their database cannot be fetched from here"
    fi
else
    echo "SKIPPED: the dependency policy (deny.toml); 'cargo install --locked cargo-deny' adds the tool"
fi
echo "all tests passed in $SECONDS s"
