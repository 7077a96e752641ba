#!/usr/bin/env bash
# Sets everything up and sends a recording through a ring of five name-routed switches.
#
#   sudo scripts/ring_topology.sh                  a generated robot drive
#   sudo scripts/ring_topology.sh my.bag           a recording of your own
#   scripts/ring_topology.sh --help                all options; works without sudo where user namespaces are allowed
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
"$root/scripts/setup.sh"
exec "$root/scripts/privileged.sh" "$root/.venv/bin/python" -m proxy.ring "$@"
