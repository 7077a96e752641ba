#!/usr/bin/env bash
# Installs what the ros1 endpoint needs from Debian or Ubuntu: rospy, a master, the usual messages. About 15 MB.
#
#   sudo scripts/setup_ros1.sh
#
# Does nothing where all of it is installed. A robot with a ROS 1 of its own does not need it.
set -euo pipefail

packages=(
    python3-rospy python3-roslaunch python3-rosmaster python3-rostopic python3-rosservice python3-rosnode python3-rosbag
    python3-std-msgs python3-sensor-msgs python3-std-srvs python3-tf2-msgs python3-geometry-msgs python3-nav-msgs
    python3-rosgraph-msgs
)

say() { printf 'setup_ros1: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

missing=()
for package in "${packages[@]}"; do
    state=$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null || true)
    [[ $state == installed ]] || missing+=("$package")
done
if [[ ${#missing[@]} -eq 0 ]]; then
    say "ROS 1 is ready: all ${#packages[@]} packages are installed"
    exit 0
fi

command -v apt-get >/dev/null || fail "there is no apt-get here: source a ROS 1 of your own, and the proxy uses that"
[[ $(id -u) -eq 0 ]] || fail "${#missing[@]} packages are missing: run it again as 'sudo scripts/setup_ros1.sh'"
log=$(mktemp)
trap 'rm -f "$log"' EXIT
install=(env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "${missing[@]}")
if ! "${install[@]}" >"$log" 2>&1 && ! { apt-get update >"$log" 2>&1 && "${install[@]}" >"$log" 2>&1; }; then
    tail -n 20 "$log" >&2
    fail "apt-get could not install them: this release may have no ROS 1; the proxy also uses one that you source"
fi
say "ROS 1 is ready: installed ${#missing[@]} of ${#packages[@]} packages"
