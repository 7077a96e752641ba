"""``gdp store replay`` as its user runs it: what a holder has goes to the live readers of an overlay."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Collection, Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gdp.intervals import TICK_S
from gdp.stores.keyring import OWNER_PUBLIC
from gdp.trust.right import Right
from lab.process import LabProcess, until
from netns_tests.session_lab import PATIENCE_S, SessionLab, lines_of, session_lab
from proxy.recordings.reader import BagReader
from tests.pages import ROOT

pytestmark = pytest.mark.netns

TOPICS = {"/tf": "tf2_msgs/msg/TFMessage", "/scan": "sensor_msgs/msg/LaserScan", "/odom": "nav_msgs/msg/Odometry"}
SECONDS = 4.0
RIGHTS: dict[str, dict[str, Collection[Right]]] = {
    "robot": {**dict.fromkeys(TOPICS, (Right.PUBLISH,)), "store": [Right.CALL]},
    "holder": {"store": [Right.SERVE]},
    "desk": {**dict.fromkeys(TOPICS, (Right.READ,)), "store": [Right.CALL]},
    "player": {**dict.fromkeys(TOPICS, (Right.READ, Right.PUBLISH)), "store": [Right.CALL]},
}


class Message(NamedTuple):
    """A message of a recording."""

    stamp_ns: int
    topic: str
    raw: bytes


def messages(path: Path) -> list[Message]:
    """Return the messages of a recording, in its order."""
    with BagReader(path) as reader:
        found = [
            Message(each.stamp_ns, reader.channels[each.channel].topic, each.raw)
            for each in reader.messages()
            if reader.channels[each.channel].topic in TOPICS
        ]
        assert reader.unread == ""
    return found


def content(found: list[Message]) -> dict[str, list[bytes]]:
    """Return the messages of each topic, in order."""
    return {topic: [each.raw for each in found if each.topic == topic] for topic in TOPICS}


class Site(NamedTuple):
    """A lab whose holder has the history of a drive."""

    lab: SessionLab
    drive: list[Message]
    store: Path

    @property
    def all(self) -> dict[str, list[int]]:
        """Return the number of each message of the drive, by topic."""
        return {topic: list(range(len(each))) for topic, each in content(self.drive).items()}

    def places(self, found: list[Message]) -> dict[str, list[int]]:
        """Return which messages of the drive these are, by topic; -1: none."""
        known = content(self.drive)
        return {
            topic: [known[topic].index(raw) if raw in known[topic] else -1 for raw in each]
            for topic, each in content(found).items()
        }

    def config(self, node: str, **keys: object) -> Path:
        """Write the configuration of a node; return it."""
        common = {"iface": f"{node}0", "delegations": f"{node}/delegations", "sandbox": False}
        return self.lab.write(node, node, **common, **keys)

    def rules(self, **keep: object) -> list[dict[str, object]]:
        """Return a rule for each topic."""
        owner, keys = str(self.lab.folder / "owner" / OWNER_PUBLIC), list(keep)[:1] and ["keep"]
        return [
            {"name": name, "type": of, "owner": owner, **{key: dict(keep) for key in keys}}
            for name, of in TOPICS.items()
        ]

    def listen(self, name: str) -> tuple[LabProcess, Path]:
        """Start a proxy that records what it reads; return it, and its recording when it has ended."""
        path = self.lab.folder / f"{name}.mcap"
        self.config("desk", **{"import": self.rules(), "record": {"path": str(path)}})
        return self.lab.start("proxy", "desk"), path

    def replay(self, *words: str) -> LabProcess:
        """Start the replay of all topics."""
        config = self.config("player", expose=self.rules())
        return self.lab.launch(
            ["gdp", "store", "replay", *TOPICS, "--node", "player", "--config", str(config), "--json", *words]
        )

    def export(self, name: str, *words: str) -> tuple[int, list[Message]]:
        """Return the exit code of an export, and what it wrote."""
        path = self.lab.folder / name
        done = self.lab.run("gdp", "store", "export", *TOPICS, "--node", "player", "-o", str(path), *words)
        return done.returncode, messages(path)


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    """The lab, after a drive in its own time that nothing has read."""
    with session_lab(RIGHTS, TOPICS) as lab:
        drive, store = lab.folder / "drive.mcap", lab.folder / "capsules"
        lab.output(str(ROOT / "scripts/make_demo_bag.py"), "--seconds", f"{SECONDS:g}", "-o", str(drive))
        holder = lab.launch(["gdp", "store", "serve", "holder", "--store", str(store), "--json"])
        assert '"ready"' in lines_of(holder, 1)[0]
        made = Site(lab, messages(drive), store)
        (lab.folder / "state").mkdir()
        config = made.config("robot", state="state", expose=made.rules(disk="200MB", to="store"))
        kept = lab.run("gdp-replay", str(drive), "--config", str(config), "--wait-readers", "0", "--json")
        assert '"done"' in kept.stdout, kept.stderr
        yield made


def ended(process: LabProcess) -> tuple[int | None, list[dict[str, Any]]]:
    """Return the exit code of a command, and the lines that it printed."""
    printed = process.reap(PATIENCE_S)
    return process.code, [json.loads(line) for line in printed.splitlines()]


def test_a_span_of_time_is_exported_and_no_more(site: Site) -> None:
    code, whole = site.export("whole.mcap")
    assert (code, [each.raw for each in whole]) == (0, [each.raw for each in site.drive])
    begin, end = whole[len(whole) // 3].stamp_ns, whole[2 * len(whole) // 3].stamp_ns
    code, part = site.export("part.mcap", "--from", f"{begin / 1e9:.9f}", "--to", f"{end / 1e9:.9f}")
    slack_ns = int(2 * TICK_S * 1e9)  # a record has the time at which it was appended
    inner = [each.raw for each in whole if begin + slack_ns < each.stamp_ns < end - slack_ns]
    assert code == 0
    assert set(inner) <= {each.raw for each in part}
    assert all(begin - slack_ns <= each.stamp_ns <= end + slack_ns for each in part)
    assert part == sorted(part, key=lambda each: each.stamp_ns)
    code, folder = site.export("folder", "--to", f"{end / 1e9:.9f}")
    assert (code, (site.lab.folder / "folder/folder.db3").exists()) == (0, True)
    assert len(part) < len(folder) < len(whole)
    assert folder == whole[: len(folder)]


@pytest.mark.parametrize(("rate", "least_s", "most_s"), [(2.0, SECONDS / 2, SECONDS), (0.0, 0.0, SECONDS / 2)])
def test_live_readers_get_what_the_robot_published_in_its_order(
    site: Site, rate: float, least_s: float, most_s: float
) -> None:
    reader, path = site.listen(f"rate-{rate:g}")
    code, lines = ended(site.replay("--rate", f"{rate:g}"))
    assert code == 0, lines
    reader.finish(signal.SIGTERM)
    site.lab.running.remove(reader)
    received = messages(path)
    assert site.places(received) == site.all
    lasted_s = (received[-1].stamp_ns - received[0].stamp_ns) / 1e9
    assert 0.9 * least_s < lasted_s < most_s, lasted_s
    order = {each.raw: number for number, each in enumerate(site.drive)}
    places = [order[each.raw] for each in received]
    late = max(highest - place for highest, place in zip(accumulate(places, max), places, strict=True))
    assert late < len(TOPICS) * 8 or not rate  # at once, a topic's messages share bundles


def test_ctrl_c_ends_a_replay(site: Site) -> None:
    replay = site.replay("--rate", "0.1", "--wait-readers", "0")
    while '"progress"' not in replay.read_line(PATIENCE_S).decode():
        pass
    begun_s = time.monotonic()
    replay.send(signal.SIGINT)
    code, _ = ended(replay)
    assert code == 1
    assert time.monotonic() - begun_s < SECONDS / 0.1 / 4


def test_a_history_with_damage_is_replayed_and_the_exit_code_says_so(site: Site) -> None:
    nothing = site.lab.run(
        "gdp", "store", "replay", "/scan", "--node", "player", "--config", "player.yaml", "--holder", "x"
    )
    assert (nothing.returncode, nothing.stderr[:6]) == (2, "error:")
    segment = next(site.store.rglob("*.records"))
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 1
    segment.write_bytes(data)
    reader, _ = site.listen("damaged")
    code, lines = ended(site.replay("--rate", "0"))
    assert any("altered" in problem for line in lines for problem in line.get("problems", ()))
    assert lines[-1]["event"] == "done"
    assert code == 1
    reader.finish(signal.SIGTERM)
    until(lambda: reader.code is not None, "the reader ends", PATIENCE_S)
