"""Topologies of the benches and experiments.

Sans-I/O. A device is named like the neighbour that it leads to. Members are nodes without a switch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, pairwise
from typing import Final

from lab.topology import Attachment, DomainPlan, Link, Topology

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
    return Topology((*made, *leads), plans, _attachments(ribs, members)), tuple(members)


def flat_topology(
    links: Iterable[tuple[str, str]], *, mtu: int, rib: str, members: Sequence[str], switches: Sequence[str] = ()
) -> Topology:
    """Return the topology of one trust domain; ``rib`` is the switch with the RIB.

    Args:
        mtu: bytes after the Ethernet header, of every link.
        switches: nodes that come first in the topology's order.

    Raises:
        LocalError: they do not fit together.
    """
    pairs = list(links)
    nodes = tuple(dict.fromkeys((*switches, *chain.from_iterable(pairs))))
    made = tuple(Link(a, b, mtu=mtu) for a, b in pairs)
    return Topology(made, (DomainPlan(_DOMAIN, nodes),), _attachments([rib], members))


def row(mtu: int) -> Topology:
    """Return A - s1 - s2 - s3 - B with the RIB at s2.

    Raises:
        LocalError: the MTU is out of bounds.
    """
    return flat_topology(pairwise(ROW), mtu=mtu, rib="s2", members=(LEFT, RIGHT))


def single(node: str) -> Topology:
    """Return the topology of one machine without links."""
    return Topology((), (DomainPlan(_DOMAIN, (node,)),), ())


def _attachments(ribs: Iterable[str], members: Iterable[str]) -> tuple[Attachment, ...]:
    return (
        *(Attachment(switch, "rib", "rib") for switch in ribs),
        *(Attachment(member, "proxy", "end") for member in members),
    )
