"""Run of the ring, from the recording to the result. I/O."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

from gdp.errors import ConfigError
from gdp.host.run_registry import Run
from lab.credentials import Carried
from lab.process import Event, FailedError, LabProcess
from lab.supervisor import READY_S, TAIL, Supervisor, exit_code
from proxy.config.config import Encoding
from proxy.recordings.compare import compare
from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel, RosVersion
from ring.live_plan import AUTHOR
from ring.options import Options
from ring.overlay import Injection, Overlay
from ring.result import Result, put_together
from ring.traffic import ProgressReporter, Traffic

ENDING_S: Final = 30.0  # to close a recording, or to get the last acknowledgements
STALL_S: Final = 30.0
_ALL: Final = "recording"  # its topics are counted together


class Replay:
    """One replay in progress.

    ``supervisor``: watches all the while; the receiver is released when it is requested to finish. ``topics``: what the
    receiver measured, one event a topic, once it has reported.
    """

    def __init__(
        self, supervisor: Supervisor, sender: LabProcess, receiver: LabProcess, total: int, reporter: ProgressReporter
    ) -> None:
        self._supervisor = supervisor
        self._sender = sender
        self._receiver = receiver
        self._reporter = reporter
        self._traffic = Traffic(total)
        self.topics: tuple[Event, ...] = ()
        for each in (sender, receiver):
            supervisor.hear(each, self._follow)

    def report(self, injection: Injection) -> Result:
        """Follow the traffic to its end, while faults are injected; return what both sides report, without topics."""
        self._reporter.begin_traffic(self._traffic.total)
        begun_s = time.monotonic()
        try:
            while not self._sender.is_silent:
                if not self._moves():
                    raise FailedError(f"nothing moved for {STALL_S:g} s: {self._traffic.words(0.0, time.monotonic())}")
            traffic_s = time.monotonic() - begun_s
            sender_code = exit_code(self._sender, ENDING_S)
            sent = self._supervisor.said(self._sender, "done")
            if sent is None:
                raise self._sender.failed(f"ended with code {sender_code} in the middle", TAIL)
            self._supervisor.release(self._receiver)
            self._receiver.send(signal.SIGINT)
            received = self._supervisor.wait_for(self._receiver, "done", ENDING_S)
            receiver_code = exit_code(self._receiver, ENDING_S)
        finally:
            complaints = injection.stop()
            self._reporter.close()
        complaints += [_not_confirmed(topic) for topic in sent["unconfirmed"]]
        complaints += [f"the sender ended with code {sender_code}"] if sender_code else []
        complaints += [f"the receiver ended with code {receiver_code}"] if receiver_code else []
        unread = sent.get("unread") or None
        self.topics = tuple(received["topics"])
        longest_s = self._traffic.longest_s
        return Result((), {}, unread=unread, complaints=tuple(complaints), traffic_s=traffic_s, silent_s=longest_s)

    def _moves(self) -> bool:
        before = self._traffic.changes
        return self._supervisor.follow(lambda: self._traffic.changes != before or self._sender.is_silent, STALL_S)

    def _follow(self, _: LabProcess, event: Event) -> None:
        if event["event"] != "progress":
            return
        traffic, now_s = self._traffic, time.monotonic()
        if "sent" in event:
            traffic.changes += traffic.sent < traffic.total  # it waits for the next stamp; a recording may have pauses
            traffic.label = ", ".join(event.get("unconfirmed", {}))
            traffic.note_sent(_ALL, event["sent"], now_s)
        else:
            traffic.lost, traffic.latency_ms = event["lost"], event.get("latency_ms")
            traffic.note_received(_ALL, event["received"] + event["lost"], now_s)
        self._reporter.traffic(traffic)


def _not_confirmed(topic: Event) -> str:
    messages, confirmed = topic["messages"], topic["confirmed"]
    return f"{topic['topic']}: {messages - confirmed} of {messages} were never confirmed"


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

    @property
    def recording(self) -> Path:
        """Return the path of the receiver's recording."""
        name = "recording.bag" if self._ros == 1 else "recording.mcap"
        return (self.options.out or self._run.directory) / name

    def result(self) -> Result:
        """Send the recording through the ring, and compare."""
        overlay, supervisor = self.overlay, self.overlay.supervisor
        overlay.stand_up()
        receiver = self._start_receiver()
        supervisor.ready(receiver)
        self._reporter.step(f"replaying {self._total} messages at {overlay.robot.switch}")
        sender = self._start_sender()
        supervisor.wait_for(sender, "ready", READY_S)
        replay = Replay(supervisor, sender, receiver, self._total, self._reporter)
        report = replay.report(Injection(supervisor, self.options.faults, overlay.inject))
        self._reporter.step("comparing what was sent with what was recorded")
        comparisons = compare(self.bag, self.recording, exact=self.options.encoding == "cdr")
        return replace(report, topics=put_together(comparisons, replay.topics), settings=overlay.settings)

    def _start_receiver(self) -> LabProcess:
        at, recorded = (
            self.overlay.server,
            {"path": str(self.recording), "format": "ros1" if self._ros == 1 else "mcap"},
        )
        config = self.overlay.credentials.proxy(at, {"import": self._topics}, record=recorded)
        return self.overlay.start_proxy(at.switch, config)

    def _start_sender(self) -> LabProcess:
        at = self.overlay.robot
        config = self.overlay.credentials.proxy(at, {"expose": self._topics})
        argv = ["-m", "proxy.cli.replay", str(self.bag), "--config", str(config), "--json"]
        return self.overlay.lab.start(at.switch, "replay", [*argv, "--rate", str(self._rate)])


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


def make_demo(run: Run, seconds: float) -> Path:
    """Generate a demonstration recording of this length in the run's directory; return the file."""
    path = run.directory / "demo.mcap"
    argv = [sys.executable, str(_DEMO_SCRIPT), "--seconds", str(seconds), "-o", str(path)]
    LabProcess(run, "recording", argv, heard=False).output(_MAKING_S)
    return path
