"""Nodes on the wire: changes keep two states equal, and neither order nor size of a graph matters."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import RemoteError
from proxy.endpoints.core.endpoint import Role
from proxy.endpoints.core.qos import default
from proxy.wire.node import NodeEntity, NodesChange, NodeSet, NodesWanted

ENTITY = NodeEntity(Role.PUBLISHES, "/chatter", "std_msgs/msg/String", default())
NODES = st.dictionaries(
    st.sampled_from(["/a", "/b", "/c"]),
    st.lists(st.sampled_from([ENTITY, ENTITY._replace(name="/other", qos=None)]), max_size=2).map(tuple),
)


@given(st.lists(NODES, min_size=1, max_size=5))
def test_who_applies_every_change_has_the_same_state(states: list[dict[str, tuple[NodeEntity, ...]]]) -> None:
    server, client = NodeSet(), NodeSet()
    for state in states:
        client.apply(NodesChange.from_cbor(server.replace(state).to_cbor()))
        assert (client.nodes, client.digest) == (server.nodes, server.digest) == (state, server.digest)


def test_a_change_of_another_state_changes_nothing_and_the_whole_state_repairs_it() -> None:
    server, client = NodeSet(), NodeSet()
    client.apply(server.replace({"/a": (ENTITY,)}))
    server.replace({"/a": (ENTITY,), "/b": ()})  # lost
    client.apply(server.replace({"/c": ()}))
    assert client.nodes == {"/a": (ENTITY,)}
    client.apply(server.whole())
    assert (client.nodes, client.digest) == (server.nodes, server.digest)


def test_a_graph_of_ten_thousand_entities_can_be_read() -> None:
    server = NodeSet()
    server.replace({f"/n{number}": (ENTITY,) * 100 for number in range(100)})
    assert NodesChange.from_cbor(server.whole().to_cbor()) == server.whole()


@given(st.binary(max_size=64))
def test_other_bytes_are_refused(wire: bytes) -> None:
    for kind in (NodesChange, NodesWanted):
        try:
            kind.from_cbor(wire)
        except RemoteError:
            continue
        assert wire


def test_what_is_wanted_survives_the_wire() -> None:
    wanted = NodesWanted((("topic", "/chatter"), ("service", "/plan")))
    assert NodesWanted.from_cbor(wanted.to_cbor()) == wanted
    with pytest.raises(RemoteError):
        NodesWanted.from_cbor(wanted.to_cbor().replace(b"topic", b"tipoc"))
