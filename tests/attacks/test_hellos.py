"""Floods of recorded or forged hellos: their cost is bounded, they take no port and draw no larger reply."""

from __future__ import annotations

import hashlib

import pytest

from gdp.control import admission, neighbour_table
from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import NO_KEEPALIVES, Hello, Timing, echo_of
from gdp.control.neighbour import NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.keys import PublicKey
from gdp.crypto.statements import parse
from gdp.errors import DropReason, RemoteError
from gdp.frame.codec import HEADER_BYTES, Kind, decode
from gdp.intervals import NEIGHBOUR
from gdp.sansio import ReceivedFrame
from tests.gdp.control.members import at, hello_in, node
from tests.gdp.control.members import hello_protocol as new_hello_protocol

A, B = node("a"), node("b")
MEMBERS = [node(f"m{number}", Role.PROXY) for number in range(40)]
STEP_S = 0.005
FAST = Timing(70, 70, 3)


def mac_of(label: object) -> bytes:
    return b"\x02" + hashlib.sha256(repr(label).encode()).digest()[:5]


def said(
    identity: Identity, nonce: bytes, sequence: int = 1, heard: tuple[bytes, ...] = (), key: Identity | None = None
) -> bytes:
    hello = Hello(
        nonce=nonce, sequence=sequence, heard=heard, mtu=1_500, digest=bytes(8), membership=identity.membership
    )
    return hello.to_wire(identity.name, (key or identity).key)


class Link:
    """Segment with HelloProtocol instances; each statement reaches all others at once.

    Attributes:
        sent: bytes that the first one sent.
        drops: reasons for which it refused statements.
    """

    def __init__(self, *ends: HelloProtocol) -> None:
        self.ends = list(ends)
        self.now_s = 0.0
        self.sent = 0
        self.drops: list[DropReason] = []

    def give(self, end: HelloProtocol, mac: bytes, frame: bytes) -> None:
        arrival, header = ReceivedFrame(0, mac, frame), decode(frame)
        try:
            if header.kind == Kind.COOKIE:
                end.receive_cookie(arrival, header)
                return
            if header.kind == Kind.KEEPALIVE:
                end.receive_keepalive(arrival, header, at(self.now_s))
                return
            wire = end.reception.join(arrival, header, self.now_s)
            if wire is not None:
                end.receive(arrival, parse(wire), at(self.now_s))
        except RemoteError as error:
            if end is self.ends[0]:
                self.drops.append(error.reason)

    def run(self, duration_s: float) -> None:
        """Advance the clock."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.now_s += STEP_S
            for end in self.ends:
                end.drop_silent(self.now_s)
                for transmit in end.hellos_to_send(self.now_s):
                    if end is self.ends[0]:
                        self.sent += sum(map(len, transmit.frames))
                    for other in self.ends:
                        if other is not end and transmit.mac in (b"\xff" * 6, other.ports[0].mac):
                            for frame in transmit.frames:
                                self.give(other, end.ports[0].mac, frame)

    def inject(self, statement: bytes, mac: bytes, pad: int = 0) -> int:
        """Play a hello to the first one; return its bytes."""
        (frame,) = ControlFragmenter(bytes(32), 9).split(Kind.HELLO, statement, 9_000)
        frame = frame.ljust(pad, b"\0")
        self.give(self.ends[0], mac, frame)
        return len(frame)

    def up(self, end: int = 0) -> set[bytes]:
        return {bytes(each.name) for each in self.ends[end].neighbours.all_up()}


@pytest.fixture
def verified(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that grows with each signature that is verified."""
    seen: list[int] = []
    verify = PublicKey._verify

    def counting(self: PublicKey, signature: bytes, data: bytes, scheme: object) -> None:
        seen.append(1)
        verify(self, signature, data, scheme)  # type: ignore[arg-type]

    monkeypatch.setattr(PublicKey, "_verify", counting)
    return seen


def pair(timing: Timing = NO_KEEPALIVES) -> Link:
    link = Link(new_hello_protocol(A, 1), new_hello_protocol(B, 2))
    for end in link.ends:
        end.set_timing(0, timing)
    link.run(1.0)
    assert link.up() == {bytes(B.name)}
    return link


@pytest.mark.parametrize("kind", ["wrong signature", "fresh", "recorded"])
@pytest.mark.parametrize("addresses", [1, 10_000])
def test_a20_a41_a_flood_of_hellos_costs_a_bounded_number_of_signatures(
    kind: str, addresses: int, verified: list[int]
) -> None:
    link = pair()
    strangers = [node(f"x{number}", Role.PROXY) for number in range(20)]
    key = node("other") if kind == "wrong signature" else None
    flood = [
        said(strangers[number % 20], number.to_bytes(8, "big"), 1, (link.ends[0].ports[0].echo,) * (number % 2), key)
        for number in range(400)
    ]
    if kind == "recorded":
        flood = flood[::2]
    verified.clear()
    for number in range(2_000):
        link.inject(flood[number % len(flood)], mac_of(number % addresses))
        if number % 10 == 9:
            link.run(STEP_S)
    # 1 s: the burst and the rate of strangers; each may be a certificate and a hello; B's own ones
    seconds = 2_000 / 10 * STEP_S
    most = 2 * (admission.STRANGER_HELLOS[1] + seconds * admission.STRANGER_HELLOS[0]) + 100
    assert len(verified) <= most
    assert bytes(B.name) in link.up()
    assert bytes(A.name) in link.up(1)


def test_a41_who_is_new_becomes_a_neighbour_in_a_flood_by_a_cookie() -> None:
    link = pair()
    flood = [said(A if number % 2 else MEMBERS[0], number.to_bytes(8, "big"), 1, (), B) for number in range(500)]
    new = node("new", Role.PROXY)

    def rain(count: int) -> None:
        for number in range(count):
            link.inject(flood[number % 500], mac_of(number))
            if number % 10 == 9:
                link.run(STEP_S)

    rain(2_000)
    assert link.ends[0].ports[0].admission.is_loaded(link.now_s)
    other = new_hello_protocol(new, 77)
    other.ports[0].hello_at_s = link.now_s
    link.ends.append(other)
    rain(4_000)  # two seconds
    assert bytes(new.name) in link.up()
    assert link.drops.count(DropReason.COOKIE_REQUIRED) > 1_000


def test_a41_a_cookie_counts_for_one_address_one_session_and_one_hello() -> None:
    link = pair()
    cookies, port = admission.Cookies(new_hello_protocol(A, 5)._random_bytes), link.ends[0].ports[0]
    mac, nonce = mac_of(1), b"n" * 8
    cookie = cookies.make(port.nonce, mac, 10.0)

    def shown(sequence: int, tag_sequence: int, asker: bytes = port.nonce) -> Hello:
        tag = admission.seal_cookie(cookie, nonce, tag_sequence)
        return Hello(
            nonce=nonce,
            sequence=sequence,
            heard=(),
            mtu=1_500,
            digest=bytes(8),
            membership=b"",
            cookies=((asker, tag),),
        )

    assert cookies.proves(shown(1, 1), port.nonce, mac, 11.0)
    assert cookies.proves(shown(2, 2), port.nonce, mac, 129.0)  # the secret before the present one
    assert not cookies.proves(shown(2, 1), port.nonce, mac, 11.0)
    assert not cookies.proves(shown(1, 1), port.nonce, mac_of(2), 11.0)
    assert not cookies.proves(shown(1, 1), b"o" * 8, mac, 11.0)
    assert not cookies.proves(shown(1, 1), port.nonce, mac, 11.0 + 3 * 120.0)


@pytest.mark.parametrize(("count", "pause_s"), [(80, 0.015), (16, 1.0)])
@pytest.mark.parametrize("pad", [0, 1_400])
def test_a20_what_goes_to_who_has_not_proved_itself_is_no_more_than_came(pad: int, count: int, pause_s: float) -> None:
    calm, link = pair(FAST), pair(FAST)
    for each in (calm, link):
        each.run(4.0)
        assert each.ends[0].ports[0].is_idle
        each.sent = 0
    received = 0
    for number in range(count):
        member = MEMBERS[number % 40]
        received += link.inject(said(member, number.to_bytes(8, "big")), mac_of(number), pad)
        link.run(pause_s)
    calm.run(count * pause_s)
    assert bytes(B.name) in link.up()
    assert link.sent - calm.sent <= received


def test_a20_who_is_new_waits_no_longer_than_before() -> None:
    link = pair()
    link.run(3.0)
    other = new_hello_protocol(node("new", Role.PROXY), 77)
    other.ports[0].hello_at_s = link.now_s
    link.ends.append(other)
    link.run(0.06)
    assert bytes(other._identity.name) in link.up()
    assert bytes(A.name) in link.up(2)


def test_a21_recorded_hellos_displace_no_neighbour_from_the_list_of_heard_nonces() -> None:
    members = [node(f"n{number}", Role.PROXY) for number in range(neighbour_table.NEIGHBOURS_MAX)]
    link = Link(new_hello_protocol(A, 1))
    port = link.ends[0].ports[0]
    nonces = {number: b"up" + number.to_bytes(6, "big") for number in range(len(members))}
    for number, member in enumerate(members):
        link.inject(said(member, nonces[number], 5, (port.echo,)), mac_of(number))
    assert len(link.up()) == len(members)
    for number, member in enumerate(members):  # an old one of each, and of strangers
        link.inject(said(member, b"of" + number.to_bytes(6, "big"), 1), mac_of(number))
    for number, member in enumerate(MEMBERS):
        link.inject(said(member, b"xx" + number.to_bytes(6, "big"), 1), mac_of(-1 - number))
    wire = link.ends[0]._hello(port, link.now_s)
    joined = b"".join(frame[HEADER_BYTES : HEADER_BYTES + decode(frame).length] for frame in wire)
    heard = Hello.from_fields(parse(joined).fields).heard
    assert {echo_of(nonces[number], member.name) for number, member in enumerate(members)} <= set(heard)


def test_a22_a_newcomer_is_accepted_while_recorded_hellos_are_played() -> None:
    link = pair()
    other = new_hello_protocol(node("new", Role.PROXY), 77)
    for number in range(64):
        link.inject(said(MEMBERS[number % 40], number.to_bytes(8, "big")), mac_of(number))
    link.run(NEIGHBOUR.refresh_s)
    other.ports[0].hello_at_s = link.now_s
    link.ends.append(other)
    for number in range(64, 192):
        if number % 2:
            link.inject(said(MEMBERS[number % 40], number.to_bytes(8, "big")), mac_of(number))
        link.run(STEP_S)
    assert bytes(other._identity.name) in link.up()
    assert bytes(B.name) in link.up()
    assert len(link.ends[0].ports[0].candidates()) <= neighbour_table.CANDIDATES_MAX


def test_a22_a_hello_of_an_earlier_life_played_at_another_port_lets_no_neighbour_go() -> None:
    link = pair()
    one = link.ends[0]
    one.add_port(1, b"\x02\x01\x01\x00\x00\x00", 1_500, 10, link.now_s)
    link.ends[1]._incarnation_id = bytes(15) + b"\x02"
    link.run(6.0)
    old = Hello(
        nonce=b"n" * 8,
        sequence=9,
        heard=(),
        mtu=1_500,
        digest=bytes(8),
        membership=B.membership,
        incarnation_id=bytes(15) + b"\x01",
    ).to_wire(B.name, B.key)
    one.receive(hello_in(old, 1, mac_of(1)), parse(old), at(link.now_s))
    one.drop_silent(link.now_s)
    (known,) = (each for each in one.ports[0].neighbours.values())
    assert known.state is NeighbourState.UP


def test_a20_a_second_node_of_an_identity_without_proof_draws_no_more_than_it_sent() -> None:
    calm, link = pair(FAST), pair(FAST)
    for each in (calm, link):
        each.run(4.0)
        each.sent = 0
    received = 0
    for number in range(16):  # later incarnations of the neighbour, at another address
        hello = Hello(
            nonce=number.to_bytes(8, "big"),
            sequence=1,
            heard=(),
            mtu=1_500,
            digest=bytes(8),
            membership=B.membership,
            incarnation_id=bytes(15) + b"\x09",
        )
        received += link.inject(hello.to_wire(B.name, B.key), mac_of(number))
        link.run(1.0)
    calm.run(16.0)
    assert bytes(B.name) in link.up()
    assert link.drops.count(DropReason.IN_USE) == 16
    assert link.sent - calm.sent <= received
