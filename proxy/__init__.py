"""ROS side of the overlay: one endpoint per dialect, serialisation without dialects, and the bridge between them.

Depends on ``gdp``, which does not import it. ``proxy.serial`` is sans-I/O; ``proxy.endpoints`` is I/O.
"""

from gdp.extras import require_extra

require_extra("proxy", ("apsw", "lz4", "numpy", "pybase64", "rich", "rosbags"), "proxy")
