"""Which tunnels a switch has, and where it dials."""

from __future__ import annotations

import pytest

from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.control.tunnel_plan import (
    DIAL_S,
    REBINDS,
    Dialer,
    RebindSchedule,
    TunnelId,
    planned_tunnels,
    tunnel_ifname,
    underlay_ifname,
)
from gdp.crypto.tunnel_key import TunnelKey
from tests.gdp.control.members import UNIX_S, node

PEER = node("peer")
FIRST, SECOND = Endpoint("198.51.100.7", 51_820), Endpoint("2001:db8::7", 51_820)


def record(uplinks: int = 1, endpoints: tuple[Endpoint, ...] = ()) -> EndpointRecord:
    """Return a record of ``PEER``."""
    keys = tuple(TunnelKey.derive(PEER.kem, uplink).public for uplink in range(uplinks))
    candidates = tuple(Candidate(0, CandidateType.PUBLIC, each) for each in endpoints)
    return EndpointRecord.make(PEER, keys, candidates, sequence=1, until_unix_s=UNIX_S)


@pytest.mark.parametrize(
    ("mine", "theirs", "pairs"),
    [
        (1, 1, [(0, 0)]),
        (2, 1, [(0, 0), (1, 0)]),
        (1, 2, [(0, 0), (0, 1)]),
        (2, 2, [(0, 0), (1, 1)]),
        (2, 3, [(0, 0), (1, 1), (1, 2)]),
    ],
)
def test_each_uplink_of_either_end_has_a_tunnel(mine: int, theirs: int, pairs: list[tuple[int, int]]) -> None:
    assert [each[1:] for each in planned_tunnels(mine, record(theirs))] == pairs
    assert [(here, there) for there, here in pairs] == [each[1:] for each in planned_tunnels(theirs, record(mine))]


def test_device_names_fit_and_differ() -> None:
    me = node("me").name
    tunnels = [TunnelId(PEER.name, 0, 0), TunnelId(PEER.name, 1, 0), TunnelId(me, 0, 0)]
    names = {underlay_ifname(me, 0), underlay_ifname(me, 1), *(tunnel_ifname(me, each) for each in tunnels)}
    assert len(names) == 5
    assert max(map(len, names)) == 15


def test_the_endpoints_of_a_border_are_dialled_in_turn_until_it_is_up() -> None:
    dialer = Dialer.to(record(endpoints=(FIRST, SECOND)), 0)
    assert dialer.next(0.0, is_up=False) == FIRST
    assert dialer.next(DIAL_S / 2, is_up=False) is None
    assert dialer.next(DIAL_S, is_up=False) == SECOND
    assert dialer.next(2 * DIAL_S, is_up=True) is None
    assert dialer.next(2.5 * DIAL_S, is_up=False) is None
    assert dialer.next(3 * DIAL_S, is_up=False) == FIRST


def test_a_peer_without_public_endpoint_is_not_dialled() -> None:
    assert Dialer.to(record(), 0).next(0.0, is_up=False) is None


def test_an_endpoint_without_a_route_is_not_dialled() -> None:
    dialer = Dialer.to(record(endpoints=(FIRST, SECOND)), 0)
    for number in range(3):
        assert dialer.next(number * DIAL_S, is_up=False, has_route=lambda each: each == SECOND) == SECOND
    assert dialer.next(3 * DIAL_S, is_up=False, has_route=lambda _: False) is None
    assert dialer.next(3 * DIAL_S, is_up=False) == FIRST


def test_an_uplink_takes_another_port_when_every_border_falls_silent() -> None:
    schedule = RebindSchedule()
    assert not schedule.update(100.0, is_up=False)  # none has answered yet: the NAT has no stale mapping
    assert not schedule.update(101.0, is_up=True)
    found = [at / 10 for at in range(1_020, 1_300) if schedule.update(at / 10, is_up=False)]
    assert found == pytest.approx([102.0 + REBINDS.first_s, 105.0, 109.0, 117.0], abs=0.11)
    assert not schedule.update(130.0, is_up=True)
    assert not schedule.update(130.0 + REBINDS.first_s / 2, is_up=False)
