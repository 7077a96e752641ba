#!/usr/bin/env bash
# Demonstration across an internet: a robot behind NATs, two clouds and an edge box on IPv6 only join by tokens. Images
# and calls cross while addresses change, NATs forget and an uplink is cut. The last line states how many were lost.
#
#   sudo scripts/internet_demo.sh                       about a minute
#   sudo scripts/internet_demo.sh --json > out.json     the outcome for programs; progress goes to standard error
#   scripts/internet_demo.sh --help                     all options
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

"$root/scripts/setup.sh" --quiet
exec "$root/scripts/privileged.sh" "$root/.venv/bin/python" -m internet_demo "$@"
