"""Attacks of members with the WireGuard key of another member, which is public, in their own endpoint records."""

from __future__ import annotations

import itertools
from dataclasses import replace
from unittest.mock import MagicMock

import pytest

from gdp.control.endpoints import EndpointRecord, inner_address
from gdp.control.tunnel_plan import TunnelId
from gdp.links import tunnels as tunnels_module
from gdp.links.tunnels import Tunnels
from gdp.names import Name
from tests.gdp.switch.test_direct_tunnels import A, B, C, record

VICTIM, MALLORY = record(B), replace(record(C), keys=record(B).keys)
KEY = VICTIM.keys[0]


class Border:
    """The tunnels of a switch whose devices are in the hands of the test."""

    def __init__(self) -> None:
        self.up: set[Name] = set()
        self.inner = ""  # which the peer with the shared key may use

        def set_peer(key: bytes, *, inner: str, **_: object) -> None:
            assert key == KEY
            self.inner = inner

        device = MagicMock()
        device.set_peer.side_effect = set_peer
        device.peers.return_value = {}
        runtime, switch = MagicMock(), MagicMock()
        runtime.add_port.side_effect = itertools.count()
        switch.hello_protocol.neighbours.get.side_effect = lambda _, name: name if name in self.up else None
        identity = MagicMock()
        identity.name = A
        self.tunnels = Tunnels(identity=identity, switch=switch, runtime=runtime, underlays=(device,))

    def open(self, peer: EndpointRecord, now_s: float) -> bool:
        return self.tunnels.open(TunnelId(peer.name, 0, 0), peer, None, keepalive_s=0, now_s=now_s)


@pytest.fixture
def border(monkeypatch: pytest.MonkeyPatch) -> Border:
    for name in ("make_vxlan", "remove_link"):
        monkeypatch.setattr(tunnels_module, name, lambda *_, **__: None)
    return Border()


def test_a92_a_member_that_states_anothers_key_takes_no_tunnel_that_is_up(border: Border) -> None:
    assert border.open(VICTIM, 0.0)
    border.up.add(B)
    assert not border.open(MALLORY, 1.0)
    assert border.inner == inner_address(B)
    assert [each.peer for each in border.tunnels.all] == [B]


def test_a92_a_member_that_stated_anothers_key_first_gives_way_to_it(border: Border) -> None:
    assert border.open(MALLORY, 0.0)
    assert border.open(VICTIM, 1.0)
    assert border.inner == inner_address(B)
    assert [each.peer for each in border.tunnels.all] == [B]
