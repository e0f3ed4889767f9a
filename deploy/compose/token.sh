#!/usr/bin/env bash
# Makes up the demo's token, once, and says how to sign in with it.
#
#   token.sh [FOLDER]
set -euo pipefail
file=${1:-/run/token}/gakp.token
# Whoever is in the demo may read it: each of its services has a user of its own.
umask 022
[ -s "$file" ] || head -c 32 /dev/urandom | od -An -v -tx1 | tr -d ' \n' >"$file"
echo "http://127.0.0.1:8080/ asks for a token: $(<"$file")"
