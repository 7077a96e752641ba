"""Rebinding of an uplink: it takes another UDP port only while no tunnel over it is up."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from gdp.config.config import LinksConfig
from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.control.hello import NodeSettings
from gdp.control.tunnel_plan import REBINDS, TunnelId
from gdp.crypto.identity import Identity
from gdp.crypto.tunnel_key import TunnelKey
from gdp.intervals import PACE_S
from gdp.links import tunnels as tunnels_module
from gdp.links.links import TunnelLinks
from gdp.names import Name
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from tests.gdp.control.members import POLICY, UNIX_S, Nonces, at, node

BORDER, ROBOT, SERVER, LEAF = node("border"), node("robot"), node("server"), node("leaf")
OUTAGE_S = 4 * REBINDS.most_s


def record(identity: Identity, *, is_public: bool = False) -> EndpointRecord:
    type_ = CandidateType.PUBLIC if is_public else CandidateType.REFLEXIVE
    candidates = (Candidate(0, type_, Endpoint("127.0.0.1", 51_820)),)
    keys = (TunnelKey.derive(identity.kem).public,)
    return EndpointRecord.make(identity, keys, candidates, sequence=1, until_unix_s=UNIX_S + 6_000)


class Robot:
    """The links of a robot with two uplinks that dials a border, is dialled by a leaf, and may have a direct tunnel."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for each, is_public in ((BORDER, True), (LEAF, False)):
            (folder / f"{each.member.label}.endpoints").write_bytes(record(each, is_public=is_public).wire)
        self.up: set[Name] = set()
        self.now_s = 0.0
        self.devices = (MagicMock(fwmark=0), MagicMock(fwmark=0))
        for each in self.devices:
            each.peers.return_value = each.known_peers.return_value = {}
            each.poll.return_value = each.poll_move.return_value = False
            each.path_mtu.return_value = None
        runtime = MagicMock()
        runtime.add_port.side_effect = itertools.count()
        settings = NodeSettings(incarnation=0, first_sequence=0, random_bytes=Nonces(1))
        switch = SwitchCore(ROBOT, POLICY, Table(), settings)
        monkeypatch.setattr(switch.hello_protocol.liveness, "set_uplink", lambda *_: None)
        monkeypatch.setattr(
            switch.hello_protocol.neighbours, "get", lambda _, name: MagicMock() if name in self.up else None
        )
        self.links = TunnelLinks(
            config=LinksConfig(peers=folder, direct=False),
            identity=ROBOT,
            policy=POLICY,
            switch=switch,
            runtime=runtime,
            underlays=self.devices,
        )

    def open_direct(self, uplink: int = 0) -> None:
        """Open a direct tunnel to the server, as the switch decides."""
        made = self.links._tunnels.open(
            TunnelId(SERVER.name, uplink, 0), record(SERVER), None, keepalive_s=25, now_s=self.now_s, is_direct=True
        )
        assert made

    def run(self, duration_s: float, *up: Identity) -> list[int]:
        """Let time pass with these neighbours up; return how often each uplink took another port."""
        before = self.rebinds()
        self.up = {each.name for each in up}
        for _ in range(round(duration_s / PACE_S)):
            self.now_s += PACE_S
            self.links.handle_timer(at(self.now_s))
        return [now - then for now, then in zip(self.rebinds(), before, strict=True)]

    def rebinds(self) -> list[int]:
        return [each.rebind.call_count for each in self.devices]


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    for name in ("make_vxlan", "remove_link", "set_link_mtu"):
        monkeypatch.setattr(tunnels_module, name, lambda *_, **__: None)
    made = Robot(tmp_path, monkeypatch)
    yield made
    made.links.close(made.now_s)


def test_uplinks_over_which_no_tunnel_is_up_take_another_port(robot: Robot) -> None:
    assert robot.run(5, BORDER) == [0, 0]
    assert robot.run(2 * REBINDS.first_s) == [1, 1]


def test_an_uplink_with_a_direct_tunnel_that_is_up_keeps_its_port(robot: Robot) -> None:
    robot.run(5, BORDER)
    robot.open_direct(uplink=0)
    robot.run(5, BORDER, SERVER)
    first, second = robot.run(OUTAGE_S, SERVER)
    assert first == 0
    assert second > 1  # nothing needs its port


def test_an_uplink_over_which_a_peer_that_dials_this_switch_is_up_keeps_its_port(robot: Robot) -> None:
    robot.run(5, BORDER, LEAF)
    assert robot.run(OUTAGE_S, LEAF) == [0, 0]


def test_a_direct_tunnel_that_falls_silent_with_the_border_delays_no_other_port(robot: Robot) -> None:
    robot.open_direct()
    robot.run(5, BORDER, SERVER)
    robot.run(REBINDS.first_s / 2, SERVER)
    assert robot.run(2 * REBINDS.first_s) == [1, 1]


def test_a_direct_tunnel_that_outlived_the_border_has_time_to_come_back_over_its_port(robot: Robot) -> None:
    robot.open_direct()
    robot.run(5, BORDER, SERVER)
    for _ in range(3):
        assert robot.run(OUTAGE_S, SERVER)[0] == 0
        assert robot.run(REBINDS.most_s - 1)[0] == 0
    assert robot.run(2)[0] == 1
