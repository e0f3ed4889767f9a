#!/usr/bin/env bash
# Draws a line and a zone into the demo's camera. In bash alone: the image has no curl.
#
#   draw.sh [HOST [PORT [CAMERA [TOKEN-FILE]]]]
set -euo pipefail
host=${1:-gakp} port=${2:-8080} camera=${3:-demo} token=$(<"${4:-/run/token/gakp.token}")

post() {
    local line
    exec 3<>"/dev/tcp/$host/$port"
    printf 'POST %s HTTP/1.0\r\nHost: %s\r\nAuthorization: Bearer %s\r\n' "$1" "$host" "$token" >&3
    printf 'Content-Type: application/json\r\nContent-Length: %d\r\n\r\n%s' "${#2}" "$2" >&3
    read -r line <&3
    exec 3>&-
    echo "$1: $line"
    # 409: it is there already, from the time before.
    [[ $line == *' 201 '* || $line == *' 409 '* ]]
}

post "/v1/cameras/$camera/lines" '{"id": "door", "points": [[0.5, 0], [0.5, 1]]}'
post "/v1/cameras/$camera/zones" '{"id": "floor", "points": [[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]}'
