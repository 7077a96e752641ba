#!/usr/bin/env bash
# Demonstration of a robot's memory: its uplink is gone half the time, somebody presses the emergency stop, and the
# holder at nuc3 has what stood around it, which it cannot read. The window is written as an MCAP.
#
#   sudo scripts/memory_demo.sh                       about a minute; writes incident.mcap
#   sudo scripts/memory_demo.sh --json > out.json     the outcome for programs; progress goes to standard error
#   scripts/memory_demo.sh --help                     all options; works without sudo where user namespaces are allowed
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

"$root/scripts/setup.sh" --quiet
exec "$root/scripts/privileged.sh" "$root/.venv/bin/python" -m memory_demo "$@"
