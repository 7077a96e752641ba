"""Preshared keys of tunnels: both ends have the same or come to it, and no tunnel stays dead because they differ."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gdp.control.hello import NONCE_BYTES, Hello
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.preshared_key import NO_KEY, SIZES, PresharedKeyAgreement
from gdp.crypto.kem import KEM_PUBLIC_BYTES
from gdp.crypto.statements import StatementType, parse, sign
from gdp.errors import DropReason, StatementError
from gdp.intervals import NEIGHBOUR
from tests.gdp.control.members import Nonces, at, hello_in, hello_protocol, node, statement_of_frames

ENDS = sorted((node("a"), node("b")), key=lambda each: each.name)
STEP_S = 0.05
DIAL_S = 1.0
REKEY_S, REJECT_S = 120.0, 180.0  # WireGuard paper, section 6.1
RETRY_S = 5.0  # REKEY_TIMEOUT
RECOVERY_S = (
    2 * NEIGHBOUR.lease_s + RETRY_S + 2.0
)  # the loss is seen at both ends, a handshake, the hellos of the agreement


class Lab:
    """Two ends of a tunnel; WireGuard is modelled: frames need a session, a handshake needs equal preshared keys."""

    def __init__(self) -> None:
        self.now_s, self.salt = 0.0, 0
        self.ends: list[HelloProtocol] = []
        self.keys = [NO_KEY, NO_KEY]  # that WireGuard has at either end
        self.lost = [False, False]  # what this end sends
        self.has_session = [False, False]
        self.session_s = self.tried_s = float("-inf")
        for number in (0, 1):
            self.ends.append(self._started(number))

    def _started(self, number: int) -> HelloProtocol:
        self.salt += 1
        made = hello_protocol(ENDS[number], 10 * self.salt + number)
        made.ports[0].mac = bytes([2, number, 0, 0, 0, 0])
        made.ports[0].hello_at_s = self.now_s
        made.preshared_keys.agree(0, ENDS[1 - number].name)
        return made

    def restart(self, number: int) -> None:
        """Kill an end: it has no session, no preshared key and no neighbour when it comes back."""
        self.ends[number], self.keys[number], self.has_session[number] = self._started(number), NO_KEY, False

    def is_up(self, number: int) -> bool:
        return self.ends[number].neighbours.get(0, ENDS[1 - number].name) is not None

    @property
    def is_working(self) -> bool:
        return self.is_up(0) and self.is_up(1) and self.keys[0] == self.keys[1] != NO_KEY

    def run(self, duration_s: float) -> None:
        end_s = self.now_s + duration_s
        while self.now_s < end_s:
            self.now_s += STEP_S
            for number, end in enumerate(self.ends):
                end.drop_silent(self.now_s)
                self.keys[number] = end.preshared_keys.key(0)
            self._shake_hands()
            for number, end in enumerate(self.ends):
                other = self.ends[1 - number]
                for transmit in end.hellos_to_send(self.now_s):
                    if all(self.has_session) and not self.lost[number]:
                        wire = statement_of_frames(transmit.frames)
                        other.receive(hello_in(wire, mac=end.ports[0].mac), parse(wire), at(self.now_s))

    def _shake_hands(self) -> None:
        age_s = self.now_s - self.session_s
        if age_s >= REJECT_S:
            self.has_session = [False, False]
        is_dialled = not self.is_up(0) or not self.is_up(1)
        is_due = age_s >= REKEY_S or not all(self.has_session) or is_dialled
        if is_due and self.now_s >= self.tried_s + (DIAL_S if is_dialled else RETRY_S):
            self.tried_s = self.now_s
            if not any(self.lost) and self.keys[0] == self.keys[1]:
                self.has_session, self.session_s = [True, True], self.now_s
            elif is_dialled:
                self.has_session[0] = False  # the end that dials forgets its session


@pytest.fixture
def lab() -> Lab:
    made = Lab()
    made.run(3)
    return made


def test_both_ends_of_a_tunnel_come_to_the_same_key(lab: Lab) -> None:
    assert lab.is_working


def test_an_agreed_key_stays_over_renewed_sessions(lab: Lab) -> None:
    keys = list(lab.keys)
    lab.run(REJECT_S + REKEY_S)
    assert lab.is_working
    assert lab.keys == keys


@pytest.mark.parametrize("number", [0, 1])
def test_a_restarted_end_gets_a_new_key_within_the_bound(lab: Lab, number: int) -> None:
    before = lab.keys[number]
    lab.restart(number)
    lab.run(RECOVERY_S)
    assert lab.is_working
    assert lab.keys[number] != before


@pytest.mark.parametrize("number", [0, 1])
def test_a_cut_in_one_direction_clears_the_key_at_both_ends(lab: Lab, number: int) -> None:
    lab.lost[number] = True
    lab.run(2 * NEIGHBOUR.lease_s + 0.5)
    assert lab.keys == [NO_KEY, NO_KEY]
    lab.lost[number] = False
    lab.run(RECOVERY_S)
    assert lab.is_working


EVENTS = st.one_of(
    st.tuples(st.just("restart"), st.integers(0, 1)),
    st.tuples(st.just("lose"), st.integers(0, 1)),
    st.tuples(st.just("heal"), st.integers(0, 1)),
    st.tuples(st.just("run"), st.sampled_from([STEP_S, 2 * STEP_S, 0.3, NEIGHBOUR.lease_s, 2 * NEIGHBOUR.lease_s])),
    st.tuples(st.just("rekey"), st.just(0)),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(EVENTS, max_size=25))
def test_after_any_order_of_losses_restarts_and_rekeys_a_tunnel_recovers_with_one_key(
    events: list[tuple[str, float]],
) -> None:
    lab = Lab()
    for event, value in events:
        match event:
            case "restart":
                lab.restart(int(value))
            case "lose" | "heal":
                lab.lost[int(value)] = event == "lose"
            case "rekey":
                lab.session_s = min(lab.session_s, lab.now_s - REKEY_S)
            case _:
                lab.run(value)
    lab.lost = [False, False]
    lab.run(RECOVERY_S)
    assert lab.is_working


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from(["first", "second", "reset first", "reset second", "drop"]), max_size=30))
def test_resets_of_either_end_at_any_point_are_overcome_by_three_exchanges(steps: list[str]) -> None:
    one, two = (PresharedKeyAgreement(ENDS[n].name, ENDS[1 - n].name, Nonces(n + 1)) for n in (0, 1))

    def heard(end: PresharedKeyAgreement, message: bytes) -> None:
        with contextlib.suppress(StatementError):  # sealed to the key before
            end.receive(message, *((b"1", b"2") if end is one else (b"2", b"1")))

    under_way = {id(one): b"", id(two): b""}
    for step in steps:
        if step == "reset first":
            one.reset()
        elif step == "reset second":
            two.reset()
        else:
            end, far = (one, two) if step == "first" else (two, one)
            if step != "drop":
                heard(end, under_way[id(end)])  # what was sent a step before arrives now
            under_way[id(end)] = far.message
    for _ in range(5):
        heard(two, one.message)
        heard(one, two.message)
    assert one.key == two.key != NO_KEY


def test_a_key_is_not_made_with_another_node_on_the_port(lab: Lab) -> None:
    lab.ends[0].preshared_keys.agree(0, node("c").name)
    lab.run(1)
    assert lab.ends[0].preshared_keys.key(0) == NO_KEY
    assert lab.ends[1].preshared_keys.key(0) == NO_KEY


def test_a_hello_that_may_be_recorded_begins_no_agreement() -> None:
    second, peer = hello_protocol(ENDS[1], 2), ENDS[0]
    second.preshared_keys.agree(0, peer.name)
    hello = Hello(
        nonce=b"n" * NONCE_BYTES,
        sequence=1,
        heard=(),  # it does not echo this session
        mtu=1_500,
        digest=bytes(8),
        membership=peer.membership,
        preshared=peer.kem.public.wire,
    )
    wire = hello.to_wire(peer.name, peer.key)
    second.receive(hello_in(wire), parse(wire), at(0.0))
    (transmit,) = second.hellos_to_send(1.0)
    assert "p" not in parse(statement_of_frames(transmit.frames)).fields


def test_hellos_of_other_ports_say_nothing_about_keys() -> None:
    hello = Hello(nonce=b"n" * NONCE_BYTES, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=b"")
    assert "p" not in parse(hello.to_wire(ENDS[0].name, ENDS[0].key)).fields


@pytest.mark.parametrize("message", [b"x", bytes(max(SIZES) + 1), 7, "x"])
def test_a_message_of_another_size_is_malformed(message: object) -> None:
    base = Hello(nonce=b"n" * NONCE_BYTES, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=b"")
    fields = {**parse(base.to_wire(ENDS[0].name, ENDS[0].key)).fields, "p": message}
    with pytest.raises(StatementError) as refused:
        Hello.from_fields(parse(sign(StatementType.HELLO, fields, ENDS[0].name, ENDS[0].key)).fields)
    assert refused.value.reason is DropReason.MALFORMED


def test_what_is_no_kem_key_is_refused_and_leaves_no_key() -> None:
    second = PresharedKeyAgreement(ENDS[1].name, ENDS[0].name, Nonces(1))
    with pytest.raises(StatementError) as refused:
        second.receive(b"\xff" * KEM_PUBLIC_BYTES, b"2", b"1")
    assert refused.value.reason is DropReason.MALFORMED
    assert (second.message, second.key) == (b"", NO_KEY)
