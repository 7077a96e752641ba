"""Bodies of every statement of the control plane: each reads back as written, and refuses anything else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.control.diagnostic_bodies import DiagnosticReply, DiagnosticRequest, cut_to_fit
from gdp.control.endpoints import Endpoint
from gdp.control.hello import Hello
from gdp.control.join import Join, JoinRefresh
from gdp.control.link_state import Adjacency, AttachedRib, LinkState, Scope
from gdp.control.rib_statements import AdvertiseAck, Query, RelayedStatement, Response
from gdp.crypto.cbor import Value
from gdp.crypto.statements import Statement, StatementType, parse, sign
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage
from gdp.frame.codec import HEADER_BYTES
from gdp.names import Name
from tests.gdp.control.members import node

NODE = node("n")
A, B, C = Name(b"a" * 32), Name(b"b" * 32), Name(b"c" * 32)
HELLO = Hello(nonce=b"n" * 8, sequence=7, heard=(b"h" * 16,), mtu=1_500, digest=b"d" * 8, membership=b"cert")
OBSERVING = replace(HELLO, observed=((b"m" * 8, Endpoint("192.0.2.1", 40_000)), (b"o" * 8, Endpoint("2001:db8::1", 1))))
JOIN = Join(
    topic=A,
    publisher=B,
    switch=C,
    domain=A,
    allowed=frozenset({A, B}),
    mtu=1_400,
    lease_s=7.0,
    evidence=b"evidence",
    session=b"s" * 16,
    sequence=99,
)
LINKS, INSIDE, RIBS = (Adjacency(B, A, 10, 1_500),), (Adjacency(C, A, 3, 1),), (AttachedRib(C, A, bytes(8)),)
STATE = LinkState(
    origin=NODE.name, domain=A, scope=Scope.BORDER, sequence=5, links=LINKS, inside=INSIDE, ribs=RIBS, members=(A, B)
)
ANSWER = Response(name=A, advertiser=B, advertisement=b"claim", domain=C, transit=(A, B), lease_s=30.0)
REFRESH = JoinRefresh(numbers=(1, 1 << 63), session=b"s" * 16, sender_session=b"o" * 8, sequence=9)
UNKNOWN = replace(REFRESH, is_reply=True)
TOTALS = SyncMessage(totals=((A, b"d" * 8), (B, bytes(8))), session=b"s" * 16, sequence=7)
WANTED = SyncMessage(of=A, asked=(b"", b"\1"), lacking=((b"\2", bytes(34)), (A, b"")))
REPLY = SyncMessage(of=A, hashes=((b"\1", bytes(2_048)),), items=(b"item", b"other"), is_last=True, rest=3)
REFUSAL = SyncMessage(of=A, lacking=((A, b""),), refused=DropReason.STALE)
ASKED = DiagnosticRequest(ask="trace", name=A, target=B, sequence=7, body={"p": bytes(C)}, membership=b"cert")
REPLIED = DiagnosticReply(
    ask="trace", sequence=7, asker=A, result={"branches": [{"port": "eth0"}]}, is_cut=True, hops_left=3
)

Read = Callable[[Mapping[str, Value]], object]
BODIES: dict[str, tuple[bytes, object, Read]] = {
    "hello": (HELLO.to_wire(NODE.name, NODE.key), HELLO, Hello.from_fields),
    "hello of a tunnel": (OBSERVING.to_wire(NODE.name, NODE.key), OBSERVING, Hello.from_fields),
    "diagnostic request": (
        ASKED.padded(NODE.name, NODE.key, 1_000),
        ASKED,
        DiagnosticRequest.from_fields,
    ),
    "diagnostic reply": (REPLIED.to_wire(NODE.name, NODE.key), REPLIED, DiagnosticReply.from_fields),
    "join": (JOIN.to_wire(NODE.name, NODE.key), JOIN, Join.from_fields),
    "join refresh": (REFRESH.to_wire(NODE.name, NODE.key), REFRESH, JoinRefresh.from_fields),
    "join unknown": (UNKNOWN.to_wire(NODE.name, NODE.key), UNKNOWN, JoinRefresh.from_fields),
    "link state": (
        STATE.to_wire(NODE.name, NODE.key, b"cert"),
        STATE,
        lambda fields: LinkState.from_origin(fields, NODE.name, A),
    ),
    "query": (Query(A, 20.0).to_wire(NODE.name, NODE.key, b"cert"), Query(A, 20.0), Query.from_fields),
    "query of a reader": (
        Query(A, 20.0, b"revoked!").to_wire(NODE.name, NODE.key, b"cert"),
        Query(A, 20.0, b"revoked!"),
        Query.from_fields,
    ),
    "sync": (TOTALS.to_wire(NODE.name, NODE.key), TOTALS, SyncMessage.from_fields),
    "sync, request": (WANTED.to_wire(NODE.name, NODE.key, b"cert"), WANTED, SyncMessage.from_fields),
    "sync, reply": (REPLY.to_wire(NODE.name, NODE.key, b"cert"), REPLY, SyncMessage.from_fields),
    "sync, refusal": (REFUSAL.to_wire(NODE.name, NODE.key, b"cert"), REFUSAL, SyncMessage.from_fields),
    "answer": (ANSWER.to_wire(NODE.name, NODE.key, b"cert"), ANSWER, Response.from_fields),
    "relay": (
        RelayedStatement(b"claim", (A,), b"cert").to_wire(NODE.name, NODE.key),
        RelayedStatement(b"claim", (A,), b"cert"),
        RelayedStatement.from_fields,
    ),
    "advertise-ack": (
        AdvertiseAck(A, B, DropReason.STALE, 3).to_wire(NODE.name, NODE.key, b"cert"),
        AdvertiseAck(A, B, DropReason.STALE, 3),
        AdvertiseAck.from_fields,
    ),
}


def body_of(which: str) -> Statement:
    return parse(BODIES[which][0])


@pytest.mark.parametrize("which", BODIES)
def test_what_was_written_is_read(which: str) -> None:
    wire, value, read = BODIES[which]
    statement = parse(wire)
    statement.verify(NODE.key.public)
    assert read(statement.fields) == value


@pytest.mark.parametrize("which", BODIES)
@given(value=st.sampled_from([None, True, -1, 1 << 63, 0.5, b"", b"x" * 33, "text", [], {}, [[b"", b"", 0, 0]]]))
def test_a_field_of_another_type_is_malformed_or_means_something(which: str, value: object) -> None:
    statement, read = body_of(which), BODIES[which][2]
    for key in statement.fields:
        changed = parse(sign(statement.type, {**statement.fields, key: value}, NODE.name, NODE.key))
        try:
            read(changed.fields)
        except StatementError as error:
            assert error.reason is DropReason.MALFORMED  # noqa: PT017


@pytest.mark.parametrize("which", BODIES)
def test_an_empty_body_is_malformed(which: str) -> None:
    with pytest.raises(StatementError) as caught:
        BODIES[which][2](parse(sign(StatementType.HELLO, {}, NODE.name, NODE.key)).fields)
    assert caught.value.reason is DropReason.MALFORMED


@pytest.mark.parametrize("count", [0, 129])
def test_a_refresh_has_1_to_128_numbers(count: int) -> None:
    refresh = replace(REFRESH, numbers=tuple(range(count)))
    with pytest.raises(StatementError) as caught:
        JoinRefresh.from_fields(parse(refresh.to_wire(NODE.name, NODE.key)).fields)
    assert caught.value.reason is DropReason.MALFORMED


def test_a_full_refresh_fits_into_one_frame_of_ethernet() -> None:
    refresh = replace(UNKNOWN, numbers=tuple(range(1 << 63, (1 << 63) + 128)))
    assert len(refresh.to_wire(NODE.name, NODE.key)) <= 1_500 - HEADER_BYTES


def test_a_reason_of_a_later_version_is_a_refusal_all_the_same() -> None:
    fields = {**body_of("advertise-ack").fields, "r": 200}
    ack = AdvertiseAck.from_fields(parse(sign(StatementType.ADVERTISE_ACK, fields, NODE.name, NODE.key)).fields)
    assert ack.refused is DropReason.MALFORMED


def test_what_is_taken_has_no_reason() -> None:
    taken = AdvertiseAck(A, B, None, 3)
    assert AdvertiseAck.from_fields(parse(taken.to_wire(NODE.name, NODE.key, b"")).fields) == taken


def test_a_response_that_names_the_name_itself_without_an_advertisement_is_negative() -> None:
    assert Response(name=A, advertiser=A, advertisement=b"", domain=C, transit=(), lease_s=2.0).is_negative
    assert not Response(name=A, advertiser=B, advertisement=b"", domain=C, transit=(), lease_s=0.0).is_negative


def test_a_response_about_the_name_itself_without_a_lease_says_that_the_rib_does_not_know() -> None:
    unknown = Response(name=A, advertiser=A, advertisement=b"", domain=C, transit=(), lease_s=0.0)
    assert (unknown.is_unknown, unknown.is_negative) == (True, False)
    left = Response(name=A, advertiser=A, advertisement=b"", domain=C, transit=(), lease_s=0.0, sequence=1)
    assert (left.is_unknown, left.is_negative) == (False, True), "a node that withdrew its own name"


@given(st.integers(0, 8_000), st.integers(0, 300), st.booleans())
def test_a_reply_is_cut_to_the_length_of_its_request(max_bytes: int, count: int, knows: bool) -> None:
    result = {"branches": [{"n": bytes(A)}] * count, "in": {"port": "eth0"}}
    reply = replace(REPLIED, result=result, is_cut=False, membership=b"" if knows else b"c" * 600)
    cut = cut_to_fit(reply, max_bytes)
    if cut is not None:
        assert len(cut.to_wire(NODE.name, NODE.key)) <= max_bytes
        assert cut.is_cut or cut == reply
    else:
        assert max_bytes < 1_000


@pytest.mark.parametrize("length", [0, 500, 2_000, 8_000])
def test_a_request_is_as_long_as_the_reply_that_it_accepts(length: int) -> None:
    wire = ASKED.padded(NODE.name, NODE.key, length)
    assert len(wire) in range(max(length, 1_000), max(length, 1_000) + 80)
