"""Output of gdp-replay for unconfirmed messages, on the two machines of the tutorial."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from netns_tests.cable import Terminals, sim_link
from netns_tests.spaces import Space
from proxy.recordings.reader import BagReader
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


def test_a_recording_outlives_a_full_disk_and_a_kill(space: Space, tmp_path: Path) -> None:
    machines = Machines(tmp_path)
    with sim_link(space) as into_server, _small_disk(tmp_path / "disk", megabytes=6) as disk:
        terminals = Terminals(machines, into_server)
        try:
            line, home = _stand_up(machines, terminals)
            config = home / "server" / "proxy.yaml" if (home / "server").is_dir() else home / "proxy.yaml"
            text = config.read_text()

            config.write_text(text.replace("received.mcap", str(disk / "full.mcap")))
            terminals.start(line, home)
            code, sent = _replay(machines)
            assert code == 1
            assert sent["confirmed"] < sent["sent"] == 100
            (ended,) = terminals.end("gdp-proxy")
            assert ended == "gdp-proxy, exit 1"
            kept = _messages(disk / "full.mcap")
            assert 0 < kept <= sent["confirmed"]

            config.write_text(text.replace("received.mcap", str(tmp_path / "killed.mcap")))
            terminals.start(line, home)
            code, sent = _replay(machines, "--wait-readers 10")
            assert code == 0
            time.sleep(1.5)  # what is promised for a power cut: all but the last second
            terminals.signal("gdp-proxy", signal.SIGKILL)
            assert "gdp-proxy, exit -9" in terminals.end("gdp-proxy")
            finish = ["gdp", "recording", "finish", str(tmp_path / "killed.mcap.partial")]
            subprocess.run(finish, env=machines.environment, check=True, capture_output=True)
            assert _messages(tmp_path / "killed.mcap") == 100
        finally:
            terminals.close()


@contextlib.contextmanager
def _small_disk(place: Path, *, megabytes: int) -> Iterator[Path]:
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def _messages(path: Path) -> int:
    with BagReader(path) as reader:
        count = sum(1 for _ in reader.messages())
        assert reader.unread == ""
        return count


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
