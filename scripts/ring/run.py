"""Run of the ring, from the recording to the result. I/O."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections.abc import Callable, Coroutine, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

from gdp.errors import ConfigError
from gdp.host.run_registry import Run
from lab.children import READY_S, Child, Children, cancel
from lab.credentials import Carried
from lab.events import Event
from lab.process import FailedError
from proxy.config.config import Encoding
from proxy.recordings.compare import compare
from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel, RosVersion
from ring.live_plan import AUTHOR
from ring.options import Options
from ring.overlay import Injection, Overlay
from ring.progress import ProgressReporter, Traffic
from ring.result import Result, put_together
from ring.silence import Silence

ENDING_S: Final = 30.0  # to close a recording, or to get the last acknowledgements
STALL_S: Final = 30.0
_ALL: Final = "recording"  # its topics are counted together

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Report:
    """Final reports of both sides.

    Args:
        topics: the receiver's measurements, one event a topic.
        unread: why some of the recording could not be read; None if all could.
        complaints: deviations from the expected run.
        traffic_s: from the first message until all was confirmed or given up.
        silent_s: the longest time in which messages were due and none came, to half a second.
    """

    topics: tuple[Event, ...]
    unread: str | None
    complaints: tuple[str, ...]
    traffic_s: float
    silent_s: float


class Replay:
    """One replay in progress.

    ``children``: supervised throughout; the receiver is released when it is requested to finish.
    """

    def __init__(
        self, children: Children, sender: Child, receiver: Child, total: int, reporter: ProgressReporter
    ) -> None:
        self._children = children
        self._sender = sender
        self._receiver = receiver
        self._reporter = reporter
        self._traffic = Traffic(total=total)
        self._silence = Silence()
        self._unconfirmed = ""  # names of topics
        self._moved = asyncio.Event()

    async def report(self, inject: Callable[[], Injection]) -> Report:
        """Follow the traffic to its end, while ``inject`` causes faults."""
        self._reporter.begin_traffic(self._traffic.total)
        heard = asyncio.ensure_future(self._listen(self._receiver))
        injection, begun_s = inject(), time.monotonic()
        try:
            sent = await self._children.guarded(self._unstalled(self._listen(self._sender)))
            traffic_s = time.monotonic() - begun_s
            sender_code = await self._sender.wait(ENDING_S)
            if sent is None:
                raise self._sender.failed(f"ended with code {sender_code} in the middle")
            received, receiver_code = await self._finish(heard)
        finally:
            await cancel(heard)
            await injection.stop()
            self._reporter.end_traffic()
        complaints = injection.complaints()
        complaints += [_not_confirmed(topic) for topic in sent.parts("unconfirmed")]
        complaints += [f"the sender ended with code {sender_code}"] if sender_code else []
        complaints += [f"the receiver ended with code {receiver_code}"] if receiver_code else []
        unread = sent.text_or_none("unread") or None
        topics = tuple(received.parts("topics"))
        return Report(topics, unread, tuple(complaints), traffic_s, self._silence.longest_s)

    async def _finish(self, heard: asyncio.Future[Event | None]) -> tuple[Event, int]:
        """Request the receiver to close its recording; return its last event and its exit code."""
        self._children.may_end(self._receiver)
        self._receiver.send(signal.SIGINT)
        try:
            received = await self._children.guarded(asyncio.wait_for(heard, ENDING_S))
        except asyncio.TimeoutError:
            raise self._receiver.failed(f"did not finish within {ENDING_S:g} s") from None
        code = await self._receiver.wait(ENDING_S)
        if received is None:
            raise self._receiver.failed(f"ended with code {code} without a report")
        return received, code

    async def _listen(self, child: Child) -> Event | None:
        """Follow a child until it closes its output; return its last event, None if there was none."""
        done = None
        async for event in child.events():
            if event.name == "progress":
                self._follow(event)
            elif event.name == "done":
                done = event
        return done

    def _follow(self, event: Event) -> None:
        before, now_s = self._traffic, time.monotonic()
        if "sent" in event.fields:
            self._silence.sent(_ALL, event.count("sent"), now_s)
            self._unconfirmed = ", ".join(event.part("unconfirmed").fields)
            self._traffic = replace(before, sent=event.count("sent"))
            waiting = before.sent < before.total  # for the next stamp of the recording, which may have long pauses
        else:
            received, lost = event.count("received"), event.count("lost")
            latency_ms = event.number_or_none("latency_ms")
            self._silence.received(_ALL, received + lost, now_s)
            self._traffic = replace(before, received=received, lost=lost, latency_ms=latency_ms)
            waiting = False
        if waiting or self._traffic != before:
            self._moved.set()
        silent = tuple((self._unconfirmed or flow, seconds) for flow, seconds in self._silence.silent(now_s))
        self._reporter.traffic(replace(self._traffic, behind=self._silence.behind, silent=silent))

    async def _unstalled(self, work: Coroutine[None, None, T]) -> T:
        """Run ``work`` as long as traffic moves."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                self._moved.clear()
                moved = asyncio.ensure_future(self._moved.wait())
                done, _ = await asyncio.wait([task, moved], timeout=STALL_S, return_when=asyncio.FIRST_COMPLETED)
                await cancel(moved)
                if not done:
                    raise FailedError(f"nothing moved for {STALL_S:g} s: {self._traffic.words(0.0)}")
            return task.result()
        finally:
            await cancel(task)


def _not_confirmed(topic: Event) -> str:
    messages, confirmed = topic.count("messages"), topic.count("confirmed")
    return f"{topic.text('topic')}: {messages - confirmed} of {messages} were never confirmed"


DEMO_S: Final = 10.0
_MAKING_S: Final = 240.0  # timeout for the generation of the demonstration recording
_DEMO_SCRIPT: Final = Path(__file__).parents[2] / "scripts" / "make_demo_bag.py"


class Ring:
    """The ring of one run, from its creation.

    ``run``: removes what is created here. Raises ``ConfigError``: the recording cannot be read or is empty. Raises
    ``LocalError``: the kernel refuses namespaces.
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
    stamps_ns = [message.stamp_ns for message in reader.messages()]
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
