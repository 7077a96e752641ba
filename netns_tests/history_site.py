"""Site of a holder, a robot that keeps its topics, and who reads them live or afterwards."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from gdp.stores.keyring import OWNER_PUBLIC
from gdp.trust.right import Right
from lab.process import LabProcess
from netns_tests.session_lab import PATIENCE_S, SessionLab, lines_of, session_lab
from proxy.recordings.reader import BagReader
from tests.pages import ROOT

TOPICS = {"/tf": "tf2_msgs/msg/TFMessage", "/scan": "sensor_msgs/msg/LaserScan", "/odom": "nav_msgs/msg/Odometry"}
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
    holder: LabProcess

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

    def drive_past(self, **keep: object) -> LabProcess:
        """Start the robot, which drives in its own time and keeps its topics."""
        config = self.config("robot", state="state", expose=self.rules(disk="200MB", to="store", **keep))
        words = ["--config", str(config), "--wait-readers", "0", "--json"]
        return self.lab.launch(["gdp-replay", str(self.lab.folder / "drive.mcap"), *words])

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


@contextmanager
def history_site(seconds: float) -> Iterator[Site]:
    """Run a lab with a recorded drive of these seconds, and a holder of nothing yet."""
    with session_lab(RIGHTS, TOPICS) as lab:
        drive, store = lab.folder / "drive.mcap", lab.folder / "capsules"
        lab.output(
            sys.executable, str(ROOT / "scripts/make_demo_bag.py"), "--seconds", f"{seconds:g}", "-o", str(drive)
        )
        holder = lab.launch(["gdp", "store", "serve", "holder", "--store", str(store), "--json"])
        assert '"ready"' in lines_of(holder, 1)[0]
        (lab.folder / "state").mkdir()
        yield Site(lab, messages(drive), store, holder)


def ended(process: LabProcess) -> tuple[int | None, list[dict[str, Any]]]:
    """Return the exit code of a command, and the lines that it printed."""
    printed = process.reap(PATIENCE_S)
    return process.code, [json.loads(line) for line in printed.splitlines()]
