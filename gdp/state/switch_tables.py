"""Tables of a switch: routes, multicast trees, names, tunnels and the other switches; rows of its names with counts.

Sans-I/O. A switch knows names as 256 bits only; a proxy of the same machine may know what they mean.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from gdp.frame.pace import kbit_s_of
from gdp.names import NAME_BYTES, Name
from gdp.ports.plane import MAC_BYTES
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row, TableSource
from gdp.state.node_state import SwitchState
from gdp.state.tables import common_tables, seconds_left
from gdp.state.topic_rows import Direction, TopicRow
from gdp.switch.local_advertisements import LocalAdvertisement
from gdp.switch.paths import Path
from gdp.switch.trees import Downstream
from gdp.trust.right import Right

_OFFERS = (Right.PUBLISH, Right.SERVE)
_USES = (Right.READ, Right.CALL)


def switch_tables(
    state: SwitchState, tunnels: Callable[[Timestamps], Sequence[Row]] | None = None
) -> dict[str, TableSource]:
    """Return the sources of the tables of a switch.

    Args:
        tunnels: returns a row for each tunnel; None: the switch has none.
    """
    return {
        **common_tables(state),
        "routes": lambda now: _routes(state, now),
        "trees": lambda now: _trees(state, now),
        "names": lambda now: _names(state, now),
        "peers": lambda _now: _peers(state),
        "tunnels": tunnels or (lambda _now: ()),
    }


def _routes(state: SwitchState, now: Timestamps) -> list[Row]:
    table, trees = state.switch.table, state.switch.multicast.trees
    rows: list[Row] = []
    for key, hops in sorted(table.entries.items()):
        destination, source = key[:NAME_BYTES], key[NAME_BYTES:]
        is_tree = bool(source) and trees.get(Name(destination), Name(source)) is not None
        rows.append(
            {
                "destination": destination,
                "source": source or None,
                "kind": "nowhere" if not hops else "tree" if is_tree else "unicast",
                "via": _listed(state, ((hop[0], hop[1]) for hop in hops)),
                "alternate": _listed(state, ((hop[2], hop[3]) for hop in hops if len(hop) > 2)),
                "lease_s": seconds_left(table.end_of(key), now),
            }
        )
    return rows


def _trees(state: SwitchState, now: Timestamps) -> list[Row]:
    rows: list[Row] = [
        {
            "topic": tree.topic,
            "publisher": tree.publisher,
            "path": tree.path,
            "from": "here" if tree.upstream is None else _at(state, tree.upstream),
            "to": _at(state, at),
            "state": "active" if branch.is_active else "backup",
            "mtu": branch.mtu,
            "kbit_s": kbit_s_of(branch.pace),
            "lease_s": seconds_left(branch.expires_s, now),
        }
        for tree in state.switch.multicast.trees.all()
        for at, branch in sorted(tree.branches.items())
    ]
    return sorted(rows, key=lambda row: (row["topic"], row["publisher"], row["path"], row["to"]))


def _names(state: SwitchState, now: Timestamps) -> list[Row]:
    """Return who advertises each name: what is attached here precedes what was learnt."""
    switch, rows = state.switch, dict[tuple[Name, Name], Row]()

    def add(name: Name, advertiser: Name, right: Right, at: Name, domain: Name, expires_s: float) -> None:
        rows[name, advertiser] = {
            "name": name,
            "advertiser": advertiser,
            "right": right.value,
            "at": "here" if at == switch.name else at,
            "domain": state.domain_label(domain),
            "lease_s": seconds_left(expires_s, now),
        }

    for place in switch.resolver.cache.all():
        add(place.name, place.advertiser, place.right, place.switch, place.domain, place.expires_s)
    for each in switch.attached.all():
        one = each.advertisement
        add(one.name, one.node, one.right, switch.name, state.policy.own, each.expires_s)
    return [rows[key] for key in sorted(rows)]


def _peers(state: SwitchState) -> list[Row]:
    paths, policy = state.switch.paths, state.policy
    labels = {row.name: row.label for row in state.neighbours(is_up=True)}

    def row(name: Name, role: str, domain: Name, path: Path | None) -> Row:
        via = None if path is None else labels.get(path.first) or path.first.short
        distance = None if path is None else path.distance
        return {"peer": name, "role": role, "domain": state.domain_label(domain), "distance": distance, "via": via}

    switches = sorted(paths.members() - {state.switch.name})
    allowed = policy.transit | {policy.own}
    rows = [row(name, "switch", policy.own, paths.to_switch(name, policy.own, allowed)) for name in switches]
    ribs = sorted(paths.ribs().items())
    return rows + [row(name, "rib", rib.domain, paths.to_rib(name, policy.transit)[0]) for name, rib in ribs]


def _listed(state: SwitchState, hops: Iterable[Downstream]) -> str:
    return ", ".join(_at(state, (port, mac[:MAC_BYTES])) for port, mac in hops)


def _at(state: SwitchState, at: Downstream) -> str:
    """Return device and neighbour of a hop, such as ``eth1 nuc2``."""
    index, mac = at
    neighbour = state.hello_protocol.neighbours.neighbour_at(index, mac)
    label = mac.hex(":") if neighbour is None or neighbour.member is None else neighbour.member.label
    return f"{state.ifname(index)} {label}"


def switch_rows(
    attached: Iterable[LocalAdvertisement], entries: Callable[[], Mapping[bytes, tuple[int, int]]] | None
) -> Iterator[TopicRow]:
    """Yield a row for each name.

    Args:
        attached: advertisements of attached nodes; those of the nodes' own names have no row.
        entries: frames and bytes by the busiest entries; None: the data plane does not count them.
    """
    offers, uses, services = Counter[Name](), Counter[Name](), set[Name]()
    for each in attached:
        advertisement = each.advertisement
        offers[advertisement.name] += advertisement.right in _OFFERS
        uses[advertisement.name] += advertisement.right in _USES
        if advertisement.right in (Right.SERVE, Right.CALL):
            services.add(advertisement.name)
    frames: dict[Name, tuple[int, int]] = {}
    for key, (count, size) in (entries() if entries is not None else {}).items():
        name = Name(key[:NAME_BYTES])
        before = frames.get(name, (0, 0))
        frames[name] = before[0] + count, before[1] + size
    named = {name for name in offers if offers[name] or uses[name]}
    for name in sorted(named | frames.keys()):
        counted = frames.get(name, (0, 0) if entries is not None else (None, None))
        yield TopicRow(
            name=name.to_text(),
            direction=Direction.THROUGH,
            kind="service" if name in services else "topic" if name in named else "",
            messages=counted[0],
            bytes=counted[1],
            publishers=offers[name] if name in named else None,
            readers=uses[name] if name in named else None,
        )
