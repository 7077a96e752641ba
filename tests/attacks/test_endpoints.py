"""Attacks of members with their endpoint records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from gdp.control.endpoint_record import CandidateType, EndpointRecord
from gdp.switch.direct_tunnels import Close, Open
from tests.gdp.switch.test_direct_tunnels import IN_CLOUD, A, B, Bed, record

CHANGES_PER_S = 4  # what a RIB takes of one switch


def rekeyed(number: int) -> EndpointRecord:
    return replace(IN_CLOUD, keys=(number.to_bytes(32, "big"),), sequence=number)


def with_and_without_candidates(number: int) -> EndpointRecord:
    found = IN_CLOUD if number % 2 else record(B, (CandidateType.RELAY_TLS, "198.51.100.1"))
    return replace(found, sequence=number)


@pytest.mark.parametrize("changed", [rekeyed, with_and_without_candidates])
def test_a85_a_member_that_changes_its_record_all_the_time_has_few_devices_made(
    changed: Callable[[int], EndpointRecord],
) -> None:
    bed = Bed(own=record(A))
    made = 0
    for number in range(1, 60 * CHANGES_PER_S):
        bed.records[B] = changed(number)
        actions = bed.run(1 / CHANGES_PER_S)
        made += sum(isinstance(each, Open) for _, each in actions)
    assert 0 < made <= 20


def test_a85_a_member_that_got_new_keys_is_tried_with_these() -> None:
    bed = Bed()
    bed.run(60.0)
    bed.records[B] = rekeyed(7)
    assert [type(each) for each in bed.poll()] == [Close, Open]
