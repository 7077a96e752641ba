"""Endpoint records, inner addresses and WireGuard keys."""

from __future__ import annotations

import pytest

from gdp.control.endpoints import (
    RECORD_MAX_BYTES,
    Candidate,
    CandidateType,
    Endpoint,
    EndpointRecord,
    inner_address,
    tunnel_vni,
)
from gdp.crypto.statements import StatementType
from gdp.crypto.tunnel_key import TunnelKey
from gdp.errors import DropReason, LocalError, StatementError
from tests.gdp.control.members import ELSEWHERE, POLICY, UNIX_S, node

CANDIDATES = (
    Candidate(0, CandidateType.HOST, Endpoint("192.168.1.5", 51_820)),
    Candidate(0, CandidateType.REFLEXIVE, Endpoint("2001:db8::7", 443)),
)
SWITCH = node("nuc1")
KEYS = (TunnelKey.derive(SWITCH.kem).public,)


def make(**more: int) -> EndpointRecord:
    """Return a valid record of ``SWITCH``."""
    return EndpointRecord.make(SWITCH, KEYS, CANDIDATES, **{"sequence": 7, "until_unix_s": UNIX_S + 60, **more})


def test_a_record_says_what_its_switch_signed() -> None:
    record, member = EndpointRecord.verified(make().wire, POLICY, UNIX_S)
    assert (record.name, record.keys, record.candidates, record.sequence) == (SWITCH.name, KEYS, CANDIDATES, 7)
    assert member.name == SWITCH.name


def test_an_altered_record_is_refused() -> None:
    wire = bytearray(make().wire)
    wire[-1] ^= 1
    with pytest.raises(StatementError) as refused:
        EndpointRecord.verified(bytes(wire), POLICY, UNIX_S)
    assert refused.value.reason is DropReason.BAD_SIGNATURE


def test_a_void_record_is_refused() -> None:
    with pytest.raises(StatementError) as refused:
        EndpointRecord.verified(make(until_unix_s=UNIX_S - 1).wire, POLICY, UNIX_S)
    assert refused.value.reason is DropReason.EXPIRED


def test_a_record_of_an_untrusted_domain_is_refused() -> None:
    stranger = node("stranger", domain=ELSEWHERE)
    record = EndpointRecord.make(stranger, KEYS, CANDIDATES, sequence=1, until_unix_s=UNIX_S + 60)
    with pytest.raises(StatementError):
        EndpointRecord.verified(record.wire, POLICY, UNIX_S)


@pytest.mark.parametrize(
    "candidates",
    [
        [[1, "host", b"\x7f\0\0\1\0\1"]],
        [[0, "guess", b"\x7f\0\0\1\0\1"]],
        [[0, "host", b"\x7f\0\0\1\0\0"]],
        [7],
        [[0, "host", b""]],
    ],
)
def test_a_record_with_a_malformed_candidate_is_refused(candidates: list[object]) -> None:
    body = {"k": list(KEYS), "a": candidates, "s": 1, "u": UNIX_S + 60, "c": SWITCH.membership}
    with pytest.raises(StatementError) as refused:
        EndpointRecord.verified(SWITCH.sign(StatementType.ENDPOINTS, body), POLICY, UNIX_S)
    assert refused.value.reason is DropReason.MALFORMED


def test_a_long_record_is_refused_before_it_is_parsed() -> None:
    with pytest.raises(StatementError) as refused:
        EndpointRecord.verified(bytes(RECORD_MAX_BYTES + 1), POLICY, UNIX_S)
    assert refused.value.reason is DropReason.TOO_BIG


@pytest.mark.parametrize("text", ["192.0.2.1:51820", "[2001:db8::1]:443"])
def test_an_endpoint_reads_what_it_writes(text: str) -> None:
    endpoint = Endpoint.from_text(text)
    assert endpoint.to_text() == text
    assert Endpoint.from_wire(endpoint.to_wire()) == endpoint


@pytest.mark.parametrize(
    "text", ["", "192.0.2.1", "192.0.2.1:0", "2001:db8::1:443", "[192.0.2.1]:4", "host:4", "1.2.3.4:x"]
)
def test_what_is_no_endpoint_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="address:port"):
        Endpoint.from_text(text)


def test_both_ends_of_a_tunnel_know_its_network_identifier() -> None:
    one, other = inner_address(SWITCH.name), inner_address(node("nuc2").name)
    assert one.startswith("fd")
    assert tunnel_vni(one, other) == tunnel_vni(other, one) != 0


def test_each_uplink_has_a_key_of_its_own_and_always_the_same() -> None:
    first, again, second = (TunnelKey.derive(SWITCH.kem, uplink) for uplink in (0, 0, 1))
    assert first == again
    assert first.public != second.public
