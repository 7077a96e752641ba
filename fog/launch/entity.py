"""``FogCluster``: nodes that run on every machine of a cluster, as a launch file says it.

Place: pure but for ``unreturned``, which remembers it; ``ros_action`` makes an action of ROS 2's ``launch`` of it.
Source: FogROS2-FT, Listing 1.
"""

from __future__ import annotations

from collections.abc import Iterable

from fog.launch.cluster_spec import ClusterSpec
from fog.launch.interfaces import Offered, SomeReplication
from fog.launch.machines import CloudMachine
from fog.launch.unreturned import note

__all__ = ["FogCluster"]


class FogCluster:
    """Nodes on machines, each machine a replica of all of them.

    It takes effect by being made within a launch file; the launch description need not have it.

    Args:
        cloud_nodes: ``Node`` each.
        deployments: one machine for each replica.
        name: of the cluster, for ``fog scale NAME`` and the like; empty: after the first node's executable.
        replicas: at least this many machines, in different regions; None: 2, or as many as ``deployments`` has.
        services, actions, topics: full name -> type of what the nodes offer to the robot. Without any of the three, the
            services and actions are found out by starting the nodes once on this machine, in a graph of their own.
        replication: ``"all"``, ``"some"`` or ``"hedged"``, or the rule's map; None: all replicas get each request.
        timeout_s: how long an answer may take; None: the proxy's 5 s.
        idle: without a call for this long (seconds, or such as ``"30min"``) the machines are given back.
        budget_usd: when they have cost this much they are given back.
        availability: share of time for which a machine is to serve, such as 0.9995, in place of ``replicas``:
            ``fog launch`` adds copies of the listed machines until that is reached, and says what it assumes.
        keep: leave the cluster running when the launch ends.

    Raises:
        LocalError: something is wrong; the text says which and what was expected.
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
        )
        note(self)
