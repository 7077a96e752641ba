"""Process of ROS 1 code: ``python ros1_peer.py CODE``."""

import sys

exec(compile(sys.argv.pop(), "<peer>", "exec"))
