"""Topology of a network as data: switches, links, domains and attached nodes.

Sans-I/O. ``namespaces.py`` makes kernel namespaces of it; ``simulation.py`` makes protocol cores in one process.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

from gdp.errors import LocalError
from gdp.limits import FRAME_MAX_BYTES, MTU_MIN_BYTES

Role = Literal["rib", "proxy"]

COST: Final = 10
DETOUR_COST: Final = 100
MTU_BYTES: Final = 1_500
MTU_MAX_BYTES: Final = FRAME_MAX_BYTES - 14  # an MTU does not count the Ethernet header
_IFNAME_MAX: Final = 13


@dataclass(frozen=True, slots=True)
class Link:
    """A link between two switches. On each end the device has the name of the neighbour that it leads to."""

    a: str
    b: str
    cost: int = COST
    mtu: int = MTU_BYTES

    def ends(self) -> frozenset[str]:
        """Return both switches as a set, so that ``a-b`` and ``b-a`` are one link."""
        return frozenset((self.a, self.b))

    def other(self, node: str) -> str:
        """Return the switch at the far end from ``node``."""
        return self.b if node == self.a else self.a

    def __str__(self) -> str:
        return f"{self.a}-{self.b}"


@dataclass(frozen=True, slots=True)
class Attachment:
    """A RIB or a proxy attached to a switch.

    ``ifname`` is its device, the first half of the pair that the switch makes.
    """

    switch: str
    role: Role
    ifname: str


@dataclass(frozen=True, slots=True)
class DomainPlan:
    """A trust domain: its switches, and the domain whose RIB is the tier above (None at the top)."""

    label: str
    switches: tuple[str, ...]
    upper: str | None = None


@dataclass(frozen=True, slots=True)
class Topology:
    """Switches, links, domains and attached nodes, validated on construction.

    Raises ``LocalError``: an unknown or repeated switch, a link twice or to itself, a domain that overlaps, a cost, MTU
    or device name out of bounds. Methods raise it for switches that are unknown or not joined.
    """

    links: tuple[Link, ...]
    domains: tuple[DomainPlan, ...]
    attachments: tuple[Attachment, ...]

    def __post_init__(self) -> None:
        nodes = [node for domain in self.domains for node in domain.switches]
        labels = {domain.label for domain in self.domains}
        _require(len(set(nodes)) == len(nodes), "a switch belongs to one domain")
        _require(len(labels) == len(self.domains), "a domain's label stands twice")
        _require(all(d.upper is None or d.upper in labels - {d.label} for d in self.domains), "an unknown tier above")
        _require(all(0 < len(node) <= _IFNAME_MAX for node in nodes), f"a switch has 1 to {_IFNAME_MAX} characters")
        _require(len({link.ends() for link in self.links}) == len(self.links), "a link stands twice")
        for link in self.links:
            _require(link.a != link.b and link.ends() <= set(nodes), f"{link} does not join two switches")
            _require(link.cost >= 1, f"{link} costs less than 1")
            _require(MTU_MIN_BYTES <= link.mtu <= MTU_MAX_BYTES, f"an MTU is {MTU_MIN_BYTES} to {MTU_MAX_BYTES} bytes")
        ends = [(at.switch, at.ifname) for at in self.attachments]
        _require(len(set(ends)) == len(ends), "two attachments share a device")
        for at in self.attachments:
            _require(at.switch in nodes, f"{at.role} stands at no switch: {at.switch}")
            _require(0 < len(at.ifname) <= _IFNAME_MAX and at.ifname not in nodes, f"{at.ifname} cannot name a device")

    @property
    def nodes(self) -> tuple[str, ...]:
        """Return all switches, domain by domain."""
        return tuple(node for domain in self.domains for node in domain.switches)

    def links_of(self, node: str) -> Iterator[Link]:
        """Yield the links that end at this switch, in the topology's order."""
        return (link for link in self.links if node in link.ends())

    def neighbours(self, node: str) -> list[str]:
        """Return the switches that a switch has a link to, which name its devices, in the topology's order."""
        return [link.other(node) for link in self.links_of(node)]

    def link(self, a: str, b: str) -> Link:
        """Return the link between two switches, named in either order."""
        for link in self.links:
            if link.ends() == {a, b}:
                return link
        raise LocalError(f"no link {a}-{b}; there are {', '.join(map(str, self.links))}")

    def domain_of(self, node: str) -> DomainPlan:
        """Return the trust domain of a switch."""
        for domain in self.domains:
            if node in domain.switches:
                return domain
        raise LocalError(f"no switch {node}; there are {', '.join(self.nodes)}")

    def attached(self, role: Role) -> tuple[Attachment, ...]:
        """Return the attachments of one role, in the topology's order."""
        return tuple(at for at in self.attachments if at.role == role)

    def reached(self, start: str, *, down: Collection[frozenset[str]], dead: Collection[str]) -> frozenset[str]:
        """Return the switches that a live one reaches, itself included: not over links that are down, or dead ones."""
        found, ahead = {start}, [start]
        while ahead:
            node = ahead.pop()
            new = {link.other(node) for link in self.links_of(node) if link.ends() not in down} - found - set(dead)
            found |= new
            ahead += new
        return frozenset(found)

    def rib_of(self, label: str) -> Attachment | None:
        """Return the RIB of this domain, None if it has none."""
        return next((at for at in self.attached("rib") if self.domain_of(at.switch).label == label), None)


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise LocalError(otherwise)


def ring5(mtu: int = MTU_BYTES) -> Topology:
    r"""Return five switches in a ring over three domains.

    The usual path is nuc1-nuc2-nuc3-nuc4-nuc5; the short cut costs more::

        school: nuc1 (robot) -- nuc2 (border)            cloud: nuc4 (border) -- nuc5 (server)
                  |                   \                         /                   |
                  |                     backbone: nuc3 (upper RIB)                  |
                  +------------------------- cost 100 -----------------------------+
    """
    first, *_, last = nodes = tuple(f"nuc{number}" for number in range(1, 6))
    return Topology(
        (*(Link(a, b, mtu=mtu) for a, b in pairwise(nodes)), Link(last, first, DETOUR_COST, mtu)),
        (
            DomainPlan("school", nodes[:2], upper="backbone"),
            DomainPlan("backbone", nodes[2:3]),
            DomainPlan("cloud", nodes[3:], upper="backbone"),
        ),
        _attachments(nodes[1:4], [(first, "robot"), (last, "server")]),
    )


def chain(length: int, mtu: int = MTU_BYTES) -> Topology:
    """Return ``length`` switches ``s1 .. sN`` in a row in one domain: its RIB in the middle, a proxy at either end.

    Raises ``LocalError``: no switch at all.
    """
    _require(length >= 1, "a chain has at least one switch")
    nodes = tuple(f"s{number}" for number in range(1, length + 1))
    ends = [(nodes[0], "left"), (nodes[-1], "right")]
    links = tuple(Link(a, b, mtu=mtu) for a, b in pairwise(nodes))
    return Topology(links, (DomainPlan("chain", nodes),), _attachments([nodes[length // 2]], ends))


LEFT: Final = "a"
MIDDLE: Final = ("s1", "s2", "s3")
RIGHT: Final = "b"
ROW: Final = (LEFT, *MIDDLE, RIGHT)
_DOMAIN: Final = "lab"


def ends_of(link: str) -> tuple[str, str]:
    """Return the two ends of a link ``a-b``."""
    a, _, b = link.partition("-")
    return a, b


def make_topology(
    domains: Mapping[str, Iterable[str]],
    uppers: Mapping[str, str],
    links: Iterable[str | Link],
    ribs: Iterable[str],
    members: Mapping[str, str],
) -> tuple[Topology, tuple[str, ...]]:
    """Return a topology, and its members.

    Args:
        domains: switches by label.
        uppers: the domain of the tier above, by label.
        links: between switches, ``a-b`` at the usual cost.
        ribs: switches with a RIB, in the order of the topology's attachments.
        members: home switch by member, joined by a link; a member is of its home's domain.

    Raises:
        LocalError: they do not fit together.
    """
    of = {switch: label for label, switches in domains.items() for switch in switches}
    plans = tuple(
        DomainPlan(label, (*switches, *(m for m, home in members.items() if of[home] == label)), uppers.get(label))
        for label, switches in domains.items()
    )
    made = [Link(*ends_of(each)) if isinstance(each, str) else each for each in links]
    leads = [Link(member, home) for member, home in members.items()]
    return Topology((*made, *leads), plans, _attachments(ribs, [(each, "end") for each in members])), tuple(members)


def flat_topology(
    links: Iterable[tuple[str, str]], *, mtu: int, rib: str, members: Sequence[str], switches: Sequence[str] = ()
) -> Topology:
    """Return the topology of one trust domain; ``rib`` is the switch with the RIB.

    ``mtu``: bytes after the Ethernet header, of every link. ``switches``: nodes that come first in the topology's
    order. Raises ``LocalError``: they do not fit together.
    """
    pairs = list(links)
    nodes = tuple(dict.fromkeys((*switches, *(end for pair in pairs for end in pair))))
    made = tuple(Link(a, b, mtu=mtu) for a, b in pairs)
    return Topology(made, (DomainPlan(_DOMAIN, nodes),), _attachments([rib], [(each, "end") for each in members]))


def row(mtu: int) -> Topology:
    """Return A - s1 - s2 - s3 - B with the RIB at s2. Raises ``LocalError``: the MTU is out of bounds."""
    return flat_topology(pairwise(ROW), mtu=mtu, rib="s2", members=(LEFT, RIGHT))


def single(node: str) -> Topology:
    """Return the topology of one machine without links."""
    return Topology((), (DomainPlan(_DOMAIN, (node,)),), ())


def _attachments(ribs: Iterable[str], proxies: Iterable[tuple[str, str]]) -> tuple[Attachment, ...]:
    """Return RIBs by their switches, and proxies by switch and device."""
    return (
        *(Attachment(switch, "rib", "rib") for switch in ribs),
        *(Attachment(switch, "proxy", device) for switch, device in proxies),
    )
