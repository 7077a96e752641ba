"""Attacks of members with their endpoint records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from gdp.control.endpoints import CandidateType, EndpointRecord
from gdp.crypto.certificates import Role
from gdp.crypto.identity import NodeKeys
from gdp.crypto.statements import parse
from gdp.crypto.validity import Validity
from gdp.rib.endpoints import RibEndpoints
from gdp.switch.direct_tunnels import Close, Open
from gdp.trust.domain import Policy
from tests.gdp.control.members import CLOUD, SCHOOL, UNIX_S, at, node
from tests.gdp.rib.test_endpoints import record as published
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


def test_a93_a_switch_of_two_domains_that_changes_between_them_uses_up_no_quota() -> None:
    keys, hour = NodeKeys.generate(Role.SWITCH, "both"), Validity(UNIX_S - 60, UNIX_S + 3_600)
    own, foreign = keys.join(SCHOOL, hour), keys.join(CLOUD, hour)
    endpoints = RibEndpoints(node("rib", Role.RIB), Policy(SCHOOL.root, [CLOUD.root]), lambda _: None, maximum=8)
    for turn in range(6):
        now_s = 100.0 * turn
        for number, identity in enumerate((foreign, own)):
            sequence = 2 * turn + number + 1
            wire = published(identity, sequence=sequence).wire
            endpoints.receive_record(parse(wire), at(now_s + number, UNIX_S + now_s))
        endpoints.handle_timer(at(now_s + 90.0, UNIX_S + now_s))
        assert len(endpoints) == 0
    honest = published(node("honest", domain=CLOUD)).wire
    endpoints.receive_record(parse(honest), at(1_000.0, UNIX_S))
    assert len(endpoints) == 1
