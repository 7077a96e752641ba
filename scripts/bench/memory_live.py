"""The memory bench on real processes: a robot's session, its uplink, a switch, a RIB and `gdp store serve`.

I/O; needs root. The uplink is a veth pair whose two ends each carry 10 Mbit/s (tbf); it is gone while it is down.
"""

from __future__ import annotations

import hashlib
import json
import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from report import Rounds, percentile
from skeleton import Options

import gdp
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.reading import CapsuleReader
from gdp.session.protocol.wire import read_message
from gdp.trust.right import Right
from lab.process import LabProcess, calling, python_path
from netns_tests.session_lab import PATIENCE_S, SessionLab, session_lab

CASE: Final = "real processes"
CAMERA, COMMANDS, IMAGE_BYTES = "/camera", "/cmd_vel", 40_000
TYPES: Final = {CAMERA: "sensor_msgs/msg/CompressedImage", COMMANDS: "geometry_msgs/msg/Twist"}
RIGHTS: Final = {
    "robot": {CAMERA: [Right.PUBLISH], COMMANDS: [Right.READ], "store": [Right.CALL]},
    "holder": {"store": [Right.SERVE]},
    "desk": {CAMERA: [Right.READ], COMMANDS: [Right.PUBLISH], "store": [Right.CALL]},
}
SHAPE: Final = ["root", "tbf", "rate", "10mbit", "burst", "3kb", "latency", "500ms"]
Pieces = list[tuple[float, float]]  # seconds at which the uplink comes and goes


def say(**values: object) -> None:
    """Print a line of JSON."""
    print(json.dumps(values), flush=True)


def end_of(node: str, name: str, size: str, hertz: str, seconds: str, reads: str, keeps: str) -> None:
    """Publish messages of a size, and read; say when this begins, what was published, the ages, and when all is kept.

    ``reads``, ``keeps``: a name and a holder, or nothing.
    """
    rng, recorded, ages = random.Random(1), list[str](), list[tuple[float, float]]()

    def read(subscription: gdp.Subscription) -> None:
        with suppress(gdp.ClosedError):
            for message in subscription:
                sent_s = int(message.payload.split(b" ", 1)[0]) / 1e9
                ages.append((sent_s, time.time() - sent_s))

    with gdp.open(node, state="state" if keeps else None) as session:
        if reads:
            threading.Thread(target=read, args=[session.subscribe(reads)], daemon=True).start()
        with session.publisher(name, reliable=False, keep=[keeps] if keeps else []) as publisher:
            begun_s = time.monotonic()
            say(begun=begun_s)
            for number in range(int(float(seconds) * float(hertz))):
                time.sleep(max(begun_s + number / float(hertz) - time.monotonic(), 0.0))
                message = b"%d " % time.time_ns() + rng.randbytes(int(size))
                recorded.append(hashlib.sha256(message).hexdigest())
                publisher.put(message)
            while keeps and not publisher.is_kept:
                time.sleep(0.02)
            say(ended=time.monotonic(), recorded=recorded, ages=ages)


def export() -> None:
    """Say the digests of all messages that the holder has, and what an audit finds."""
    with gdp.open("desk") as session:
        topic = session.core.resolve(CAMERA, Right.READ)

        def ask(request: HolderRequest) -> HolderAnswer:
            return HolderAnswer.from_cbor(session.call("store", request.to_cbor(), replication=1).payload)

        (about,) = ask(HolderRequest(ask=Ask.LIST, topic=topic.name)).descriptors
        reader, found = CapsuleReader(about, {topic.name: topic.secrets}), list[str]()
        while not reader.is_done:
            for kept in reader.handle_response(ask(reader.next_request())):
                found.append(hashlib.sha256(read_message(kept.message)[1]).hexdigest())
        say(recorded=found, findings=len(reader.audit.findings))


@contextmanager
def site() -> Iterator[tuple[SessionLab, Callable[..., LabProcess]]]:
    """Run switch, RIB and holder, with a robot's uplink; yield them, and what starts an end."""
    with session_lab(RIGHTS, TYPES) as lab:
        lab.environment["PYTHONPATH"] = python_path(Path(__file__).parent)
        (lab.folder / "state").mkdir()
        for device in ("robot0", "robot0-s"):
            lab.output("tc", "qdisc", "add", "dev", device, *SHAPE)
        holder = lab.launch(
            ["gdp", "store", "serve", "holder", "--store", str(lab.folder / "store"), "--quota", "10", "--json"]
        )
        holder.read(PATIENCE_S)
        yield lab, lambda *words: lab.launch(calling(end_of, *words))


def set_uplink(lab: SessionLab, *, up: bool) -> None:
    """Bring the uplink back, or down."""
    lab.output("ip", "link", "set", "dev", "robot0-s", "up" if up else "down")


def history(options: Options, over: Rounds, ideal_s: Callable[[Pieces, list[tuple[float, int]]], float]) -> None:
    """Record for ``options.seconds`` over an uplink that is gone half the time."""
    rng, pieces = random.Random(options.seed), Pieces()
    with site() as (lab, start):
        robot = start("robot", CAMERA, IMAGE_BYTES, 10, options.seconds, "", "store")
        begun_s = robot.read(PATIENCE_S)["begun"]
        while time.monotonic() - begun_s < options.seconds:
            for up in (False, True):
                set_uplink(lab, up=up)
                at_s = time.monotonic() - begun_s
                pieces += [(at_s, float("inf"))] if up else []
                if not up and pieces:
                    pieces[-1] = (pieces[-1][0], at_s)
                robot.has_line(min(rng.uniform(1, 30), options.seconds / 4))
        said = robot.read(options.seconds + 10 * PATIENCE_S)
        took_s, stored = (
            said["ended"] - begun_s,
            sum(each.stat().st_size for each in lab.folder.rglob("store/*/*.records")),
        )
        found = json.loads(lab.output(*calling(export)))
    count = int(options.seconds)
    written = [(float(each), stored * each // count) for each in range(count + 1)]
    over.add("ours", CASE, "time / what the bytes need", took_s / ideal_s(pieces, [*written, (took_s, stored)]))
    same = found["recorded"] == said["recorded"] and not found["findings"]
    over.add("ours", CASE, "equal byte for byte", float(same))


def live(options: Options, over: Rounds, *, keeps: bool) -> None:
    """Measure commands and pictures for ``options.live`` seconds, after an outage whose records upload meanwhile."""
    lasts_s = options.outage + options.live + 10
    with site() as (lab, start):
        desk = start("desk", COMMANDS, 40, 20, lasts_s + PATIENCE_S, CAMERA, "")
        desk.read(PATIENCE_S)
        robot = start("robot", CAMERA, IMAGE_BYTES, 10, lasts_s, COMMANDS, "store" if keeps else "")
        robot.read(PATIENCE_S)
        set_uplink(lab, up=False)
        robot.has_line(options.outage)
        set_uplink(lab, up=True)
        begin_s = time.time() + 5
        ages = robot.read(lasts_s + 5 * PATIENCE_S)["ages"], desk.read(lasts_s + 5 * PATIENCE_S)["ages"]
    commands, images = ([age for at, age in each if begin_s < at < begin_s + options.live] for each in ages)
    who = "while it uploads" if keeps else "without"
    over.add(who, CASE, "cmd_vel p99, ms", 1e3 * percentile(commands, 0.99))
    over.add(who, CASE, "image age p50, ms", 1e3 * percentile(images, 0.5))
