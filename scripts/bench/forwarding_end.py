"""Processes of the forwarding bench, each in a namespace of its own: ``switch`` and ``end``.

Started by ``forwarding.py``. Each reads commands as JSON lines on stdin and answers each with a JSON line. An end has
AF_PACKET sockets on one device; frames are prepared in advance. The sink checks for frames every half millisecond: a
wake-up for each would be paid by the sender, in whose time the kernel forwards.
"""

from __future__ import annotations

import gc
import os
import socket
import struct
import sys
import time
from array import array
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any, Final

from peers.jsonl import order_waits, read_order, run_role, say
from thin_link.relay import open_device

from gdp.errors import LocalError
from gdp.frame.codec import ETHER_BYTES, ETHERTYPE
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.mmsg import SLOTS, MmsgBatch, make_batch
from gdp.ports.raw import RawPlane
from gdp.ports.sockets import kernel_drops
from gdp.switch.table import Table

SOURCE, SINK = bytes([0xA0]) * 32, bytes([0xB0]) * 32  # names with entries at every switch
_SO_ATTACH_FILTER: Final = 26
_RETURN: Final = 0x06  # BPF_RET | BPF_K
_SLOT_BYTES: Final = 64  # bytes that the kernel keeps of a frame for the sink, which copies no more
_NAP_S: Final = 0.0005
_SILENCE_S: Final = 0.2
_PATIENCE_S: Final = 1.0
_FRAME_MAX: Final = 1 << 16
_WARM: Final = 50  # warm-up pings, not counted
_LOST_MAX: Final = 3
_ENTRIES_MAX: Final = 1_024
_LEASE_S: Final = 1e9


def send(ifname: str, frame: bytes, seconds: float) -> dict[str, float]:
    """Send a whole frame again and again, flat out; return how often, and when it began and ended (monotonic)."""
    batch, head, drops = make_batch(len(frame)), frame[:ETHER_BYTES], [0] * 64
    frames = [frame[ETHER_BYTES:]] * SLOTS
    with open_device(ifname, 0) as sock:
        sent, start_s = 0, time.monotonic()
        while time.monotonic() < start_s + seconds:
            sent += batch.send(sock, frames, head, drops)
        return {"sent": sent, "start_s": start_s, "end_s": time.monotonic()}


def count_frames(ifname: str) -> dict[str, float]:
    """Count frames until all expected ones have arrived or no more come.

    The command ``expected`` states their number once the source is done. ``drops``: frames that found the buffer full.
    """
    expected, got, last_s, asked_s = None, 0, 0.0, 0.0
    batch = MmsgBatch(_SLOT_BYTES)
    step = array("B", struct.pack("=HBBI", _RETURN, 0, 0, _SLOT_BYTES))
    with open_device(ifname, ETHERTYPE) as sock:
        sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", 1, step.buffer_info()[0]))
        say(event="ready")
        while True:
            came = len(batch.receive(sock))
            if came:
                got, last_s = got + came, time.monotonic()
                continue
            if expected is None and order_waits():
                expected, asked_s = int(read_order()["expected"]), time.monotonic()
            if expected is not None and (got >= expected or time.monotonic() - max(last_s, asked_s) > _SILENCE_S):
                return {"got": got, "drops": kernel_drops(sock), "last_s": last_s}
            time.sleep(_NAP_S)


def ping(ifname: str, frame: bytes, pings: int) -> dict[str, list[float]]:
    """Return round-trip times in microseconds; a frame is sent again when the last one is back.

    Lost frames are left out. The function gives up after three lost frames.
    """
    times, lost, memory, now = list[float](), 0, bytearray(_FRAME_MAX), time.perf_counter
    with open_device(ifname, ETHERTYPE) as sock:
        sock.settimeout(_PATIENCE_S)
        while len(times) < pings + _WARM and lost < _LOST_MAX:
            start = now()
            sock.send(frame)
            try:
                sock.recv_into(memory)
            except TimeoutError:
                lost += 1
            else:
                times.append(now() - start)
    return {"rtt_us": [each * 1e6 for each in times[_WARM:]]}


def answer_pings(ifname: str, frame: bytes, pings: int) -> dict[str, int]:
    """Answer as many pings as ``ping`` sends, with ``frame``, or until none comes for a while; return their number."""
    answered, memory = 0, bytearray(_FRAME_MAX)
    with open_device(ifname, ETHERTYPE) as sock:
        sock.settimeout(_PATIENCE_S)
        say(event="ready")
        while answered < pings + _WARM:
            try:
                sock.recv_into(memory)
            except TimeoutError:
                break
            sock.send(frame)
            answered += 1
    return {"answered": answered}


def switch(ways: dict[str, str], plane: str) -> None:
    """Forward by a static table until stdin closes; answer each line with frames sent on and the processor time.

    ``ways``: the devices towards the source ("left") and the sink ("right"), each "device neighbour's-MAC" in hex.
    """
    left, right = (ways[side].split() for side in ("left", "right"))
    table = Table(_ENTRIES_MAX)
    try:
        ports = left[0], right[0]
        made = RawPlane(ports, table) if plane == "raw" else KernelPlane(ports, table, entries_max=_ENTRIES_MAX)
    except LocalError as error:
        say(refused_because=str(error))
        return
    own = {port.ifname: port for port in made.ports.values()}
    for name, (ifname, mac) in ((SINK, right), (SOURCE, left)):
        table.install(name, ((own[ifname].index, bytes.fromhex(mac) + own[ifname].mac),), _LEASE_S)

    def answer() -> None:
        read_order()  # ends the process where there is none
        say(forwarded=made.counters.forwarded, cpu_s=time.process_time())

    made.watch(sys.stdin, answer)
    say(event="ready")
    with closing(made):
        while True:
            made.poll(None)


def end(ifname: str, cpu: int) -> None:
    """Send, count, ping or answer on one device and one core, as commanded."""
    os.sched_setaffinity(0, {cpu})
    say(event="ready")
    gc.freeze()
    gc.disable()
    work: Mapping[str, Callable[..., Mapping[str, object]]]
    work = {"send": send, "count": count_frames, "ping": ping, "answer": answer_pings}
    while True:
        order: dict[str, Any] = read_order()
        if "frame" in order:
            order["frame"] = bytes.fromhex(order["frame"])
        say(**work[order.pop("do")](ifname, **order))


if __name__ == "__main__":
    run_role({"switch": lambda settings: switch(**settings), "end": lambda settings: end(**settings)})
