"""Credentials of running commands, replaced while a recording crosses: memberships, several times, and the root."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from gdp.nodes.node_log import RECONCILE_PERIOD_S
from gdp.stores.audit_log import verify_audit
from gdp.stores.issue import renew_node
from gdp.stores.rollover import begin_rollover, finish_rollover, trust_successor
from netns_tests.cable import Terminals, sim_link
from netns_tests.spaces import Space
from tests.machines import Machines
from tests.pages import ROOT, blocks

pytestmark = pytest.mark.netns

_REPLAY = "gdp-replay drive.mcap --config robot/proxy.yaml --rate 0.5 --json"
_NODES = {"robot": ("robot/switch", "robot/rib", "robot/proxy"), "server": ("server/switch", "server/proxy")}
_AUDITS = {"robot": ("robot/audit-switch", "robot/audit-rib"), "server": ("server/audit-switch",)}
_RENEWALS = 4
_TAKEN_UP_S = 4 * RECONCILE_PERIOD_S  # two reconcile periods of every node


@pytest.mark.nightly
def test_no_message_is_lost_while_memberships_and_the_root_are_replaced(space: Space, tmp_path: Path) -> None:
    machines = Machines(tmp_path)
    homes = {"robot": machines.robot, "server": machines.server}
    nodes = [homes[machine] / each for machine, folders in _NODES.items() for each in folders]
    domain = machines.robot / "lab"
    with sim_link(space) as into_server:
        terminals = Terminals(machines, into_server)
        try:
            _stand_up(machines, terminals)
            replay = subprocess.Popen(
                _REPLAY.split(), cwd=machines.robot, env=machines.environment, stdout=subprocess.PIPE, text=True
            )
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
            was_running = replay.poll() is None
            printed, _ = replay.communicate(timeout=120)
            said = terminals.end()
        finally:
            terminals.close()
    for home, folders in _AUDITS.items():
        for folder in folders:
            found = verify_audit(homes[home] / folder)
            assert found.events["accepted", "name"] > 0
            assert found.first == 1
    result: dict[str, object] = {}
    for line in printed.splitlines():
        result |= json.loads(line)
    assert was_running, f"the recording ended before the root was replaced, which took {took_s:.1f} s"
    assert (replay.returncode, result["sent"], result["confirmed"]) == (0, 100, 100)
    assert "100 messages received, 0 lost" in said["gdp-proxy, exit 0"]
    logs = [log.read_text() for home in homes.values() for log in home.glob("gdp-*.log")]
    assert len(logs) == len(nodes) - 1, "the robot's proxy is gdp-replay"
    for log in logs:
        assert log.count("membership renewed") >= 2
        assert "successions=1" in log
        assert "credentials not renewed" not in log


def _stand_up(machines: Machines, terminals: Terminals) -> None:
    """Follow the tutorial, except for the replay."""
    for block in blocks(ROOT / "docs/tutorials/two-machines.md"):
        if block.language == "yaml":
            machines.write(block)
            if "proxy" not in block.title:
                with (machines.robot / block.title).open("a") as file:
                    file.write(f"audit: audit-{Path(block.title).stem}\n")
        elif block.title:
            home = machines.home_of(block)
            for line in block.lines:
                if line.startswith(("gdp-switch", "gdp-rib", "gdp-proxy")):
                    terminals.start(f"{line.removesuffix('&')} 2>{line.split()[0]}.log", home)
                elif not line.startswith("gdp-replay"):
                    machines.run(line, home)


def _renew(domain: Path, nodes: list[Path]) -> None:
    for node in nodes:
        assert renew_node(domain, node) is not None
    time.sleep(_TAKEN_UP_S)
