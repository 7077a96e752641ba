"""``FogCluster`` of a launch file: nodes that run on every machine of a cluster.

I/O only through ``unreturned``, which records each cluster; ``ros_action`` derives an action of ROS 2's ``launch``.
Source: FogROS2-FT, Listing 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fog.launch.cluster_spec import ClusterSpec
from fog.launch.interfaces import Offered, SomeReplication
from fog.launch.machines import CloudMachine
from fog.launch.unreturned import record

__all__ = ["FogCluster"]


class FogCluster:
    """Nodes on machines; each machine is a replica of all nodes.

    Constructing it in a launch file is enough; the launch description need not contain it.

    Args:
        cloud_nodes: list of ``Node``.
        deployments: one machine for each replica.
        name: of the cluster, for ``fog scale NAME``; empty: the first node's executable.
        replicas: at least this many machines, in different regions; None: 2, or as many as ``deployments`` has.
        services, actions, topics: full name to type of what the nodes offer; without any, services and actions are
            discovered.
        replication: ``"all"``, ``"some"`` or ``"hedged"``, or the rule's map; None: ``"all"``.
        timeout_s: time limit of a response; None: the proxy's 5 s.
        idle: time without a call (seconds, or ``"30min"``) after which the machines are released; None: the site's.
        budget_usd: cost at which the machines are released; None: the site's.
        availability: instead of ``replicas``, the share of time to serve, such as 0.9995: copies are added until then.
        scale: instead of ``replicas``, bounds and targets of the number of machines.
        keep: leave the cluster running when the launch ends.

    Raises:
        LocalError: an argument is wrong; the text names it and what was expected.
    """

    def __init__(
        self,
        *,
        cloud_nodes: Iterable[object],
        deployments: Iterable[CloudMachine],
        name: str = "",
        replicas: int | None = None,
        services: Offered | None = None,
        actions: Offered | None = None,
        topics: Offered | None = None,
        replication: SomeReplication | None = None,
        timeout_s: float | None = None,
        idle: float | str | None = None,
        budget_usd: float | None = None,
        keep: bool = False,
        availability: float | None = None,
        scale: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__()
        self.cloud_nodes = tuple(cloud_nodes)
        self.cluster_spec = ClusterSpec.checked(
            tuple(deployments),
            name=name,
            replicas=replicas,
            services=services,
            actions=actions,
            topics=topics,
            replication=replication,
            timeout_s=timeout_s,
            idle=idle,
            budget_usd=budget_usd,
            keep=keep,
            availability=availability,
            scale=scale,
        )
        record(self)
