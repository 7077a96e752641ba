"""Protocol of a relay connection: both ends in memory, with a virtual clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from gdp.crypto.identity import Identity
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.frame.codec import Flag
from gdp.intervals import CONNECT_S
from gdp.links.relay_context import tls_context
from gdp.relay.connection import ConnectionState, RelayConnection
from gdp.relay.framing import PREFIX, ControlMessage, ControlType
from gdp.trust.domain import Policy
from tests.gdp.relay.ends import DAY_S, NOW, SETTINGS, Ends, at, domain, ends, exchange, member
from tests.gdp.relay.test_frame_queue import frame, numbers

OPEN, CLOSED = ConnectionState.OPEN, ConnectionState.CLOSED


@pytest.fixture
def pair() -> tuple[RelayConnection, RelayConnection]:
    """Open connection: the member's end, the border's end."""
    both = ends()
    client, server = both.client(), both.server()
    exchange(client, server)
    assert (client.state, server.state) == (OPEN, OPEN)
    return client, server


def test_both_ends_know_each_other_when_the_connection_is_open() -> None:
    both = ends()
    client, server = both.client(), both.server()
    exchange(client, server)
    assert client.peer is not None
    assert server.peer is not None
    assert (client.peer.name, server.peer.name) == (both.border.name, both.member.name)


def test_frames_cross_in_both_directions(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    for number in range(100):
        client.queue_frame(frame(number, size=1_364))
        server.queue_frame(frame(1_000 + number))
    to_client, to_server = exchange(client, server)
    assert numbers(to_server) == list(range(100))
    assert numbers(to_client) == list(range(1_000, 1_100))
    assert client.counters.frames_out == server.counters.frames_in == 100
    assert client.counters.bytes_out == server.counters.bytes_in == 100 * 1_364


def test_the_smaller_mtu_of_both_ends_applies() -> None:
    both = ends()
    client, server = both.client(replace(SETTINGS, mtu=9_000)), both.server()
    exchange(client, server)
    assert client.mtu == server.mtu == 1_350


def test_frames_that_may_not_pass_are_dropped_and_counted(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    client.queue_frame(bytes(12) + b"\x08\x00" + bytes(100))
    client.queue_frame(frame(1, size=1_365))
    assert exchange(client, server) == ([], [])
    assert (client.counters.foreign, client.counters.too_big) == (1, 1)


def test_foreign_frames_of_the_other_end_do_not_reach_the_device(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    foreign = bytes(12) + b"\x08\x00" + bytes(100)
    client._tls.write(PREFIX.pack(len(foreign)) + foreign)
    assert exchange(client, server) == ([], [])
    assert server.counters.foreign == 1


def test_an_oversized_length_prefix_ends_the_connection(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    client._tls.write(PREFIX.pack(0x7FFF))
    exchange(client, server)
    assert server.state is CLOSED
    assert "too-big" in server.reason


def test_a_frame_before_the_opening_does_not_pass() -> None:
    both = ends()
    client, server = both.client(), both.server()
    server.receive_bytes(client.data_to_send(0.0), at(0.0))
    client.receive_bytes(server.data_to_send(0.0), at(0.0))
    early = frame(1)
    client._tls.write(PREFIX.pack(len(early)) + early)
    server.receive_bytes(client.data_to_send(0.0), at(0.0))
    assert server.state is OPEN, "the opening came before the frame"
    again = both.client()
    other = both.server()
    other.receive_bytes(again.data_to_send(0.0), at(0.0))
    again._tls.receive_bytes(other.data_to_send(0.0))
    again._tls.write(PREFIX.pack(len(early)) + early)
    assert other.receive_bytes(again._tls.data_to_send(), at(0.0)) == []
    assert other.counters.foreign == 1


def test_an_unexpected_control_message_ends_the_connection(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    client._tls.write(ControlMessage.with_mtu(ControlType.OPEN, 1_350).to_wire())
    exchange(client, server)
    assert server.state is CLOSED
    assert "unexpected" in server.reason


def test_keepalives_hold_an_idle_connection(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    for step in range(1, 40):
        now_s = step * 0.25
        for end in pair:
            end.handle_timer(now_s)
        exchange(client, server, now_s)
    assert (client.state, server.state) == (OPEN, OPEN)


def test_silence_of_the_other_end_is_noticed_within_a_second(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, _ = pair
    client.handle_timer(0.99)
    assert client.state is OPEN
    assert client.get_timer(0.99) == 1.0
    client.handle_timer(1.0)
    assert client.state is CLOSED
    assert client.reason == "no sign of life for 1 s"


def test_a_handshake_that_does_not_proceed_ends() -> None:
    server = ends().server()
    assert server.get_timer(0.0) == CONNECT_S
    server.handle_timer(CONNECT_S)
    assert server.state is CLOSED


def test_a_rate_bounds_what_leaves_in_a_second() -> None:
    both = ends()
    client, server = both.client(), both.server(replace(SETTINGS, rate=1_000_000.0))
    exchange(client, server)
    sent, now_s = 0, 0.0
    while now_s < 2.0:
        for number in range(50):
            server.queue_frame(frame(number, size=1_364))
        while data := server.data_to_send(now_s):
            sent += sum(map(len, client.receive_bytes(data, at(now_s))))
        now_s += 0.01
    assert 2_000_000 <= sent <= 2_000_000 + 250_000 + 20_000, "two seconds and one burst"


def test_a_rate_pauses_the_reading() -> None:
    both = ends()
    client, server = both.client(), both.server(replace(SETTINGS, rate=100_000.0))
    exchange(client, server)
    for number in range(60):
        client.queue_frame(frame(number, size=1_000))
    exchange(client, server)
    assert server.pause_until_s(0.0) == pytest.approx(0.272, abs=0.01), "27,232 bytes more than the burst"
    assert server.pause_until_s(1.0) == 1.0


def test_a_slow_end_costs_a_bounded_queue_and_no_more(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    for number in range(20_000):
        server.queue_frame(frame(number, size=1_364))
    assert server.queued_bytes <= SETTINGS.queue_bytes
    _, _ = exchange(client, server)
    counters = server.counters
    assert counters.full + counters.frames_out == 20_000


def test_a_reliable_frame_waits_where_a_best_effort_one_gives_way(
    pair: tuple[RelayConnection, RelayConnection],
) -> None:
    client, server = pair
    server.queue_frame(frame(1, Flag.RELIABLE))
    for number in range(2, 2_000):
        server.queue_frame(frame(number, size=1_364))
    to_client, _ = exchange(client, server)
    assert 1 in numbers(to_client)
    assert 2 not in numbers(to_client)


def test_bytes_after_the_end_have_no_effect(pair: tuple[RelayConnection, RelayConnection]) -> None:
    client, server = pair
    client.queue_frame(frame(1))
    data = client.data_to_send(0.0)
    server.close("done")
    assert server.receive_bytes(data, at(0.0)) == []
    assert server.reason == "done"


def test_a_member_of_the_former_root_and_one_of_its_successor_connect() -> None:
    former = domain("lab")
    old = member(former, "old")
    successor = former.succeed(SigningKey.generate(), Validity.lasting(NOW, 400 * DAY_S), int(NOW + 30 * DAY_S))
    new = member(successor, "new", begins_s=NOW)
    renewed = Policy(successor.root)
    for border, joining in ((old, new), (new, old)):
        both = Ends(border=border, member=joining, border_policy=renewed, member_policy=renewed)
        client, server = both.client(), both.server()
        exchange(client, server)
        assert (client.state, server.state) == (OPEN, OPEN)


def test_a_key_in_a_token_is_refused_with_a_reason() -> None:
    both = ends()

    class TokenKey(SigningKey):
        """Key that never leaves its token."""

        def __init__(self, public: PublicKey) -> None:
            self.public = public

        def sign(self, data: bytes) -> bytes:
            raise NotImplementedError

        def sign_digest(self, digest: bytes) -> bytes:
            raise NotImplementedError

        def to_file(self, protect: Callable[[bytes], bytes] | None = None) -> bytes:
            raise NotImplementedError

    found = both.member
    guarded = Identity(found.member, found.root, TokenKey(found.key.public), found.kem)
    with pytest.raises(LocalError, match="TLS cannot use the key in a token"):
        tls_context(guarded, both.member_policy, is_server=False)
