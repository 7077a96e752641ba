"""Forwarding decisions of ``decide`` on the fixtures and on arbitrary bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import DropReason
from gdp.switch.forwarder import Drop, Forward, Punt, decide, rewrite
from tests.fixtures_forwarding import CASES, ENTRIES, MTUS, ONE, PACES, TO_WIDE, Case, frame


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_each_fixture_gets_its_decision(case: Case) -> None:
    decision = decide(case.frame, ENTRIES, MTUS, paces=PACES)
    assert isinstance(decision, Punt) == case.punted
    if isinstance(decision, Drop):
        assert (decision.reason,) == case.drops
        assert not case.out
    if isinstance(decision, Forward):
        assert decision.lost == case.drops
        assert {port: rewrite(case.frame, macs) for port, macs in decision.hops} == case.out


def test_another_ethertype_is_dropped() -> None:
    before = frame(ONE)
    assert decide(before[:12] + b"\x08\x00" + before[14:], ENTRIES, MTUS) == Drop(DropReason.BAD_ETHERTYPE)


@given(st.binary(max_size=300))
def test_arbitrary_bytes_get_a_decision(data: bytes) -> None:
    assert isinstance(decide(data, ENTRIES, MTUS), Drop | Punt | Forward)


@given(st.binary(min_size=6, max_size=6), st.integers(0, 255), st.integers(0, 255), st.binary(max_size=40))
def test_only_a_frame_with_hops_to_spare_is_forwarded(mac: bytes, kind: int, hops_left: int, payload: bytes) -> None:
    before = mac + frame(ONE, payload, kind=kind, hops_left=hops_left)[6:]
    decision = decide(before, ENTRIES, MTUS)
    assert isinstance(decision, Forward) == (kind < 0x80 and hops_left & 0x7F > 1)


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_buffer_will_do(kind: type[bytes] | type[bytearray] | type[memoryview]) -> None:
    assert decide(kind(frame(ONE)), ENTRIES, MTUS) == Forward((TO_WIDE,))
    assert rewrite(kind(frame(ONE)), TO_WIDE[1])[:12] == TO_WIDE[1]
