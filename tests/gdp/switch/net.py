"""Link states made by hand, for tests of paths."""

from __future__ import annotations

from gdp.control.link_state import Adjacency, AttachedRib, LinkState, Scope
from gdp.names import Name
from gdp.switch.lsdb import LinkStateDatabase
from gdp.switch.paths import Paths


def name(label: str) -> Name:
    """Return a name that people can read."""
    return Name(label.encode().ljust(32, b"-"))


HOME, AWAY, THIRD = name("home"), name("away"), name("third")


def link(to: str, cost: int = 10, domain: Name = HOME) -> Adjacency:
    """Return one direction of a link."""
    return Adjacency(name(to), domain, cost, 1_500)


def state(
    origin: str,
    *links: Adjacency,
    domain: Name = HOME,
    scope: Scope = Scope.DOMAIN,
    sequence: int = 1,
    inside: tuple[Adjacency, ...] = (),
    ribs: tuple[str, ...] = (),
    members: tuple[str, ...] = (),
    is_leaf: bool = False,
) -> LinkState:
    """Return a link state."""
    attached = tuple(AttachedRib(name(rib), domain, bytes(8)) for rib in ribs)
    listed = tuple(name(member) for member in members)
    return LinkState(
        origin=name(origin),
        domain=domain,
        scope=scope,
        sequence=sequence,
        links=links,
        inside=inside,
        ribs=attached,
        members=listed,
        is_leaf=is_leaf,
    )


def known(*states: LinkState) -> LinkStateDatabase:
    """Return the database of a switch of HOME."""
    link_states = LinkStateDatabase(HOME)
    for each in states:
        link_states.put(each, b"wire of " + each.origin, 0.0)
    return link_states


def paths(me: str, *states: LinkState) -> Paths:
    """Return the paths of a switch of HOME."""
    return Paths(name(me), HOME, known(*states))
