"""Observed addresses: a hello tells each neighbour on a tunnel where the sender sees it."""

from __future__ import annotations

import pytest

from gdp.control.endpoints import Endpoint
from gdp.control.hello import COOKIE_BYTES, NONCE_BYTES, OBSERVED_MAX, Hello
from gdp.control.neighbour import NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType, parse, sign
from gdp.errors import DropReason, StatementError
from gdp.intervals import NEIGHBOUR
from tests.gdp.control.members import at, hello_in, hello_protocol, node, statement_of

A, B, C = node("a"), node("b"), node("c")
SEEN, MOVED = Endpoint("192.0.2.1", 40_000), Endpoint("2001:db8::7", 50_000)
STEP_S = 0.05


class Tunnel:
    """Hello protocols on one segment, A first."""

    def __init__(self, *identities: Identity) -> None:
        self.ends = [hello_protocol(identity, number) for number, identity in enumerate(identities, 1)]
        self.now_s = 0.0
        self.run(2.0)

    def run(self, duration_s: float, silent: HelloProtocol | None = None) -> None:
        """Let time pass; ``silent`` sends nothing."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s:
            self.now_s += STEP_S
            for number, end in enumerate(self.ends, 1):
                end.drop_silent(self.now_s)
                for transmit in end.hellos_to_send(self.now_s):
                    for frame in transmit.frames if end is not silent else ():
                        statement = statement_of(frame)
                        for other in self.ends:
                            if other is not end:
                                mac = bytes([2, number, 0, 0, 0, 0])
                                other.receive(hello_in(statement, mac=mac), parse(statement), at(self.now_s))


def test_a_neighbour_learns_where_the_other_end_sees_it() -> None:
    tunnel = Tunnel(A, B)
    one, two = tunnel.ends
    one.set_observed(0, B.name, SEEN)
    tunnel.run(0.2)
    assert two.neighbours.observed_addresses() == {(0, A.name): SEEN}
    assert one.neighbours.observed_addresses() == {}


def test_a_changed_address_arrives_at_once_and_a_lost_one_is_unlearnt() -> None:
    tunnel = Tunnel(A, B)
    one, two = tunnel.ends
    one.set_observed(0, B.name, SEEN)
    tunnel.run(5)
    one.set_observed(0, B.name, MOVED)
    tunnel.run(0.15)
    assert two.neighbours.observed_addresses() == {(0, A.name): MOVED}
    one.set_observed(0, B.name, None)
    tunnel.run(0.15)
    assert two.neighbours.observed_addresses() == {}


def test_each_neighbour_of_a_port_learns_its_own_address() -> None:
    tunnel = Tunnel(A, B, C)
    one, two, three = tunnel.ends
    one.set_observed(0, B.name, SEEN)
    one.set_observed(0, C.name, MOVED)
    tunnel.run(0.5)
    assert two.neighbours.observed_addresses() == {(0, A.name): SEEN}
    assert three.neighbours.observed_addresses() == {(0, A.name): MOVED}


def test_nothing_is_observed_of_a_node_that_is_no_neighbour() -> None:
    tunnel = Tunnel(A, B)
    tunnel.ends[0].set_observed(0, C.name, SEEN)
    tunnel.ends[0].set_observed(7, B.name, SEEN)
    tunnel.run(1)
    assert tunnel.ends[1].neighbours.observed_addresses() == {}


def test_an_address_observed_by_a_lost_neighbour_is_forgotten_at_both_ends() -> None:
    tunnel = Tunnel(A, B)
    one, two = tunnel.ends
    one.set_observed(0, B.name, SEEN)
    tunnel.run(1)
    tunnel.run(2 * NEIGHBOUR.lease_s, silent=one)
    assert two.neighbours.observed_addresses() == {}
    tunnel.run(2)
    assert one.neighbours.get(0, B.name) is not None


def test_an_address_observed_by_a_node_that_is_not_proven_present_is_not_believed() -> None:
    two = hello_protocol(B, 2)
    hello = Hello(
        nonce=b"n" * NONCE_BYTES,
        sequence=1,
        heard=(),  # it does not echo this session: it may be recorded
        mtu=1_500,
        digest=bytes(8),
        membership=A.membership,
        observed=((two.ports[0].nonce, SEEN),),
    )
    wire = hello.to_wire(A.name, A.key)
    two.receive(hello_in(wire), parse(wire), at(0.0))
    assert two.ports[0].neighbours[A.name].state is NeighbourState.HEARD
    assert two.neighbours.observed_addresses() == {}


def test_an_address_observed_in_another_session_is_not_believed() -> None:
    two = hello_protocol(B, 2)
    port = two.ports[0]
    hello = Hello(
        nonce=b"n" * NONCE_BYTES,
        sequence=1,
        heard=(port.echo,),
        mtu=1_500,
        digest=bytes(8),
        membership=A.membership,
        observed=((b"o" * NONCE_BYTES, SEEN),),
    )
    wire = hello.to_wire(A.name, A.key)
    two.receive(hello_in(wire), parse(wire), at(0.0))
    assert port.neighbours[A.name].state is NeighbourState.UP
    assert two.neighbours.observed_addresses() == {}


@pytest.mark.parametrize(
    "observed",
    [[b""], [bytes(NONCE_BYTES + 5)], [bytes(NONCE_BYTES + 6)], [bytes(NONCE_BYTES + COOKIE_BYTES)], [7], "x"],
)
def test_a_malformed_observed_endpoint_is_refused(observed: object) -> None:
    base = Hello(
        nonce=b"n" * NONCE_BYTES, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=A.membership
    ).to_wire(A.name, A.key)
    fields = {**parse(base).fields, "o": observed}
    with pytest.raises(StatementError) as refused:
        Hello.from_fields(parse(sign(StatementType.HELLO, fields, A.name, A.key)).fields)
    assert refused.value.reason is DropReason.MALFORMED


def test_a_hello_states_a_bounded_number_of_endpoints() -> None:
    many = tuple((bytes([number]) * NONCE_BYTES, SEEN) for number in range(1, 40))
    hello = Hello(nonce=b"n" * 8, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=b"", observed=many)
    assert len(Hello.from_fields(parse(hello.to_wire(A.name, A.key)).fields).observed) == OBSERVED_MAX
