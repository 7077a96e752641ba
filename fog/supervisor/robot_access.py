"""Access of robots to clusters: rules and delegations of their proxies, and names for the watch.

I/O; writes the robots' drop-in files.
"""

from __future__ import annotations

from typing import Final

from fog.bootstrap.robot_config import add_rules, reload_proxy, remove_rules
from fog.cluster import ClusterPlan
from fog.site import Site
from fog.supervisor.watch import Watch

_ROBOT_DAYS: Final = 365.0


class RobotAccess:
    """Access control of a site's robots to clusters; ``watch``: needs their names, too."""

    def __init__(self, site: Site, watch: Watch | None) -> None:
        self._site = site
        self._watch = watch
        self._plans: dict[str, ClusterPlan] = {}  # plans to which the robots have access

    def has(self, plan: ClusterPlan) -> bool:
        """Return whether the robots have access to exactly this plan."""
        return self._plans.get(plan.name) == plan

    def grant(self, plan: ClusterPlan) -> None:
        """Add rules and delegations of robots, and delegations of the watch, for a cluster's interfaces.

        Raises:
            LocalError: keys are missing, or a rule cannot be added.
        """
        authority = self._site.authority
        for path in self._site.robots:
            add_rules(path, authority, plan.name, plan.carried, days=_ROBOT_DAYS)
            reload_proxy(path)
        if self._site.watch is not None:
            keys, _ = self._site.watch
            services = [each for each in plan.carried if each.kind != "topic"]
            authority.grant_access(keys, keys / "delegations", services, days=_ROBOT_DAYS)
            if self._watch is not None:
                self._watch.reload()
        self._plans[plan.name] = plan

    def remove(self, name: str) -> None:
        """Remove the rules of a cluster; other clusters may serve the same names."""
        self._plans.pop(name, None)
        for path in self._site.robots:
            if remove_rules(path, name):
                for plan in self._plans.values():
                    add_rules(path, self._site.authority, plan.name, plan.carried, days=_ROBOT_DAYS)
                reload_proxy(path)
