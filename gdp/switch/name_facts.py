"""Facts of a switch about one name: where its advertisers are, and its trees here.

Sans-I/O.
"""

from __future__ import annotations

from typing import Final

from gdp.diagnosis.facts import LocationFact
from gdp.names import Name
from gdp.switch.multicast import MulticastTrees
from gdp.switch.name_cache import NameCache
from gdp.switch.paths import Paths
from gdp.trust.domain import Policy

__all__ = ["location_facts", "reached_switches", "trees_facts"]

_LOCATIONS_MAX: Final = 32
_SWITCHES_MAX: Final = 64


def location_facts(
    cache: NameCache, paths: Paths, policy: Policy, me: Name, name: Name, now_s: float
) -> tuple[LocationFact, ...]:
    """Return the known advertisers of a name, and whether a path that the policies allow leads to their switches."""
    found = []
    for location in cache.of(name, now_s)[:_LOCATIONS_MAX]:
        allowed = (policy.transit & location.transit) | {policy.own, location.domain}
        is_here = location.switch == me
        found.append(
            LocationFact(
                advertiser=location.advertiser.to_text(),
                right=location.right.value,
                switch=location.switch.to_text(),
                domain=location.domain.to_text(),
                is_reachable=is_here or paths.to_switch(location.switch, location.domain, allowed) is not None,
                is_trusted=policy.trusts(location.domain),
            )
        )
    return tuple(found)


def reached_switches(paths: Paths, policy: Policy, me: Name) -> tuple[str, ...]:
    """Return the switches of the own domain to which a path leads, this one included; empty: too many to list."""
    others = [each for each in sorted(paths.members()) if each != me]
    if len(others) >= _SWITCHES_MAX:
        return ()
    allowed = frozenset({policy.own})
    reached = [each for each in others if paths.to_switch(each, policy.own, allowed) is not None]
    return tuple(each.to_text() for each in (me, *reached))


def trees_facts(multicast: MulticastTrees, name: Name) -> tuple[int, int, bool]:
    """Return the readers attached here, the branches of the name's trees, and whether one has its messages."""
    trees = list(multicast.trees.of_topic(name))
    return (
        len(multicast.readers(name)),
        sum(len(tree.branches) for tree in trees),
        any(tree.upstream is not None for tree in trees),
    )
