#!/usr/bin/env bash
# Demonstration of one tree of transforms: two robots whose frames have equal names, one station, one picture.
#
#   sudo scripts/fleet_demo.sh            about a minute; writes fleet.png
#   scripts/fleet_demo.sh --help          all options; works without sudo where user namespaces are allowed
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

"$root/scripts/setup.sh" --quiet
exec "$root/scripts/privileged.sh" "$root/.venv/bin/python" -m fleet_demo "$@"
