#!/usr/bin/env bash
# Fuzzes each target, guided by coverage, and stops at the first finding.
#
#   fuzz/run.sh [SECONDS [TARGET...]]
#
# 600 s each by default. It needs a nightly compiler (`rustup toolchain install nightly`) and cargo-fuzz
# (`cargo install --locked cargo-fuzz`). What is found is kept in fuzz/artifacts, what was learned in fuzz/corpus.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
seconds=${1:-600}
shift || true
targets=("$@")
((${#targets[@]})) || targets=(config manifest mot url tracker api)

# Memory is Rust's; the sanitizer would triple the time. ONNX Runtime and GStreamer are not fuzzed here.
cargo +nightly fuzz build --sanitizer none
host=$(rustc +nightly --version --verbose | sed -n 's/^host: //p')
built=${CARGO_TARGET_DIR:-target}/$host/release
for target in "${targets[@]}"; do
    mkdir -p "corpus/$target" "artifacts/$target"
    "$built/seeds" "$target" "corpus/$target"
    echo "==> $target, $seconds s"
    # Inputs of any length from the start: a request is longer than four bytes.
    "$built/$target" "-max_total_time=$seconds" -max_len=4096 -len_control=0 -timeout=20 -print_final_stats=1 \
        "-artifact_prefix=artifacts/$target/" "corpus/$target" 2>&1 |
        grep -Ev '^#[0-9]+[[:space:]]+(NEW|REDUCE|pulse|RELOAD)|NEW_FUNC|^"|WARNING: Failed to find' || {
        echo "$target: found something, see above; the input is in fuzz/artifacts/$target" >&2
        exit 1
    }
done
echo "nothing found in $seconds s each of: ${targets[*]}"
