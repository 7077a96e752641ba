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
        name: name of the cluster for ``fog scale NAME`` and other verbs; empty: the name of the first node's
            executable.
        replicas: at least this many machines, in different regions; None: 2, or as many as ``deployments`` has.
        services, actions, topics: full name -> type of the interfaces that the nodes offer to the robot. Without any of
            the three, services and actions are discovered: the nodes run once on this machine, in a separate graph.
        replication: ``"all"``, ``"some"`` or ``"hedged"``, or the rule's map; None: all replicas receive each request.
        timeout_s: time limit of a response; None: the proxy's 5 s.
        idle: after this long without a call (seconds, or a text such as ``"30min"``) the machines are released.
        budget_usd: when the machines have cost this much they are released.
        availability: share of time for which at least one machine is to serve, such as 0.9995, instead of ``replicas``:
            ``fog launch`` adds copies of the listed machines until it is reached, and prints its assumptions.
        scale: between which numbers of machines the cluster moves, by load and by schedule within a budget: a map with
            ``max``, and ``min``, ``target_ms``, ``target_calls_per_s``, ``schedule``, ``budget_usd_per_h``.
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
