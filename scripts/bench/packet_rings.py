"""Packet rings bench: processor time of a frame by sendmmsg and recvmmsg, and through rings shared with the kernel.

    sudo .venv/bin/python scripts/bench/packet_rings.py [--rounds 5] [--count 20000] [--json FILE]

One thread in one process, over a veth pair. ``send``: bursts leave, and no socket is at the far end. ``both``: each
burst leaves by sendmmsg and is then read as the raw plane reads, as ``bytes``. The time of the kernel is included, also
that of the delivery, which runs in the sender's time. The bursts are those of the plane: one small message, the frames
of an image in one step of the loop (10 at MTU 9000, 64 at 1500), and a full batch.
``delay``: from the call that sends one frame until a receiver that polls has it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final

from report import Rounds, progress
from rings import BlockRing, SendRing, SlotRing
from skeleton import Options, Outcome, command_line, new_run, run_bench

from gdp.frame.codec import ETHER_BYTES, KIND_AT
from gdp.frame.kinds import Kind
from gdp.host import netns_files
from gdp.host.run_registry import RunRegistry
from gdp.ports.mmsg import make_batch, put_one
from gdp.ports.sockets import open_port
from gdp.simulation.namespaces import Namespaces
from gdp.simulation.topology import chain

SIZES: Final = (100, 1_500, 9_000)
BURSTS: Final = {100: (1, 64), 1_500: (1, 64), 9_000: (1, 10, 64)}
MTU: Final = 9_000
NEAR, FAR = "s1", "s2"
_MACS: Final = bytes.fromhex("026764700201026764700102")  # to the far end, from this one
_DELAYS: Final = 200
_PATIENCE_S: Final = 0.1
_RINGS: Final[dict[str, type[SlotRing] | type[BlockRing]]] = {"ring V2": SlotRing, "ring V3": BlockRing}
SEND_US, BOTH_US, DELAY_US = "send, us", "both, us", "delay, us"

Send = Callable[[list[bytes]], object]
Receive = Callable[[], list[bytes]]


@dataclass(frozen=True, slots=True)
class Bench:
    """The two namespaces, and how many frames a trial has."""

    spaces: Namespaces
    count: int

    @contextmanager
    def sender(self, kind: str, size: int) -> Iterator[Send]:
        """Open a sender on the near end."""
        bypass = kind.endswith("bypass")
        if kind.startswith("ring"):
            make = partial(SendRing, FAR, size, _MACS, bypass_qdisc=bypass)
            with closing(netns_files.inside(self.spaces.path(NEAR), make)) as ring:
                yield ring.send
            return
        with netns_files.inside(self.spaces.path(NEAR), partial(open_port, FAR, bypass_qdisc=bypass)) as opened:
            batch, drops = make_batch(MTU + ETHER_BYTES), [0] * 64

            def send(frames: list[bytes]) -> None:
                if len(frames) == 1:
                    put_one(opened, frames[0], _MACS, drops)
                else:
                    batch.send(opened, frames, _MACS, drops)

            yield send

    @contextmanager
    def receiver(self, kind: str, size: int) -> Iterator[Receive]:
        """Open a receiver on the far end."""
        if kind != "recvmmsg":
            make: Callable[[], SlotRing | BlockRing] = partial(_RINGS[kind], NEAR, size)
            with closing(netns_files.inside(self.spaces.path(FAR), make)) as ring:
                yield ring.receive
            return
        with netns_files.inside(self.spaces.path(FAR), partial(open_port, NEAR)) as opened:
            batch = make_batch(MTU + ETHER_BYTES)
            step = batch.slot_bytes

            def receive() -> list[bytes]:
                pool = batch.pool
                begins = range(ETHER_BYTES, len(pool), step)
                return [
                    bytes(memoryview(pool)[at : at + n]) for at, n in zip(begins, batch.receive(opened), strict=False)
                ]

            yield receive

    def send_us(self, kind: str, size: int, burst: int) -> float:
        """Return the processor time of a sent frame, in microseconds."""
        with self.sender(kind, size) as send:
            frames = _frames(size, burst)
            send(frames)
            begun_s = time.thread_time()
            for _ in range(self.count // burst):
                send(frames)
            return 1e6 * (time.thread_time() - begun_s) / (self.count // burst * burst)

    def both_us(self, kind: str, size: int, burst: int) -> float:
        """Return the processor time of a frame that is sent and received, in microseconds."""
        with self.sender("sendmmsg", size) as send, self.receiver(kind, size) as receive:
            frames, got, spent_s = _frames(size, burst), 0, 0.0
            for _ in range(self.count // burst):
                begun_s = time.thread_time()
                send(frames)
                spent_s += time.thread_time() - begun_s
                got += burst
                left, until_s = burst, time.monotonic() + _PATIENCE_S
                while left and time.monotonic() < until_s:
                    begun_s = time.thread_time()
                    came = len(receive())
                    spent_s += time.thread_time() - begun_s if came else 0.0  # an empty poll waits for a block
                    left -= came
                if left:
                    raise RuntimeError(f"{kind}: {left} of {burst} frames did not arrive")
            return 1e6 * spent_s / got

    def delay_us(self, kind: str, size: int) -> float:
        """Return the median time from sending a frame until it is read, in microseconds."""
        with self.sender("sendmmsg", size) as send, self.receiver(kind, size) as receive:
            frames, times = _frames(size, 1), []
            for _ in range(_DELAYS):
                begun_s = time.perf_counter()
                send(frames)
                while not receive():
                    pass
                times.append(time.perf_counter() - begun_s)
            return 1e6 * statistics.median(times)


def _frames(size: int, burst: int) -> list[bytes]:
    frame = bytearray(size)
    frame[KIND_AT] = Kind.DATA
    return [bytes(frame) for _ in range(burst)]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure all ways in turn, round by round."""
    over = Rounds()
    with new_run(runs) as run:
        bench = Bench(Namespaces(chain(2, MTU), run), options.count)
        for number in range(options.rounds):
            progress(f"round {number + 1}/{options.rounds}")
            for size in SIZES:
                for burst in BURSTS[size]:
                    case = f"{size} B, bursts of {burst}"
                    for kind in ("sendmmsg", "sendmmsg, bypass", "ring", "ring, bypass"):
                        over.add(kind, case, SEND_US, bench.send_us(kind, size, burst))
                    for kind in ("recvmmsg", "ring V2", "ring V3"):
                        over.add(kind, case, BOTH_US, bench.both_us(kind, size, burst))
                for kind in ("recvmmsg", "ring V2", "ring V3"):
                    over.add(kind, f"{size} B, bursts of 1", DELAY_US, bench.delay_us(kind, size))
    targets = [
        over.ratio(f"{case}: {ours} / {theirs}, {column}", ours, theirs, case, column, None)
        for case in over.cases()
        for ours, theirs, column in (
            ("ring", "sendmmsg", SEND_US),
            ("ring, bypass", "sendmmsg, bypass", SEND_US),
            ("ring V2", "recvmmsg", BOTH_US),
            ("ring V3", "recvmmsg", BOTH_US),
        )
    ]
    settings = {"rounds": options.rounds, "count": options.count}
    return Outcome("packet_rings", "Rings shared with the kernel", over, targets, settings, is_whole=False)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, has_record=True)
    parser.add_argument("--count", type=int, default=20_000, help="frames of a trial")
    run_bench(parser, measure)
