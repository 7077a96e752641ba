"""Neighbour discovery: how a node becomes a neighbour and stays one, and the value of recorded hellos."""

from __future__ import annotations

from contextlib import suppress
from itertools import product

import pytest

from gdp.control.hello import ECHO_BYTES, Hello
from gdp.control.hello_port import HelloPort
from gdp.control.join import Join
from gdp.control.neighbour import TRANSITIONS, Neighbour, NeighbourEvent, NeighbourState
from gdp.control.neighbour_discovery import PADDED_BYTES, HelloProtocol
from gdp.control.neighbour_table import NEIGHBOURS_MAX, Change
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import parse
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, StatementError
from gdp.intervals import NEIGHBOUR
from gdp.names import ZERO, Name
from gdp.trust.domain import Policy
from tests.gdp.control.members import (
    CLOUD,
    ELSEWHERE,
    SCHOOL,
    UNIX_S,
    YEAR,
    at,
    hello_in,
    hello_protocol,
    node,
    statement_of,
)

A, B = node("a"), node("b")
UP = NeighbourState.UP


def hellos(of: HelloProtocol, now_s: float) -> list[bytes]:
    """Return the statements that a HelloProtocol sends now."""
    return [statement_of(frame) for transmit in of.hellos_to_send(now_s) for frame in transmit.frames]


def hear(listener: HelloProtocol, statement: bytes, now_s: float, mac: bytes = b"\x02far\x00\x00") -> Change | None:
    return listener.receive(hello_in(statement, mac=mac, padded_bytes=PADDED_BYTES), parse(statement), at(now_s))


def refusal(listener: HelloProtocol, statement: bytes, now_s: float = 0.0) -> DropReason:
    with pytest.raises(StatementError) as caught:
        hear(listener, statement, now_s)
    return caught.value.reason


def greet(one: HelloProtocol, two: HelloProtocol, begin_s: float, rounds: int = 4) -> list[bytes]:
    """Let two HelloProtocol instances exchange statements; return all that the second sent."""
    said = []
    for step in range(rounds):
        now_s = begin_s + step * NEIGHBOUR.refresh_s
        for hello in hellos(one, now_s):
            hear(two, hello, now_s)
        for hello in hellos(two, now_s):
            said.append(hello)
            hear(one, hello, now_s)
    return said


def pair() -> tuple[HelloProtocol, HelloProtocol, list[bytes]]:
    """Return two HelloProtocol instances that are up, and all that the second sent."""
    one, two = hello_protocol(A, 1), hello_protocol(B, 2)
    return one, two, greet(one, two, 0.0)


def forged(identity: Identity = B, sequence: int = 1, heard: tuple[bytes, ...] = (), nonce: bytes = b"n" * 8) -> bytes:
    hello = Hello(
        nonce=nonce, sequence=sequence, heard=heard, mtu=1_500, digest=bytes(8), membership=identity.membership
    )
    return hello.to_wire(identity.name, identity.key)


def test_every_state_answers_every_event() -> None:
    assert set(TRANSITIONS) == set(product(NeighbourState, NeighbourEvent))


@pytest.mark.parametrize("state", list(NeighbourState))
def test_only_an_echo_brings_a_neighbour_up(state: NeighbourState) -> None:
    ups = {event for event in NeighbourEvent if TRANSITIONS[state, event] is UP}
    assert ups == {NeighbourEvent.TWO_WAY}


@pytest.mark.parametrize("event", [NeighbourEvent.SILENCE, NeighbourEvent.LINK_LOST])
def test_silence_and_a_lost_link_end_every_state(event: NeighbourEvent) -> None:
    assert {TRANSITIONS[state, event] for state in NeighbourState} == {NeighbourState.GONE}


def test_two_that_hear_each_other_are_neighbours() -> None:
    one, two, _ = pair()
    assert [n.name for n in one.neighbours.all_up()] == [B.name]
    assert [n.name for n in two.neighbours.all_up()] == [A.name]


def test_who_is_heard_but_does_not_hear_is_no_neighbour() -> None:
    one, two = hello_protocol(A, 1), hello_protocol(B, 2)
    for step in range(4):
        for hello in hellos(two, step * NEIGHBOUR.refresh_s):
            hear(one, hello, step * NEIGHBOUR.refresh_s)
    assert one.neighbours.all_up() == []


def test_a_hello_played_back_at_once_is_refused() -> None:
    one, _, said = pair()
    assert refusal(one, said[-1], 1.0) is DropReason.REPLAYED


def test_a_recorded_hello_revives_no_neighbour_after_its_silence() -> None:
    one, _, said = pair()
    one.drop_silent(5.0)
    assert one.neighbours.all_up() == []
    assert {refusal(one, hello, 5.1) for hello in said} == {DropReason.REPLAYED}
    assert one.neighbours.all_up() == []


def test_a_recorded_hello_of_an_older_session_neither_raises_nor_fells_nor_moves_anybody() -> None:
    one, _, said = pair()
    again = hello_protocol(B, 3)
    greet(one, again, 2.0)
    before = [(n.nonce, n.mac) for n in one.neighbours.all_up()]
    for hello in said:
        assert refusal(one, hello, 3.1) is DropReason.REPLAYED
    assert [(n.nonce, n.mac) for n in one.neighbours.all_up()] == before != []


def test_a_recorded_hello_of_a_session_of_long_ago_ends_no_adjacency() -> None:
    one, _, _ = pair()
    assert hear(one, forged(), 1.0) is None
    assert [n.name for n in one.neighbours.all_up()] == [B.name]


def test_a_neighbour_is_back_after_a_silence_without_a_new_session() -> None:
    one, two, _ = pair()
    one.drop_silent(5.0)
    two.drop_silent(5.0)
    greet(one, two, 5.0)
    assert [n.name for n in one.neighbours.all_up()] == [B.name]


def test_a_restart_in_an_instant_is_noticed() -> None:
    one, _, _ = pair()
    again = hello_protocol(B, 3)
    changes = []
    for step in range(4):
        now_s = 1.0 + step * NEIGHBOUR.refresh_s
        for hello in hellos(one, now_s):
            hear(again, hello, now_s)
        changes += [hear(one, hello, now_s) for hello in hellos(again, now_s)]
    assert [(each[0].name, each[1]) for each in changes if each is not None] == [(B.name, NeighbourState.GONE)]


def test_a_neighbour_that_falls_silent_is_let_go() -> None:
    one, _, _ = pair()
    heard_s = one.neighbours.all_up()[0].heard_s
    assert one.drop_silent(heard_s + NEIGHBOUR.lease_s - 0.01) == []
    assert [(n.name, before) for n, before in one.drop_silent(heard_s + NEIGHBOUR.lease_s)] == [(B.name, UP)]


def test_a_lost_link_takes_its_neighbours_away_at_once() -> None:
    one, _, _ = pair()
    assert [n.name for n, _ in one.port_changed(0, False, 1.0)] == [B.name]
    assert hear(one, forged(), 1.0) is None


def test_after_a_lost_link_no_hello_of_before_counts() -> None:
    one, _, said = pair()
    one.port_changed(0, False, 1.0)
    one.port_changed(0, True, 1.1)
    for hello in said:
        hear(one, hello, 1.2)
    assert one.neighbours.all_up() == []


def test_a_member_of_a_trusted_domain_is_heard() -> None:
    one, two = hello_protocol(A, 1), hello_protocol(node("c", domain=CLOUD), 2, Policy(CLOUD.root, [SCHOOL.root]))
    greet(one, two, 0.0)
    assert [n.domain for n in one.neighbours.all_up()] == [CLOUD.root.domain]


def test_a_strangers_domain_is_refused() -> None:
    assert refusal(hello_protocol(A, 1), forged(node("x", domain=ELSEWHERE))) is DropReason.WRONG_DOMAIN


def test_an_expired_certificate_is_refused() -> None:
    expired = node("old", validity=Validity(YEAR.not_before_unix_s, UNIX_S - 4_000))
    assert refusal(hello_protocol(A, 1), forged(expired)) is DropReason.EXPIRED


def test_a_neighbour_whose_certificate_runs_out_falls_silent() -> None:
    one = hello_protocol(A, 1)
    short = node("short", validity=Validity(YEAR.not_before_unix_s, UNIX_S + 10))
    hear(one, forged(short, heard=(one.ports[0].echo,)), 0.0)
    assert len(one.neighbours.all_up()) == 1
    late = forged(short, sequence=2)
    with pytest.raises(StatementError) as caught:
        one.receive(hello_in(late), parse(late), at(0.5, UNIX_S + 4_000))
    assert caught.value.reason is DropReason.EXPIRED


def test_a_hello_under_anothers_certificate_is_refused() -> None:
    wire = Hello(nonce=b"n" * 8, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=B.membership).to_wire(
        A.name, A.key
    )
    assert refusal(hello_protocol(node("c"), 1), wire) is DropReason.BAD_CERTIFICATE


def test_a_hello_signed_by_another_key_is_refused_and_leaves_nothing() -> None:
    one = hello_protocol(A, 1)
    wire = Hello(nonce=b"n" * 8, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=B.membership).to_wire(
        B.name, node("x").key
    )
    assert refusal(one, wire) is DropReason.BAD_SIGNATURE
    assert one.ports[0].neighbours == {}


def test_ones_own_hello_come_back_is_not_for_us() -> None:
    assert refusal(hello_protocol(A, 1), forged(A)) is DropReason.NOT_FOR_US


def test_a_port_has_so_many_neighbours_and_no_more() -> None:
    one = hello_protocol(A, 1)
    heard = (one.ports[0].echo,)
    for number in range(NEIGHBOURS_MAX):
        hear(one, forged(node(f"n{number}", Role.PROXY), heard=heard), number / 100, b"\x02far\x00" + bytes([number]))
    with pytest.raises(StatementError) as caught:
        hear(one, forged(heard=heard), 1.0, b"\x02other")
    assert caught.value.reason is DropReason.QUOTA


def test_a_neighbours_mtu_is_the_smaller_of_both_ends() -> None:
    one, two = hello_protocol(A, 1), hello_protocol(B, 2)
    two.ports[0].own_mtu = 1_000
    greet(one, two, 0.0)
    assert [n.mtu for n in one.neighbours.all_up()] == [1_000]


def resize(one: HelloProtocol, mtu: int, now_s: float, cost: int = 10) -> list[Change]:
    return one.add_port(0, one.ports[0].mac, mtu, cost, now_s)


def test_a_port_that_changes_keeps_its_session_and_tells_what_it_changed() -> None:
    one, _, _ = pair()
    nonce = one.ports[0].nonce
    changes = resize(one, 1_200, 2.0)
    assert [(n.name, n.mtu, n.state, before) for n, before in changes] == [(B.name, 1_200, UP, UP)]
    assert (one.ports[0].nonce, one.ports[0].mtu) == (nonce, 1_200)
    assert len(resize(one, 1_200, 2.1, cost=20)) == 1
    assert resize(one, 1_200, 2.2, cost=20) == []


def test_a_port_that_changed_says_so_at_once_and_the_far_end_tells() -> None:
    one, two, _ = pair()
    resize(one, 1_200, 1.0)
    changes = [hear(two, hello, 1.0) for hello in hellos(one, 1.0)]
    assert [(each[0].mtu, each[0].state, each[1]) for each in changes if each is not None] == [(1_200, UP, UP)]
    assert two.ports[0].mtu == 1_200


@pytest.mark.parametrize("first", [0, 1])
def test_a_link_grows_when_both_ends_have_whichever_is_first(first: int) -> None:
    one, two, _ = pair()
    ends = [one, two]
    seen = []
    for end in (ends[first], ends[1 - first]):
        resize(end, 9_000, 1.0)
        greet(one, two, 1.0, rounds=1)
        seen.append([n.mtu for each in ends for n in each.neighbours.all_up()])
    assert seen == [[1_500, 1_500], [9_000, 9_000]]


def test_hellos_fit_the_narrowest_end_that_was_heard() -> None:
    one = hello_protocol(A, 1)
    resize(one, 65_000, 0.0)
    hello = Hello(nonce=b"n" * 8, sequence=1, heard=(), mtu=576, digest=bytes(8), membership=B.membership)
    hear(one, hello.to_wire(B.name, B.key), 0.0)
    frames = [frame for transmit in one.hellos_to_send(0.1) for frame in transmit.frames]
    assert len(frames) > 1
    assert max(map(len, frames)) <= 576


def test_a_neighbour_that_announces_to_take_nothing_is_taken_for_the_narrowest_there_may_be() -> None:
    one = hello_protocol(A, 1)
    hello = Hello(
        nonce=b"n" * 8, sequence=1, heard=(one.ports[0].echo,), mtu=0, digest=bytes(8), membership=B.membership
    )
    hear(one, hello.to_wire(B.name, B.key), 0.0)
    assert one.ports[0].mtu == 576


def test_who_was_only_heard_makes_no_link_narrow() -> None:
    one = hello_protocol(A, 1)
    hello = Hello(nonce=b"n" * 8, sequence=1, heard=(), mtu=576, digest=bytes(8), membership=B.membership)
    hear(one, hello.to_wire(B.name, B.key), 0.0)
    assert one.ports[0].mtu == 1_500


def test_a_narrow_neighbour_that_is_gone_leaves_the_link_as_wide_as_before() -> None:
    one, two, _ = pair()
    resize(two, 1_000, 1.0)
    greet(one, two, 1.0)
    before = one.ports[0].mtu
    one.drop_silent(10.0)
    assert (before, one.ports[0].mtu) == (1_000, 1_500)


def test_another_address_removes_the_neighbours_and_starts_again() -> None:
    one, _, _ = pair()
    nonce = one.ports[0].nonce
    changes = one.add_port(0, b"\x02new\x00\x00", 1_500, 10, 2.0)
    assert [(n.name, n.state, before) for n, before in changes] == [(B.name, NeighbourState.GONE, UP)]
    assert one.neighbours.all_up() == []
    assert one.ports[0].nonce != nonce


def test_who_is_new_is_answered_before_the_next_hello_is_due() -> None:
    one = hello_protocol(A, 1)
    hellos(one, 0.0)
    hear(one, forged(), 0.05)
    timeout = one.get_timer()
    assert timeout is not None
    assert timeout <= 0.06


def test_two_hellos_may_leave_at_once_and_then_one_each_20_ms() -> None:
    one, said_s = hello_protocol(A, 1), list[float]()
    for ms in range(1_000):
        with suppress(StatementError):  # so many are not verified
            hear(one, forged(nonce=ms.to_bytes(8, "big")), ms / 1_000)
        if hellos(one, ms / 1_000):
            said_s.append(ms / 1_000)
    assert said_s[1] - said_s[0] <= 0.001
    assert len(said_s) <= 52


def test_a_hello_protocol_never_wants_to_be_called_in_the_past() -> None:
    one, _, _ = pair()
    for step in range(40):
        now_s = 1.0 + step / 10
        one.drop_silent(now_s)
        hellos(one, now_s)
        due_s = one.get_timer()
        assert due_s is not None
        assert due_s > now_s


def neighbour_of(label: bytes, nonce: bytes = b"n" * 8) -> Neighbour:
    return Neighbour(
        name=Name(label * 32),
        role=Role.SWITCH,
        domain=SCHOOL.root.domain,
        key=A.key.public,
        port=0,
        mac=b"",
        mtu=1_500,
        nonce=nonce,
        sequence=0,
        digest=b"",
        heard_s=0.0,
    )


def is_taken(
    port: HelloPort, session: bytes, neighbour: Neighbour, sequence: int, sender_session: bytes = b"n" * 8
) -> bool:
    join = Join(
        topic=ZERO,
        publisher=ZERO,
        switch=ZERO,
        domain=ZERO,
        allowed=frozenset(),
        mtu=1_500,
        lease_s=1.0,
        evidence=b"",
        session=session,
        sequence=sequence,
        sender_session=sender_session,
    )
    try:
        port.receive_join(join, neighbour)
    except StatementError as error:
        return error.reason is not DropReason.REPLAYED
    return True


def test_a_join_counts_once() -> None:
    port = hello_protocol(A, 1).ports[0]
    taken = [is_taken(port, port.echo, neighbour_of(b"b"), sequence) for sequence in (5, 4, 5, 6, 4)]
    assert taken == [True, True, False, True, False]


def test_a_join_of_another_session_is_refused() -> None:
    port = hello_protocol(A, 1).ports[0]
    assert not is_taken(port, bytes(ECHO_BYTES), neighbour_of(b"b"), 1)


def test_joins_of_two_neighbours_do_not_hinder_each_other() -> None:
    port = hello_protocol(A, 1).ports[0]
    both = neighbour_of(b"a", b"a" * 8), neighbour_of(b"b", b"b" * 8)
    assert [is_taken(port, port.echo, each, 1, each.nonce) for each in both] == [True, True]


def test_a_join_counts_from_the_start_in_a_new_session_of_its_sender_and_one_of_the_last_session_not_at_all() -> None:
    port, before, after = hello_protocol(A, 1).ports[0], neighbour_of(b"b"), neighbour_of(b"b", b"o" * 8)
    assert is_taken(port, port.echo, before, 1_000)
    assert is_taken(port, port.echo, after, 1, b"o" * 8)
    assert not is_taken(port, port.echo, after, 1_001)
