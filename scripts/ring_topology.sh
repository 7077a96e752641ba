#!/usr/bin/env bash
# Demonstration ring: sends a recording, or messages of real ROS nodes, through five name-routed switches.
#
#   sudo scripts/ring_topology.sh                  a generated robot drive
#   sudo scripts/ring_topology.sh my.bag           a recording of your own
#   sudo scripts/ring_topology.sh --live           ROS 2 nodes at both ends; installs ROS 2 for itself where there is none
#   sudo scripts/ring_topology.sh --live mixed     ROS 1 at the robot, ROS 2 at the server
#   scripts/ring_topology.sh --help                all options; works without sudo where user namespaces are allowed
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=$root/.venv/bin/python
has_ros1='import os; from proxy.endpoints.ros1.install import rospy_folder; os.stat(rospy_folder() + "/rosmaster")'

case " $* " in
    *" --live ros1 "* | *" --live=ros1 "*) ros=(1) ;;
    *" --live mixed "* | *" --live=mixed "*) ros=(1 2) ;;
    *" --live "* | *" --live=ros2 "*) ros=(2) ;;
    *) ros=() ;;
esac
if [[ " ${ros[*]-} " == *" 2 "* && -z "${AMENT_PREFIX_PATH-}" ]]; then  # a sourced ROS 2 stays in use
    "$root/scripts/setup.sh" --quiet --ros2
else
    "$root/scripts/setup.sh" --quiet
fi
if [[ " ${ros[*]-} " == *" 1 "* ]] && ! (cd "$root" && "$python" -c "$has_ros1" 2>/dev/null); then
    "$root/scripts/setup_ros1.sh"
fi
exec "$root/scripts/privileged.sh" "$python" -m ring "$@"
