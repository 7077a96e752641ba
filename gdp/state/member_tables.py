"""Tables of a node that is no switch: what it advertises, and the members at the other ends of its names."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row, TableSource, clock_fields
from gdp.state.node_state import MemberState, RibState
from gdp.state.tables import common_tables, seconds_left
from gdp.trust.right import Right

if TYPE_CHECKING:  # a node loads its own core alone
    from gdp.rib.store import Store


def participant_tables(state: MemberState) -> dict[str, TableSource]:
    """Return the sources of the tables of a proxy."""
    member = state.member

    def names(_now: Timestamps) -> list[Row]:
        rows: list[Row] = []
        for each in member.attachment.advertisements:
            if each.right is not Right.ATTACH:
                word = "acknowledged" if each.is_taken else "waiting" if each.refused is None else each.refused.label
                label = state.local_name(each.subject.name)
                rows.append({"local": label, "right": each.right.value, "state": word, "name": each.subject.name})
        return sorted(rows, key=lambda row: (str(row["local"]), str(row["right"])))

    def peer(topic: Name, far: Name, kind: str, word: str, now: Timestamps) -> Row:
        clock = clock_fields(member.diagnostics.clock_of(far, now))
        return {"local": state.local_name(topic), "peer": far, "is": kind, "state": word, **clock, "name": topic}

    def peers(now: Timestamps) -> list[Row]:
        writers = [
            peer(each.topic, each.publisher, "writer", each.state.name.lower(), now)
            for each in member.subscriptions.writer_proxies()
        ]
        readers = [
            peer(each.topic, reader, "reader", "silent" if each.matched.is_suspended(reader) else "live", now)
            for each in list(member.publications)
            for reader in map(Name, each.matched.names())
        ]
        return sorted(writers + readers, key=lambda row: (str(row["local"]), row["is"], row["peer"]))

    return {**common_tables(state), "names": names, "peers": peers}


def rib_tables(state: RibState, store: Store) -> dict[str, TableSource]:
    """Return the sources of the tables of a RIB; one that stores its names in a cluster has no table of names."""
    from gdp.rib.store import MemoryStore

    if not isinstance(store, MemoryStore):
        return common_tables(state)

    def names(now: Timestamps) -> list[Row]:
        known = dict.fromkeys(name for name, _ in store.known())
        return [
            {
                "name": route.name,
                "advertiser": route.advertiser,
                "at": route.switch,
                "domain": state.domain_label(route.domain),
                "lease_s": seconds_left(route.expires_s, now),
            }
            for route in sorted(
                chain.from_iterable(map(store.routes, known)), key=lambda each: (each.name, each.advertiser)
            )
        ]

    return {**common_tables(state), "names": names}
