"""The ROS side: endpoints that speak one dialect each, serialisation that speaks none, and the bridge between them.

Place: above ``gdp``, which knows nothing of it. ``proxy.serial`` thinks; ``proxy.endpoints`` does I/O.
"""

from gdp.extras import require_extra

require_extra("proxy", ("apsw", "lz4", "numpy", "pybase64", "rich", "rosbags"), "proxy")
