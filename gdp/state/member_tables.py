"""Tables of a node that is no switch: what it advertises, and the members at the other ends of its names.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import chain

from gdp.client.participant import Participant
from gdp.client.rib_host import RibHost
from gdp.names import Name
from gdp.ports.plane import Plane
from gdp.rib.store import MemoryStore, Store
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row, TableSource
from gdp.state.tables import common_tables, domain_label, seconds_left
from gdp.trust.domain import Policy
from gdp.trust.right import Right

__all__ = ["participant_tables", "rib_tables"]


def participant_tables(
    member: Participant,
    plane: Plane,
    policy: Policy,
    drops: Iterable[Callable[[], Sequence[int]]],
    local_name: Callable[[Name], str],
) -> dict[str, TableSource]:
    """Return the sources of the tables of a proxy.

    Args:
        drops: each returns counts by ``DropReason``.
        local_name: returns the ROS name of a name, or another form for people.
    """

    def names(_now: Timestamps) -> list[Row]:
        rows: list[Row] = []
        for each in member.attachment.advertisements:
            if each.right is not Right.ATTACH:
                state = "acknowledged" if each.is_taken else "waiting" if each.refused is None else each.refused.label
                label = local_name(each.subject.name)
                rows.append({"local": label, "right": each.right.value, "state": state, "name": each.subject.name})
        return sorted(rows, key=lambda row: (str(row["local"]), str(row["right"])))

    def peers(_now: Timestamps) -> list[Row]:
        rows: list[Row] = []
        for each in member.writer_proxies():
            rows.append(
                {
                    "local": local_name(each.topic),
                    "peer": each.publisher,
                    "is": "writer",
                    "state": each.state.name.lower(),
                    "name": each.topic,
                }
            )
        for publisher in member.publishers():
            for reader in map(Name, publisher.matched.names()):
                rows.append(
                    {
                        "local": local_name(publisher.topic),
                        "peer": reader,
                        "is": "reader",
                        "state": "silent" if publisher.matched.is_suspended(reader) else "live",
                        "name": publisher.topic,
                    }
                )
        return sorted(rows, key=lambda row: (str(row["local"]), row["is"], row["peer"]))

    common = common_tables(member.attachment.hello_protocol, plane, policy, drops)
    return {**common, "names": names, "peers": peers}


def rib_tables(
    host: RibHost, store: Store, plane: Plane, policy: Policy, drops: Iterable[Callable[[], Sequence[int]]]
) -> dict[str, TableSource]:
    """Return the sources of the tables of a RIB; one that stores its names in a cluster has no table of names.

    Args:
        drops: each returns counts by ``DropReason``.
    """

    def names(now: Timestamps) -> list[Row]:
        if not isinstance(store, MemoryStore):
            return []
        known = dict.fromkeys(name for name, _ in store.known())
        return [
            {
                "name": route.name,
                "advertiser": route.advertiser,
                "at": route.switch,
                "domain": domain_label(policy, route.domain),
                "lease_s": seconds_left(route.expires_s, now),
            }
            for route in sorted(
                chain.from_iterable(map(store.routes, known)), key=lambda each: (each.name, each.advertiser)
            )
        ]

    tables = common_tables(host.attachment.hello_protocol, plane, policy, drops)
    return {**tables, "names": names} if isinstance(store, MemoryStore) else tables
