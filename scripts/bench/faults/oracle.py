"""Oracle of connectivity: which endpoints must be able to communicate, by graph and policy, during faults.

Sans-I/O. All domains of a plan trust each other and let each other's traffic pass, so policy allows every path.
The graph decides what must be connected: both members run, each at a running switch, with a path of working switches
and links between these. Known names need no RIB, and a RIB is reached the same way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from faults.plan import Plan


@dataclass(slots=True)
class Broken:
    """State of the faults: switches, links (both ends) and members that do not work; locations of moved members."""

    switches: set[str] = field(default_factory=set)
    links: set[frozenset[str]] = field(default_factory=set)
    members: set[str] = field(default_factory=set)
    at: dict[str, str] = field(default_factory=dict)


class Oracle:
    """Oracle of the pairs that must be connected.

    Args:
        plan: the network without faults.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._switches = frozenset(plan.switches)
        self._links = [link.ends() for link in plan.topology.links if link.ends() <= self._switches]

    @property
    def links(self) -> list[frozenset[str]]:
        """Return the links between switches."""
        return list(self._links)

    def part_of(self, switch: str, broken: Broken) -> frozenset[str]:
        """Return the live switches that a live switch reaches, itself included."""
        ways: dict[str, set[str]] = {}
        for link in self._links:
            if link not in broken.links and not link & broken.switches:
                a, b = link
                ways.setdefault(a, set()).add(b)
                ways.setdefault(b, set()).add(a)
        found, ahead = {switch}, [switch]
        while ahead:
            new = ways.get(ahead.pop(), set()) - found
            found |= new
            ahead += new
        return frozenset(found)

    def is_whole(self, broken: Broken) -> bool:
        """Return whether all live switches reach each other."""
        live = self._switches - broken.switches
        return bool(live) and self.part_of(min(live), broken) == live

    def must_talk(self, a: str, b: str, broken: Broken) -> bool:
        """Return whether two members must be able to communicate."""
        homes = [broken.at.get(member, self._plan.home(member)) for member in (a, b)]
        if {a, b} & broken.members or set(homes) & broken.switches:
            return False
        return homes[1] in self.part_of(homes[0], broken)

    def pairs(self) -> Iterator[tuple[int, str, str]]:
        """Yield each flow's channel, publisher and reader."""
        for channel, flow in enumerate(self._plan.flows):
            yield from ((channel, flow.publisher, reader) for reader in flow.readers)
