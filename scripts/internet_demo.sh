#!/usr/bin/env bash
# Demonstration across an internet: a robot behind NATs, two clouds and an edge box on IPv6 only join by tokens. Images
# and calls cross while addresses change, NATs forget and an uplink is cut. The last line states how many were lost.
#
#   sudo scripts/internet_demo.sh                       about a minute
#   sudo scripts/internet_demo.sh --json > out.json     the outcome for programs; progress goes to standard error
#   sudo scripts/internet_demo.sh --figure1             Figure 1 of FogROS G: installs ROS 2 and ROS 1 where they are missing
#   scripts/internet_demo.sh --help                     all options
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

need=()
if [[ " $* " == *" --figure1 "* ]]; then
    [[ -n "${AMENT_PREFIX_PATH-}" ]] || need=(--ros2) # a sourced ROS 2 stays in use
    [[ -n "${ROS_MASTER_URI-}" ]] || "$root/scripts/setup_ros1.sh" || exit 2
fi
"$root/scripts/setup.sh" --quiet "${need[@]}"
exec "$root/scripts/privileged.sh" "$root/.venv/bin/python" -m internet_demo "$@"
