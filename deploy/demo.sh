#!/usr/bin/env bash
# Sets gakp up and shows it at work: a test camera that plays a film over RTSP, the service that
# tracks it, and a web page. Ctrl-C ends it.
#
#   deploy/demo.sh            runs until it is interrupted
#   deploy/demo.sh --check    ends with exit code 0 as soon as tracks flow, 1 when they do not
#
#   GAKP_PORT=8080        port of the page and the API
#   GAKP_RTSP_PORT=8554   port of the test camera
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

PORT=${GAKP_PORT:-8080}
RTSP_PORT=${GAKP_RTSP_PORT:-8554}
GAKP=${CARGO_TARGET_DIR:-target}/release/gakp
START_SECONDS=60
LOGS=
CAMERA=
SERVICE=

fail() {
    echo "demo: $*" >&2
    exit 1
}

# The service drains within 5 s of SIGTERM; a second signal would cut that short, so each gets one.
end() {
    local status=$? pid
    trap - EXIT
    trap '' INT TERM
    for pid in $SERVICE $CAMERA; do
        kill -TERM "$pid" 2>/dev/null || true
        for _ in {1..70}; do
            kill -0 "$pid" 2>/dev/null || break
            sleep 0.1
        done
        if kill -KILL "$pid" 2>/dev/null; then
            echo "demo: process $pid did not end within 7 s and was killed" >&2
        fi
    done
    rm -rf "$LOGS"
    exit "$status"
}

need_free() {
    if (exec 3<>"/dev/tcp/127.0.0.1/$1") 2>/dev/null; then
        fail "port $1 is taken. Choose another: $2=$(($1 + 10000)) bash deploy/demo.sh"
    fi
}

# running NAME PID: ends the demo with the end of the log when the process is gone.
running() {
    if ! kill -0 "$2" 2>/dev/null; then
        echo "demo: the $1 has ended:" >&2
        tail -n 20 "$LOGS/$1" >&2
        exit 1
    fi
}

# wait_for WHAT COMMAND...: until the command succeeds.
wait_for() {
    local what=$1 deadline=$((SECONDS + START_SECONDS))
    shift
    until "$@"; do
        running camera "$CAMERA"
        running service "$SERVICE"
        if [ $SECONDS -ge $deadline ]; then
            tail -n 20 "$LOGS"/* >&2
            fail "$what within $START_SECONDS s: no"
        fi
        sleep 0.2
    done
}

camera_listens() {
    (exec 3<>"/dev/tcp/127.0.0.1/$RTSP_PORT") 2>/dev/null
}

service_ready() {
    curl -fsS -o /dev/null "http://127.0.0.1:$PORT/readyz" 2>/dev/null
}

tracks_flow() {
    curl -fsS "http://127.0.0.1:$PORT/v1/cameras/demo" 2>/dev/null | python3 -c '
import json, sys
camera = json.load(sys.stdin)
sys.exit(camera["tracked"] == 0 or camera["tracks"]["confirmed"] == 0)' 2>/dev/null
}

case ${1:-} in
    "" | --check) ;;
    *)
        sed -n '2,/^set -e/{/^#/s/^# \{0,1\}//p}' "$0"
        exit 2
        ;;
esac
need_free "$PORT" GAKP_PORT
need_free "$RTSP_PORT" GAKP_RTSP_PORT
bash deploy/setup.sh

LOGS=$(mktemp -d)
trap end EXIT
trap 'exit 130' INT
trap 'exit 143' TERM
# In sessions of their own: Ctrl-C reaches this script alone, which then ends them in order.
setsid "$GAKP" camera models/cache/vtest.avi --listen "127.0.0.1:$RTSP_PORT" >"$LOGS/camera" 2>&1 </dev/null &
CAMERA=$!
setsid "$GAKP" serve --listen "127.0.0.1:$PORT" --camera "demo=rtsp://127.0.0.1:$RTSP_PORT/live" \
    >"$LOGS/service" 2>&1 </dev/null &
SERVICE=$!
wait_for "the test camera listens" camera_listens
wait_for "the service is ready" service_ready
wait_for "tracks flow" tracks_flow
echo "tracks are flowing"
[ "${1:-}" != --check ] || exit 0

cat <<END

  page        http://127.0.0.1:$PORT/
  tracks      ws://127.0.0.1:$PORT/v1/tracks?camera=demo   (a JSON message a frame)
  camera      rtsp://127.0.0.1:$RTSP_PORT/live
  add yours   curl -X POST http://127.0.0.1:$PORT/v1/cameras -H 'content-type: application/json' \\
                -d '{"id": "gate", "url": "rtsp://user:password@192.0.2.1/stream"}'
  log         tail -f $LOGS/service

Ctrl-C ends the demo.
END
while true; do
    running camera "$CAMERA"
    running service "$SERVICE"
    sleep 1 &
    wait $!
done
