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

from lab.namespaces import Space, cable
from lab.process import until
from proxy.recordings.reader import BagReader
from tests.machines import Machines
from tests.pages import ROOT, blocks

pytestmark = pytest.mark.netns

IMAGES = 30  # ten a second
PATIENCE_S = 60.0
TUTORIAL = blocks(ROOT / "docs/tutorials/two-machines.md")
(RECORDER,) = (line for block in TUTORIAL if block.title for line in block.lines if line.startswith("gdp-proxy"))
_REPLAY = "gdp-replay drive.mcap --config robot/proxy.yaml --rate 0 --json"


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    """The two machines as the page leaves them, without a recorder, and with a shorter recording."""
    with Space() as space, cable(space) as server, Machines(tmp_path_factory.mktemp("machines"), server) as made:
        made.follow(TUTORIAL, but=("gdp-replay", "gdp-proxy", "scripts/make_demo_bag.py"))
        made.run(f"scripts/make_demo_bag.py --seconds {IMAGES / 10:g} -o drive.mcap", made.robot)
        yield made


def test_gdp_replay_exits_1_for_a_reliable_topic_without_a_reader_and_0_once_it_is_confirmed(
    machines: Machines,
) -> None:
    code, unread = _replay(machines, "--wait-readers 0.1")
    assert code == 1
    (topic,) = unread["unconfirmed"]
    assert (topic["topic"], topic["messages"], topic["confirmed"]) == ("/camera/image", IMAGES, 0)
    assert (topic["why"], topic["reasons"]) == ("no reader", {"no-reader": IMAGES})
    assert (unread["total"], unread["sent"], unread["confirmed"]) == (IMAGES, IMAGES, 0)
    machines.start(RECORDER, machines.server)
    code, read = _replay(machines)
    assert (code, read["sent"], read["confirmed"], read["unconfirmed"]) == (0, IMAGES, IMAGES, [])
    machines.end("gdp-proxy")


def test_a_recording_outlives_a_full_disk_and_a_kill(machines: Machines, tmp_path: Path) -> None:
    config = machines.server / "server/proxy.yaml"
    text = config.read_text()
    with _small_disk(tmp_path / "disk", megabytes=6) as disk:
        config.write_text(text.replace("received.mcap", str(disk / "full.mcap")))
        machines.start(RECORDER, machines.server)
        code, sent = _replay(machines)
        assert code == 1
        assert sent["confirmed"] < sent["sent"] == IMAGES
        (recorder,) = (process for line, process in machines.running if line == RECORDER)
        until(lambda: recorder.code is not None, "the recorder ends by itself", PATIENCE_S)
        (ended,) = machines.end("gdp-proxy")
        assert ended == "gdp-proxy, exit 1"
        kept = _messages(disk / "full.mcap")
        assert 0 < kept <= sent["confirmed"]

    config.write_text(text.replace("received.mcap", str(tmp_path / "killed.mcap")))
    machines.start(RECORDER, machines.server)
    code, sent = _replay(machines, "--wait-readers 10")
    assert code == 0
    time.sleep(1.5)  # what is promised for a power cut: all but the last second
    assert "gdp-proxy, exit -9" in machines.end("gdp-proxy", signal.SIGKILL)
    machines.run(f"gdp recording finish {tmp_path / 'killed.mcap.partial'}", machines.robot)
    assert _messages(tmp_path / "killed.mcap") == IMAGES


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


def _replay(machines: Machines, more: str = "") -> tuple[int, dict[str, Any]]:
    """Replay; return the exit code and the content of the last events."""
    done = machines.hosts[machines.robot].run(*f"{_REPLAY} {more}".split())
    said: dict[str, Any] = {}
    for line in done.stdout.splitlines():
        said |= json.loads(line)
    return done.returncode, said
