"""``FogCluster`` of a launch file: nodes that run on every machine of a cluster.

I/O only through ``unreturned``, which records each cluster; ``ros_action`` derives an action of ROS 2's ``launch``.
Source: FogROS2-FT, Listing 1.
"""

from __future__ import annotations

from dataclasses import dataclass

from fog.launch.cluster_spec import ClusterKeywords, ClusterSpec
from fog.launch.unreturned import record


@dataclass(eq=False, repr=False, kw_only=True)
class FogCluster(ClusterKeywords):
    """Nodes on machines; each machine is a replica of all nodes. ``ClusterKeywords`` has its arguments.

    Constructing it in a launch file is enough; the launch description need not contain it.

    Raises:
        LocalError: an argument is wrong; the text names it and what was expected.
    """

    def __post_init__(self) -> None:
        """Check the keywords, and record the cluster."""
        self.cloud_nodes = tuple(self.cloud_nodes)
        self.cluster_spec = ClusterSpec.checked(self)
        record(self)
