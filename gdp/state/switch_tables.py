"""Tables of a switch: routes, multicast trees, names, tunnels and the other switches.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from gdp.names import NAME_BYTES, Name
from gdp.ports.plane import MAC_BYTES, Plane
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row, TableSource
from gdp.state.tables import common_tables, domain_label, seconds_left
from gdp.switch.core import SwitchCore
from gdp.switch.trees import Downstream
from gdp.trust.domain import Policy

__all__ = ["SwitchTables"]


class SwitchTables:
    """The tables of one switch.

    Args:
        drops: each returns counts by ``DropReason``.
        tunnels: returns a row for each tunnel; None: the switch has none.
    """

    def __init__(
        self,
        switch: SwitchCore,
        plane: Plane,
        policy: Policy,
        drops: Iterable[Callable[[], Sequence[int]]],
        tunnels: Callable[[Timestamps], Sequence[Row]] | None = None,
    ) -> None:
        self._switch = switch
        self._plane = plane
        self._policy = policy
        self.sources: dict[str, TableSource] = {
            **common_tables(switch.hello_protocol, plane, policy, drops),
            "routes": self._routes,
            "trees": self._trees,
            "names": self._names,
            "peers": self._peers,
            "tunnels": tunnels or (lambda _now: ()),
        }

    def _routes(self, now: Timestamps) -> list[Row]:
        table = self._switch.table
        rows: list[Row] = []
        for key, hops in sorted(table.entries.items()):
            rows.append(
                {
                    "destination": key[:NAME_BYTES],
                    "source": key[NAME_BYTES:] or None,
                    "kind": "nowhere" if not hops else "tree" if self._is_tree(key) else "unicast",
                    "via": ", ".join(self._at((hop[0], hop[1][:MAC_BYTES])) for hop in hops),
                    "alternate": ", ".join(self._at((hop[2], hop[3][:MAC_BYTES])) for hop in hops if len(hop) > 2),
                    "lease_s": seconds_left(table.end_of(key), now),
                }
            )
        return rows

    def _is_tree(self, key: bytes) -> bool:
        topic, publisher = key[:NAME_BYTES], key[NAME_BYTES:]
        return bool(publisher) and self._switch.multicast.trees.get(Name(topic), Name(publisher)) is not None

    def _trees(self, now: Timestamps) -> list[Row]:
        rows: list[Row] = []
        for tree in self._switch.multicast.trees.all():
            for at, branch in sorted(tree.branches.items()):
                rows.append(
                    {
                        "topic": tree.topic,
                        "publisher": tree.publisher,
                        "path": tree.path,
                        "from": "here" if tree.upstream is None else self._at(tree.upstream),
                        "to": self._at(at),
                        "state": "active" if branch.is_active else "backup",
                        "mtu": branch.mtu,
                        "lease_s": seconds_left(branch.expires_s, now),
                    }
                )
        return sorted(rows, key=lambda row: (row["topic"], row["publisher"], row["path"], row["to"]))

    def _names(self, now: Timestamps) -> list[Row]:
        rows: dict[tuple[Name, Name], Row] = {}
        own = domain_label(self._policy, self._policy.own)
        for place in self._switch.resolver.cache.all():
            rows[place.name, place.advertiser] = {
                "name": place.name,
                "advertiser": place.advertiser,
                "right": place.right.value,
                "at": "here" if place.switch == self._switch.name else place.switch,
                "domain": domain_label(self._policy, place.domain),
                "lease_s": seconds_left(place.expires_s, now),
            }
        for each in self._switch.attached.all():
            advertisement = each.advertisement
            rows[advertisement.name, advertisement.node] = {
                "name": advertisement.name,
                "advertiser": advertisement.node,
                "right": advertisement.right.value,
                "at": "here",
                "domain": own,
                "lease_s": seconds_left(each.expires_s, now),
            }
        return [rows[key] for key in sorted(rows)]

    def _peers(self, _now: Timestamps) -> list[Row]:
        paths, own = self._switch.paths, self._policy.own
        rows: list[Row] = []
        for name in sorted(paths.members() - {self._switch.name}):
            way = paths.to_switch(name, own, self._policy.transit | {own})
            rows.append(
                {
                    "peer": name,
                    "role": "switch",
                    "domain": domain_label(self._policy, own),
                    "distance": None if way is None else way.distance,
                    "via": None if way is None else self._neighbour_label(way.first),
                }
            )
        for name, rib in sorted(paths.ribs().items()):
            to_rib, _ = paths.to_rib(name, self._policy.transit)
            rows.append(
                {
                    "peer": name,
                    "role": "rib",
                    "domain": domain_label(self._policy, rib.domain),
                    "distance": None if to_rib is None else to_rib.distance,
                    "via": None if to_rib is None else self._neighbour_label(to_rib.first),
                }
            )
        return rows

    def _neighbour_label(self, name: Name) -> str:
        found = (each for each in self._switch.hello_protocol.neighbours.all_up() if each.name == name)
        return next((each.member.label for each in found if each.member is not None), name.short)

    def _at(self, at: Downstream) -> str:
        """Return device and neighbour of a hop, such as ``eth1 nuc2``."""
        index, mac = at
        port = self._plane.ports.get(index)
        hello_port = self._switch.hello_protocol.ports.get(index)
        near = () if hello_port is None else hello_port.neighbours.values()
        label = next((n.member.label for n in near if n.mac == mac and n.member is not None), mac.hex(":"))
        return f"{index if port is None else port.ifname} {label}"
