"""Credentials of running commands, replaced while a recording crosses: memberships, several times, and the root."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from gdp.intervals import TICK_S
from gdp.stores.audit_log import verify_audit
from gdp.stores.issue import renew_node
from gdp.stores.rollover import begin_rollover, finish_rollover, trust_successor
from lab.namespaces import Space, cable
from tests.machines import Machines
from tests.pages import ROOT, Block, blocks

pytestmark = pytest.mark.netns

_REPLAY = "gdp-replay drive.mcap --config robot/proxy.yaml --rate 0.5 --json"
_NODES = {"robot": ("robot/switch", "robot/rib", "robot/proxy"), "server": ("server/switch", "server/proxy")}
_AUDITS = {"robot": ("robot/audit-switch", "robot/audit-rib"), "server": ("server/audit-switch",)}
_RENEWALS = 4
_TAKEN_UP_S = 4 * TICK_S  # two reconcile periods of every node


class _Audited(Machines):
    """Machines whose switches and RIBs keep an audit log."""

    def write(self, block: Block) -> None:
        """Write a configuration file of the robot."""
        super().write(block)
        if "proxy" not in block.title:
            with (self.robot / block.title).open("a") as file:
                file.write(f"audit: audit-{Path(block.title).stem}\n")


@pytest.mark.nightly
def test_no_message_is_lost_while_memberships_and_the_root_are_replaced(space: Space, tmp_path: Path) -> None:
    with cable(space) as server, _Audited(tmp_path, server) as machines:
        homes = {"robot": machines.robot, "server": machines.server}
        nodes = [homes[machine] / each for machine, folders in _NODES.items() for each in folders]
        domain = machines.robot / "lab"
        machines.follow(blocks(ROOT / "docs/tutorials/two-machines.md"), but=("gdp-replay",))
        replay = machines.hosts[machines.robot].launch(_REPLAY.split(), "replay")
        begun_s = time.monotonic()
        for _ in range(_RENEWALS):
            _renew(domain, nodes)
        begin_rollover(domain, days=365, overlap_days=1)
        for node in nodes:
            trust_successor(domain / "next/root.crt", node / "root.crt")
        time.sleep(_TAKEN_UP_S)
        finish_rollover(domain)
        _renew(domain, nodes)
        took_s = time.monotonic() - begun_s
        was_running = replay.code is None
        printed = replay.reap(120.0)
        said = machines.end()
    for home, folders in _AUDITS.items():
        for folder in folders:
            found = verify_audit(homes[home] / folder)
            assert found.events["accepted", "name"] > 0
            assert found.first == 1
    result: dict[str, object] = {}
    for line in printed.splitlines():
        result |= json.loads(line)
    assert was_running, f"the recording ended before the root was replaced, which took {took_s:.1f} s"
    assert (replay.code, result["sent"], result["confirmed"]) == (0, 100, 100)
    assert "100 messages received, 0 lost" in said["gdp-proxy, exit 0"]
    logs = [log.read_text() for home in homes.values() for log in home.glob("gdp-*.log")]
    assert len(logs) == len(nodes) - 1, "the robot's proxy is gdp-replay"
    for log in logs:
        assert log.count("membership renewed") >= 2
        assert "successions=1" in log
        assert "credentials not renewed" not in log


def _renew(domain: Path, nodes: list[Path]) -> None:
    for node in nodes:
        assert renew_node(domain, node) is not None
    time.sleep(_TAKEN_UP_S)
