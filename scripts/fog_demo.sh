#!/usr/bin/env bash
# Demonstration of a service that outlives its machines: a robot, two spot machines, one preempted, the other
# killed, each replaced while requests flow. The last line states how many requests failed.
#
#   sudo scripts/fog_demo.sh                       about a minute
#   sudo scripts/fog_demo.sh --json > out.json     the outcome for programs; progress goes to standard error
#   scripts/fog_demo.sh --help                     all options; works without sudo where user namespaces are allowed
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

if [[ -z "${AMENT_PREFIX_PATH-}" ]]; then  # a sourced ROS 2 stays in use
    "$root/scripts/setup.sh" --quiet --ros2
else
    "$root/scripts/setup.sh" --quiet
fi
exec "$root/scripts/privileged.sh" "$root/.venv/bin/python" -m fog_demo "$root/examples/echo.launch.py" "$@"
