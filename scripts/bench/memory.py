"""Memory bench: a robot's history at a holder, over an uplink that is gone half the time.

Rows in virtual time are the product's own protocol cores in the simulated ring: the robot at nuc1 behind 10 Mbit/s, the
holder at nuc3. It publishes pictures of 40 kB at 10 Hz. What the bytes need is the time in which an ideal uplink, up
and down at the same seconds, would have carried the same bytes. Ingest is in processor time of one core. What an
upload costs live traffic is measured with real processes alone.

.venv/bin/python scripts/bench/memory.py
.venv/bin/python scripts/bench/memory.py --quick --no-save
sudo .venv/bin/python scripts/bench/memory.py --real --seconds 600 --no-save
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final

from machine import ROOT
from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

sys.path.append(str(ROOT))

import memory_live

from gdp.capsule.audit import Audit
from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.holder import BATCH_BYTES, Ask, HolderRequest
from gdp.capsule.record import RecordType
from gdp.intervals import ADVERTISEMENT
from gdp.service.replication import Mode, Replication
from gdp.session.protocol.client_core import CALL_TIMEOUT_S, Call, ClientCore
from gdp.stores.capsule_store import CapsuleStore
from gdp.trust.right import Right
from tests.journeys.capsules import LIMITS, STORE, Holder, Keeping, read_from
from tests.journeys.flows import ROBOT, advertise, ring

HOLDER, DESK = "nuc3/store", "nuc3/desk"
UPLINK_BYTES_S: Final = 1_250_000
FIFO_S: Final = 0.5
RING_BYTES: Final = 1 << 32  # more than an hour of pictures
IMAGE_BYTES, IMAGE_HZ = 40_000, 10
FRAME_BYTES, RTT_S = 1_400, 0.06
MARKER: Final = b"the robot is in the laboratory"
CASE: Final = "history"


def site(folder: Path) -> tuple[Keeping, Holder]:
    """Return what a robot behind its uplink keeps, and a holder, in the ring."""
    world = ring(lease_s=ADVERTISEMENT.lease_s, keepalive_ms=None)
    for label in (HOLDER, DESK):
        world.add_member(label, "nuc3")
    assert world.run_until_attached()
    world.leads[ROBOT].bytes_s, world.leads[ROBOT].fifo_s = UPLINK_BYTES_S, FIFO_S
    flow = advertise(world, "/camera")
    holder = Holder(world, folder / "holder", HOLDER, limits=replace(LIMITS, owner_bytes=RING_BYTES))
    return Keeping(flow, folder / "robot", RING_BYTES), holder


def image(rng: random.Random, number: int) -> bytes:
    """Return a numbered picture with a text that only a reader may find."""
    return b"%d " % number + MARKER + rng.randbytes(IMAGE_BYTES)


def ideal_s(pieces: list[tuple[float, float]], cumulated: list[tuple[float, int]]) -> float:
    """Return when an ideal uplink has carried all bytes: ``pieces`` are its times up, ``cumulated`` what there is."""
    carried, total = 0.0, cumulated[-1][1]
    edges = sorted({*(at_s for at_s, _ in cumulated), *(edge for piece in pieces for edge in piece)})
    known = dict(cumulated)
    there = 0
    for begin, end in pairwise(edges):
        there = known.get(begin, there)
        if any(up <= begin < down for up, down in pieces):
            possible = (end - begin) * UPLINK_BYTES_S
            if carried + min(possible, there - carried) >= total:
                return begin + (total - carried) / UPLINK_BYTES_S
            carried += min(possible, there - carried)
    return edges[-1]


def history(options: Options, folder: Path, over: Rounds) -> tuple[Keeping, Holder]:
    """Run the robot for ``options.seconds`` with an uplink that is gone half the time."""
    keeping, holder = site(folder)
    world, rng, at_s, pieces = keeping.flow.world, random.Random(options.seed), 0.0, list[tuple[float, float]]()
    begun_s = world.network.now.mono_s
    while at_s < options.seconds:
        down_s, up_s = rng.uniform(1, 30), rng.uniform(1, 30)
        world.network.call(at_s, partial(world.network.set_link, world.leads[ROBOT], up=False))
        world.network.call(at_s + down_s, partial(world.network.set_link, world.leads[ROBOT], up=True))
        pieces.append((at_s + down_s, at_s + down_s + up_s))
        at_s += down_s + up_s
    pieces[-1] = (pieces[-1][0], float("inf"))
    sent = keeping.publish_at([each / IMAGE_HZ for each in range(int(options.seconds * IMAGE_HZ))], partial(image, rng))
    written: list[tuple[float, int]] = [(0.0, 0)]

    def is_done() -> bool:
        elapsed_s = world.network.now.mono_s - begun_s
        if keeping.kept.ring.end != written[-1][1]:
            written.append((elapsed_s, keeping.kept.ring.end))
        return elapsed_s > options.seconds and keeping.is_uploaded()

    assert keeping.run(options.seconds * 3 + 60, holder, until=is_done)
    took_s = world.network.now.mono_s - begun_s
    over.add("ours", CASE, "time / what the bytes need", took_s / ideal_s(pieces, [*written, (took_s, written[-1][1])]))
    kept, reader = read_from(holder, keeping)
    same = [each.message for each in kept] == sent and not reader.audit.findings
    over.add("ours", CASE, "equal byte for byte", float(same))
    files = [path.read_bytes() for path in (folder / "holder").rglob("*") if path.is_file()]
    over.add("ours", CASE, "readable bytes", float(sum(data.count(MARKER) * len(MARKER) for data in files)))
    return keeping, holder


def seeks(options: Options, keeping: Keeping, holder: Holder, over: Rounds) -> None:
    """Measure calls that seek an instant, over a round trip of 60 ms."""
    world, rng = keeping.flow.world, random.Random(options.seed)
    world.leads[DESK].delay_s = RTT_S / 2
    desk = world.members[DESK]
    client = ClientCore(desk, world.topic(STORE, desk, [Right.CALL], kind="service"), "desk", start=9)
    end_ns, took = int(world.network.now.unix_s * 1e9), list[float]()
    for _ in range(options.seeks + 1):
        at_ns = end_ns - int(rng.random() * options.seconds * 1e9)
        request = HolderRequest(ask=Ask.READ, capsule=keeping.kept.name, time_ns=at_ns)
        once, begun_s = Replication(Mode.SOME, copies=1), world.network.now.mono_s
        call = Call(payload=request.to_cbor(), timeout_s=CALL_TIMEOUT_S, replication=once)
        client.begin(call, begun_s)

        def turn(call: Call = call) -> bool:
            now_s = world.network.now.mono_s
            for message in desk.poll_messages():
                client.receive(message, now_s)
            if (due_s := client.get_timer()) is not None and now_s >= due_s:
                client.handle_timer(now_s)
            desk.flush(now_s)
            world.network.send_pending(DESK)
            return call.is_done

        assert keeping.run(30, holder, until=turn)
        assert call.response is not None
        wall_s = timed(partial(holder.store.handle, request.to_cbor(), desk.name))
        took.append(world.network.now.mono_s - begun_s + wall_s)
    over.add("ours", CASE, "seek p99, ms", 1e3 * percentile(took[1:], 0.99))  # the first one finds the service


def timed(work: Callable[[], object]) -> float:
    """Return the processor seconds of work."""
    begun_s = time.process_time()
    work()
    return time.process_time() - begun_s


def log(keeping: Keeping, size: int, count: int, begun_ms: int) -> tuple[list[bytes], HolderRequest]:
    """Return the records of a capsule with frames of a size, and the request that describes it."""
    descriptor = replace(keeping.kept.ring.descriptor, begun_ms=begun_ms)
    identity = next(each for each in keeping.flow.world.identities.values() if each.name == keeping.flow.member.name)
    writer, rng = ChainWriter(Chain(descriptor.name, descriptor.key), identity.key), random.Random(size)
    wires = [writer.checkpoint(0)]
    for number in range(count):
        time_ns = number * 10_000_000
        wires.append(writer.append(RecordType.MESSAGE, time_ns, [rng.randbytes(size)], number + 1, 1))
        if writer.is_due(time_ns):
            wires.append(writer.checkpoint(time_ns))
    wires.append(writer.checkpoint(count * 10_000_000))
    return wires, HolderRequest(ask=Ask.APPEND, capsule=descriptor.name, descriptor=descriptor)


def ingest(options: Options, keeping: Keeping, folder: Path, over: Rounds) -> None:
    """Measure how fast a holder verifies and stores records, and what they take on its disk."""
    count = options.megabytes * 1_000_000 // FRAME_BYTES
    wires, request = log(keeping, FRAME_BYTES, count, 2)
    data, client, took_s = b"".join(wires), keeping.flow.member.name, 0.0
    with CapsuleStore(folder, LIMITS) as store:
        for at in range(0, len(data), BATCH_BYTES):
            wire = replace(request, offset=at, data=data[at : at + BATCH_BYTES]).to_cbor()
            took_s += timed(partial(store.handle, wire, client))
    held = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    over.add("ours", "holder", "ingest, MB/s", count * FRAME_BYTES / took_s / 1e6)
    over.add("ours", "holder", "disk / ciphertext", held / (count * FRAME_BYTES))


def damages(options: Options, keeping: Keeping, over: Rounds) -> None:
    """Draw damages of stored records, and count those that an audit names."""
    rng, named = random.Random(options.seed), 0
    wires, request = log(keeping, 200, 120, 3)
    forks, key = log(keeping, 201, 120, 3)[0], keeping.kept.ring.descriptor.key
    for number in range(options.drawn):
        damaged, at = list(wires), rng.randrange(1, len(wires) - 2)
        kind, to = number % 4, min(at + 1 + rng.randrange(5), len(wires) - 1)
        if kind == 0:
            flipped = bytearray(wires[at])
            flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
            damaged[at] = bytes(flipped)
        elif kind == 1:
            del damaged[at]
        elif kind == 2:
            damaged.insert(to, damaged.pop(at))
        else:
            damaged[at] = forks[at]
        audit = Audit(request.capsule, key)
        audit.add(b"".join(damaged))
        named += any(each.first <= at <= each.last for each in audit.finish())
    over.add("ours", "audit", "share of damages named", named / options.drawn)


def measure_real(options: Options) -> Outcome:
    """Measure real processes."""
    over = Rounds()
    progress("history")
    memory_live.history(options, over, ideal_s)
    for keeps in (False, True):
        progress("live traffic")
        memory_live.live(options, over, keeps=keeps)
    case, uploads, without = memory_live.CASE, "while it uploads", "without"
    targets = [
        over.target("time / what the bytes need", "ours", case, "time / what the bytes need", 1.2, at_most=True),
        over.target("equal byte for byte", "ours", case, "equal byte for byte", 1),
        over.difference("live cmd_vel p99, ms more", uploads, without, case, "cmd_vel p99, ms", 5),
        over.ratio("live image age", uploads, without, case, "image age p50, ms", 1.1, at_most=True),
    ]
    return Outcome("memory", "A robot's history, on real processes", over, targets, {"seconds": options.seconds})


def measure(options: Options) -> Outcome:
    """Measure all rows."""
    if options.real:
        return measure_real(options)
    over = Rounds()
    with (
        tempfile.TemporaryDirectory(prefix="gdp-memory-", dir="/dev/shm") as text,
        tempfile.TemporaryDirectory(prefix="gdp-memory-", dir=options.disk) as disk,
    ):
        folder = Path(text)
        progress("history")
        keeping, holder = history(options, folder / "history", over)
        progress("seeks, ingest, damages")
        seeks(options, keeping, holder, over)
        ingest(options, keeping, Path(disk) / "ingest", over)
        damages(options, keeping, over)
    targets = [
        over.target("time / what the bytes need", "ours", CASE, "time / what the bytes need", 1.2, at_most=True),
        over.target("equal byte for byte", "ours", CASE, "equal byte for byte", 1),
        over.target("readable bytes before the grant", "ours", CASE, "readable bytes", 0, at_most=True),
        over.target("seek p99, ms", "ours", CASE, "seek p99, ms", 200, at_most=True),
        over.target("ingest, MB/s of a core", "ours", "holder", "ingest, MB/s", 100),
        over.target("disk / ciphertext", "ours", "holder", "disk / ciphertext", 1.05, at_most=True),
        over.target("damages named", "ours", "audit", "share of damages named", 1),
    ]
    settings = {"virtual seconds": options.seconds, "seed": options.seed, "damages drawn": options.drawn}
    return Outcome("memory", "A robot's history at a holder", over, targets, settings)


if __name__ == "__main__":
    quick = {"seconds": 30.0, "live": 10.0, "seeks": 10, "megabytes": 5, "drawn": 100}
    parser = command_line(__doc__, seconds=3_600.0, seconds_of="of virtual time", quick=quick, has_record=True)
    for name, value, text in (
        ("seed", 1, "of all draws"),
        ("outage", 30.0, "seconds of the outage before live traffic is measured, with --real"),
        ("live", 15.0, "seconds of live traffic, with --real"),
        ("seeks", 100, "calls"),
        ("megabytes", 100, "of frames to ingest"),
        ("drawn", 1_000, "damages"),
    ):
        parser.add_argument(f"--{name}", type=type(value), default=value, help=f"{text} (default: %(default)s)")
    parser.add_argument("--real", action="store_true", help="real processes in real time: name 600 seconds; needs root")
    parser.set_defaults(is_whole=lambda options: not options.real)
    parser.add_argument("--disk", type=Path, default=ROOT, help="folder of the holder (default: %(default)s)")
    run_bench(parser, measure)
