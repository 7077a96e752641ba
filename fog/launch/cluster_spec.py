"""Specification of a cluster: the checked arguments of a ``FogCluster``; with its nodes it becomes a plan.

Sans-I/O.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fog.cluster import CloudNode, ClusterPlan, ExportedInterface, MachineRequest
from fog.launch.interfaces import Offered, SomeReplication, carried, replication_rule
from fog.launch.machines import CloudMachine, filled
from fog.plan.duration import seconds_from_text
from fog.scaling import ScalingPolicy, policy_from_keys
from gdp.errors import LocalError

__all__ = ["ClusterSpec"]

_NAME: Final = "[a-z0-9][a-z0-9-]{0,31}"


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
    def checked(
        cls,
        deployments: Sequence[CloudMachine],
        *,
        name: str,
        replicas: int | None,
        services: Offered | None,
        actions: Offered | None,
        topics: Offered | None,
        replication: SomeReplication | None,
        timeout_s: float | None,
        idle: float | str | None,
        budget_usd: float | None,
        keep: bool,
        availability: float | None = None,
        scale: Mapping[str, object] | None = None,
    ) -> ClusterSpec:
        """Check the keywords of a ``FogCluster``."""
        if name and not re.fullmatch(_NAME, name):
            raise LocalError(f"name {name!r}: expected small letters, digits and hyphens, at most 32")
        if availability is not None and replicas is not None:
            raise LocalError("replicas and availability: say how many there are, or how available they are to be")
        if availability is not None and not 0 < availability < 1:
            raise LocalError(f"availability={availability}: expected a share of time between 0 and 1, such as 0.9995")
        policy = None if scale is None else policy_from_keys(scale)
        if policy is not None and (replicas is not None or availability is not None):
            raise LocalError("scale, replicas and availability: say one of them")
        count = len(deployments) if availability is not None else replicas
        if policy is not None:
            count = max(policy.min_machines, len(deployments))
        machines, notes = filled(deployments, count)
        defaults: dict[str, object] = {}
        if replication is not None:
            defaults["replication"] = replication_rule(replication)
        if timeout_s is not None:
            defaults["timeout_s"] = _positive("timeout_s", timeout_s)
        named = None
        if services is not None or actions is not None or topics is not None:
            named = (
                *carried("service", services or {}, defaults),
                *carried("action", actions or {}, defaults),
                *carried("topic", topics or {}, defaults),
            )
        idle_s = seconds_from_text(idle) if isinstance(idle, str) else idle
        return cls(
            name=name,
            machines=machines,
            carried=named,
            defaults=defaults,
            idle_s=None if idle_s is None else _positive("idle", idle_s),
            budget_usd=None if budget_usd is None else _positive("budget_usd", budget_usd),
            keep=keep,
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
