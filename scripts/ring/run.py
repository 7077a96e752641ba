"""Run of the ring, from the recording to the result.

I/O.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from gdp.errors import ConfigError
from gdp.host.run_registry import Run
from lab.child import Child
from lab.children import READY_S, Children
from lab.credentials import Carried
from proxy.config.config import Encoding
from proxy.recordings.compare import compare
from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel, RosVersion
from ring.injection import Injection
from ring.live_plan import AUTHOR
from ring.options import Options
from ring.overlay import Overlay
from ring.progress import ProgressReporter
from ring.replay import Replay
from ring.result import Result, put_together

DEMO_S: Final = 10.0
_MAKING_S: Final = 240.0  # timeout for the generation of the demonstration recording
_DEMO_SCRIPT: Final = Path(__file__).parents[2] / "scripts" / "make_demo_bag.py"


class Ring:
    """The ring of one run, from its creation.

    Args:
        run: removes what is created here.

    Raises:
        ConfigError: the recording cannot be read or is empty.
        LocalError: the kernel refuses namespaces.
    """

    def __init__(self, options: Options, run: Run, reporter: ProgressReporter, bag: Path) -> None:
        with BagReader(bag) as reader:
            channels, self._total = list(reader.channels), reader.count
            self._rate = options.rate if options.seconds is None else _recorded_s(reader) / options.seconds
        if not channels:
            raise ConfigError(str(bag), "", "holds no topic")
        self.bag = bag
        self.options = options
        self._run = run
        self._reporter = reporter
        self._ros: RosVersion = channels[0].ros
        self._topics = topics_of(channels, options.encoding)
        if self.recording.exists():
            raise ConfigError(str(self.recording), "", "exists already; choose another --out")
        self.overlay = Overlay(options, run, reporter)
        self._children = self.overlay.children

    @property
    def recording(self) -> Path:
        """Return the path of the receiver's recording."""
        name = "recording.bag" if self._ros == 1 else "recording.mcap"
        return (self.options.out or self._run.directory) / name

    async def result(self) -> Result:
        """Send the recording through the ring, and compare."""
        await self.overlay.stand_up()
        receiver = self._start_receiver(self.recording)
        await self._children.ready([receiver])
        self._reporter.step(f"replaying {self._total} messages at {self.overlay.robot.switch}")
        sender = self._start_sender()
        await self._children.guarded(sender.wait_for("ready", READY_S))
        replay = Replay(self._children, sender, receiver, self._total, self._reporter)
        report = await replay.report(lambda: Injection(self.overlay, self.options.faults, self._reporter))
        self._reporter.step("comparing what was sent with what was recorded")
        exact = self.options.encoding == "cdr"
        comparisons = await self._children.guarded(asyncio.to_thread(compare, self.bag, self.recording, exact=exact))
        topics = put_together(comparisons, report.topics)
        return Result(
            topics,
            self.overlay.settings,
            unread=report.unread,
            complaints=report.complaints,
            traffic_s=report.traffic_s,
            silent_s=report.silent_s,
        )

    def start_again(self) -> Path:
        """Start a receiver that outlives this process, in place of the ended one; return the path of its recording."""
        path = self.recording.with_name(f"again-{self.recording.name}")
        self._start_receiver(path, heard=False)
        return path

    def _start_receiver(self, record: Path, *, heard: bool = True) -> Child:
        at, recorded = self.overlay.server, {"path": str(record), "format": "ros1" if self._ros == 1 else "mcap"}
        config = self.overlay.credentials.proxy(at, {"import": self._topics}, record=recorded)
        argv = ["-m", "proxy.cli.proxy", "--config", str(config), *(["--json"] if heard else [])]
        return self.overlay.start(at.switch, "proxy", argv, heard=heard)

    def _start_sender(self) -> Child:
        at = self.overlay.robot
        config = self.overlay.credentials.proxy(at, {"expose": self._topics})
        argv = ["-m", "proxy.cli.replay", str(self.bag), "--config", str(config), "--json"]
        return self.overlay.start(at.switch, "replay", [*argv, "--rate", str(self._rate)])


def topics_of(channels: Iterable[Channel], encoding: Encoding) -> tuple[Carried, ...]:
    """Return each topic once, even if several nodes published it; latched if any of them latched."""
    latched: dict[tuple[str, str], bool] = {}
    for channel in channels:
        key = (channel.topic, channel.type_name)
        latched[key] = latched.get(key, False) or channel.latched
    same = {"encoding": encoding, "reliable": True, "global": True}
    return tuple(Carried(*key, options={**same, "latched": latch}, author=AUTHOR) for key, latch in latched.items())


def _recorded_s(reader: BagReader) -> float:
    stamps_ns = [stamp_ns for _, stamp_ns, _ in reader.messages()]
    return max((max(stamps_ns) - min(stamps_ns)) / 1e9, 1e-3) if stamps_ns else 1.0


async def make_demo(run: Run, seconds: float) -> Path:
    """Generate a demonstration recording of this length in the run's directory; return the file."""
    path = run.directory / "demo.mcap"
    children = Children(run, kept=False)
    try:
        maker = children.start(
            "recording", [sys.executable, str(_DEMO_SCRIPT), "--seconds", str(seconds), "-o", str(path)], heard=False
        )
        if code := await maker.wait(_MAKING_S):
            raise maker.failed(f"ended with code {code}")
    finally:
        children.forget()
    return path
