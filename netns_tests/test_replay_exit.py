"""Output of gdp-replay for unconfirmed messages, on the two machines of the tutorial."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from netns_tests.cable import Terminals, sim_link
from netns_tests.spaces import Space
from tests.machines import Machines
from tests.pages import ROOT, blocks

pytestmark = pytest.mark.netns

_REPLAY = "gdp-replay drive.mcap --config robot/proxy.yaml --rate 0 --json"


def test_gdp_replay_exits_1_for_a_reliable_topic_without_a_reader_and_0_once_it_is_confirmed(
    space: Space, tmp_path: Path
) -> None:
    machines = Machines(tmp_path)
    with sim_link(space) as into_server:
        terminals = Terminals(machines, into_server)
        try:
            recorder = _stand_up(machines, terminals)
            code, unread = _replay(machines, "--wait-readers 0.1")
            assert code == 1
            (topic,) = unread["unconfirmed"]
            assert (topic["topic"], topic["messages"], topic["confirmed"]) == ("/camera/image", 100, 0)
            assert (topic["why"], topic["reasons"]) == ("no reader", {"no-reader": 100})
            assert (unread["total"], unread["sent"], unread["confirmed"]) == (100, 100, 0)
            terminals.start(*recorder)
            code, read = _replay(machines)
            assert (code, read["sent"], read["confirmed"], read["unconfirmed"]) == (0, 100, 100, [])
        finally:
            terminals.close()


def _stand_up(machines: Machines, terminals: Terminals) -> tuple[str, Path]:
    """Follow the tutorial, except for the recorder, which is returned, and the replay."""
    recorder = ("", Path())
    for block in blocks(ROOT / "docs/tutorials/two-machines.md"):
        if block.language == "yaml":
            machines.write(block)
        elif block.title:
            home = machines.home_of(block)
            for line in block.lines:
                if line.startswith("gdp-proxy"):
                    recorder = (line, home)
                elif line.startswith(("gdp-switch", "gdp-rib")):
                    terminals.start(line, home)
                elif not line.startswith("gdp-replay"):
                    machines.run(line, home)
    return recorder


def _replay(machines: Machines, more: str = "") -> tuple[int, dict[str, Any]]:
    """Replay; return the exit code and the content of the last events."""
    words = f"{_REPLAY} {more}".split()
    done = subprocess.run(
        words, cwd=machines.robot, env=machines.environment, capture_output=True, text=True, check=False
    )
    said: dict[str, Any] = {}
    for line in done.stdout.splitlines():
        said |= json.loads(line)
    return done.returncode, said
