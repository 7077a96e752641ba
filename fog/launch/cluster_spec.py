"""Specification of a cluster: the checked arguments of a ``FogCluster``; with its nodes it becomes a plan."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fog.cluster import CloudNode, ClusterPlan, ExportedInterface, MachineRequest
from fog.launch.interfaces import Offered, SomeReplication, carried, replication_rule
from fog.launch.machines import CloudMachine, filled
from fog.plan.duration import seconds_from_text
from fog.scaling import ScalingPolicy, policy_from_keys
from gdp.errors import LocalError
from gdp.ros_names import Kind

_NAME: Final = "[a-z0-9][a-z0-9-]{0,31}"


@dataclass(eq=False, repr=False, kw_only=True)
class ClusterKeywords:
    """Keywords of a ``FogCluster``.

    Args:
        cloud_nodes: list of ``Node``.
        deployments: one machine for each replica.
        name: of the cluster, for ``fog scale NAME``; empty: the first node's executable.
        replicas: at least this many machines, in different regions; None: 2, or as many as ``deployments`` has.
        services, actions, topics: full name to type of what the nodes offer; without any, services and actions are
            discovered.
        replication: ``"all"``, ``"some"``, ``"hedged"`` or ``"nearest"``, or the rule's map; None: ``"all"``.
        timeout_s: time limit of a response; None: the proxy's 5 s.
        idle: time without a call (seconds, or ``"30min"``) after which the machines are released; None: the site's.
        budget_usd: cost at which the machines are released; None: the site's.
        keep: leave the cluster running when the launch ends.
        availability: instead of ``replicas``, the share of time to serve, such as 0.9995: copies are added until then.
        scale: instead of ``replicas``, bounds and targets of the number of machines.
    """

    cloud_nodes: Iterable[object]
    deployments: Iterable[CloudMachine]
    name: str = ""
    replicas: int | None = None
    services: Offered | None = None
    actions: Offered | None = None
    topics: Offered | None = None
    replication: SomeReplication | None = None
    timeout_s: float | None = None
    idle: float | str | None = None
    budget_usd: float | None = None
    keep: bool = False
    availability: float | None = None
    scale: Mapping[str, object] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterSpec:
    """Cluster without its nodes.

    Args:
        name: empty: the name of the first node's executable.
        carried: exported interfaces; None: to be discovered.
        defaults: keys of rules on the robot's side for discovered interfaces.
        availability: share of time for which at least one machine is to serve; None: ``machines`` is the full list.
    """

    name: str
    machines: tuple[MachineRequest, ...]
    carried: tuple[ExportedInterface, ...] | None
    defaults: dict[str, object]
    idle_s: float | None
    budget_usd: float | None
    keep: bool
    notes: tuple[str, ...]
    availability: float | None = None
    scale: ScalingPolicy | None = None

    @classmethod
    def checked(cls, keywords: ClusterKeywords) -> ClusterSpec:
        """Check the keywords of a ``FogCluster``."""
        name, replicas, availability = keywords.name, keywords.replicas, keywords.availability
        deployments, timeout_s, budget_usd = tuple(keywords.deployments), keywords.timeout_s, keywords.budget_usd
        if name and not re.fullmatch(_NAME, name):
            raise LocalError(f"name {name!r}: expected small letters, digits and hyphens, at most 32")
        if availability is not None and replicas is not None:
            raise LocalError("replicas and availability: say how many there are, or how available they are to be")
        if availability is not None and not 0 < availability < 1:
            raise LocalError(f"availability={availability}: expected a share of time between 0 and 1, such as 0.9995")
        policy = None if keywords.scale is None else policy_from_keys(keywords.scale)
        if policy is not None and (replicas is not None or availability is not None):
            raise LocalError("scale, replicas and availability: say one of them")
        count = len(deployments) if availability is not None else replicas
        if policy is not None:
            count = max(policy.min_machines, len(deployments))
        machines, notes = filled(deployments, count)
        defaults: dict[str, object] = {}
        if keywords.replication is not None:
            defaults["replication"] = replication_rule(keywords.replication)
        if timeout_s is not None:
            defaults["timeout_s"] = _positive("timeout_s", timeout_s)
        offered: dict[Kind, Offered | None] = {
            "service": keywords.services,
            "action": keywords.actions,
            "topic": keywords.topics,
        }
        is_named = any(each is not None for each in offered.values())
        named = tuple(each for kind, names in offered.items() for each in carried(kind, names or {}, defaults))
        idle_s = seconds_from_text(keywords.idle) if isinstance(keywords.idle, str) else keywords.idle
        return cls(
            name=name,
            machines=machines,
            carried=named if is_named else None,
            defaults=defaults,
            idle_s=None if idle_s is None else _positive("idle", idle_s),
            budget_usd=None if budget_usd is None else _positive("budget_usd", budget_usd),
            keep=keywords.keep,
            notes=notes,
            availability=availability,
            scale=policy,
        )

    def plan(self, nodes: Sequence[CloudNode], found: Sequence[ExportedInterface] = ()) -> ClusterPlan:
        """Return the cluster with its nodes; ``found``: discovered interfaces, if the launch file lists none."""
        if not nodes:
            raise LocalError("cloud_nodes is empty: expected at least one Node")
        name = self.name or re.sub("[^a-z0-9]+", "-", nodes[0].executable.lower()).strip("-")[:32] or "cluster"
        carries = tuple(found) if self.carried is None else self.carried
        return ClusterPlan(
            name,
            tuple(nodes),
            self.machines,
            carries,
            idle_s=self.idle_s,
            budget_usd=self.budget_usd,
            availability=self.availability,
            scale=self.scale,
        )

    def carry(self, kind_name_type: Sequence[tuple[str, str, str]]) -> tuple[ExportedInterface, ...]:
        """Return interfaces, given as (kind, name, type), with the keys that the launch file sets for all."""
        return tuple(
            each
            for kind, name, type_name in kind_name_type
            for each in carried("action" if kind == "action" else "service", {name: type_name}, self.defaults)
        )


def _positive(key: str, value: float) -> float:
    if not value > 0:
        raise LocalError(f"{key}={value}: expected more than 0")
    return float(value)
