"""Member that presents another's nonce as its own: H2 and J2 of docs/model."""

from __future__ import annotations

import pytest

from gdp.control.join import Join
from gdp.control.neighbour import NeighbourState
from gdp.crypto.statements import parse
from gdp.errors import StatementError
from gdp.intervals import NEIGHBOUR
from gdp.names import ZERO
from tests.gdp.control.members import hello_protocol, node
from tests.gdp.control.test_neighbour_discovery import A, B, forged, greet, hear, hellos

MALLORY = node("mallory")


def test_x01_a_neighbour_that_heard_our_nonce_from_another_member_only_does_not_come_up() -> None:
    one, two = hello_protocol(A, 1), hello_protocol(B, 2)
    hellos(one, 0.0)  # two never receives these
    nonce = one.ports[0].nonce
    hear(two, forged(MALLORY, nonce=nonce), 0.0, mac=b"\x02mall\x00")
    for hello in hellos(two, NEIGHBOUR.refresh_s):
        hear(one, hello, NEIGHBOUR.refresh_s)
    assert B.name in one.ports[0].neighbours, "its hello is a good one"
    assert one.ports[0].neighbours[B.name].state is not NeighbourState.UP


def test_x05_a_join_to_another_member_that_said_our_nonce_is_not_taken() -> None:
    one, two = hello_protocol(A, 1), hello_protocol(B, 2)
    greet(one, two, 0.0)
    ours = two.ports[0].nonce
    hear(one, forged(MALLORY, nonce=ours), 1.0, mac=b"\x02mall\x00")
    theirs = one.ports[0].neighbours[MALLORY.name]
    # Statement that ``one`` signs for Mallory, as MulticastTrees does: its session is the nonce of Mallory's hellos.
    session = one.ports[0].nonce
    domain = B.member.domain
    join = Join(
        topic=B.name,
        publisher=B.name,
        switch=B.name,
        domain=domain,
        allowed=frozenset(),
        mtu=1_500,
        lease_s=5.0,
        evidence=b"",
        session=theirs.echo,
        sequence=1,
        version=0,
        backup_for=ZERO,
        sender_session=session,
    )
    wire = join.to_wire(A.name, A.key)
    with pytest.raises(StatementError):
        two.ports[0].receive_join(Join.from_fields(parse(wire).fields), two.ports[0].neighbours[A.name])


def test_x02_a_member_that_said_anothers_nonce_with_a_high_number_does_not_shut_it_out() -> None:
    one, two = hello_protocol(A, 1), hello_protocol(B, 2)
    (hello,) = hellos(two, 0.0)
    proof = (one.ports[0].echo,)  # a member on the link can be a neighbour
    hear(one, forged(MALLORY, sequence=2**63, heard=proof, nonce=two.ports[0].nonce), 0.0, mac=b"\x02mall\x00")
    one.drop_silent(2 * NEIGHBOUR.lease_s)  # the member falls silent, and its session is remembered
    hear(one, hello, 2 * NEIGHBOUR.lease_s)
    assert B.name in one.ports[0].neighbours
