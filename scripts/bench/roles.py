"""The processes of the forwarding benchmark, each in a namespace of its own: switch, source, sink, echo.

Started by ``forwarding.py``. Each reads commands as JSON lines on stdin and answers every one with a JSON line.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import select
import struct
import sys
import time
from pathlib import Path
from typing import Any

from gdp.frame.codec import ETHER_BYTES, HEADER_BYTES, Header, encode
from gdp.frame.kinds import Kind
from gdp.limits import HOPS_MAX

CLONE_NEWNET = 0x40000000
SINK, SOURCE = bytes([0xB0]) * 32, bytes([0xA0]) * 32
ECHO = bytes([0xE0]) * 32
NUMBER = struct.Struct("!Q")
NUMBER_AT = ETHER_BYTES + 8


def enter(namespace: str) -> None:
    """Move this process into a named network namespace."""
    fd = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(fd, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), f"setns {namespace}")
    os.close(fd)


def answer(**values: Any) -> None:
    print(json.dumps(values), flush=True)


def command() -> dict[str, Any]:
    line = sys.stdin.readline()
    if not line:
        sys.exit(0)
    return dict(json.loads(line))


def resident_mib() -> float:
    """Return what this process holds now; its recorded maximum would include the parent's, from before exec."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / (1 << 20)


def make_plane(kind: str, ifnames: list[str], table: Any) -> Any:
    if kind == "scapy":
        from gdp.ports.scapy_plane import ScapyPlane

        return ScapyPlane(ifnames, table)
    from gdp.ports.raw import RawPlane

    return RawPlane(ifnames, table)


def switch(plane_kind: str, macs: dict[str, str], **_: Any) -> None:
    """Forward between two ports by a static table, until stdin closes."""
    from gdp.switch.table import Table

    table = Table()
    plane = make_plane(plane_kind, ["left", "right"], table)
    own = {port.ifname: port for port in plane.ports.values()}
    for name, ifname in ((SINK, "right"), (ECHO, "right"), (SOURCE, "left")):
        table.install(name, ((own[ifname].index, bytes.fromhex(macs[ifname]) + own[ifname].mac),), float("inf"))

    def asked() -> None:
        command()
        counters, used = plane.counters, resource.getrusage(resource.RUSAGE_SELF)
        answer(
            frames_in=counters.frames_in,
            forwarded=counters.forwarded,
            drops=sum(counters.drops),
            cpu_s=used.ru_utime + used.ru_stime,
            rss_mib=resident_mib(),
        )

    plane.watch(sys.stdin, asked)
    answer(event="ready")
    while True:
        plane.poll(None)


def source(payload_bytes: int, macs: dict[str, str], **_: Any) -> None:
    """Send numbered frames at a given rate, or measure round trips one frame at a time."""
    from gdp.ports.batch import SLOTS, make_batch
    from gdp.ports.raw import RawPlane
    from gdp.ports.sockets import open_port

    header = Header(Kind.DATA, 0, HOPS_MAX, 1, payload_bytes, 0, 0, 1, 1, SINK, SOURCE)
    plane = RawPlane(["right"])
    own, hop_mac = plane.ports[0], bytes.fromhex(macs["right"])
    answer(event="ready")
    while True:
        asked = command()
        if asked["do"] == "ping":
            answer(rtt_us=ping(plane, hop_mac, asked["count"], asked["payload_bytes"]))
            continue
        sock, batch = open_port("right"), make_batch(own.mtu + ETHER_BYTES)
        rate, seconds = asked["rate"], asked["seconds"]
        batch.fill([encode(header) + os.urandom(payload_bytes)] * SLOTS)
        burst, total = max(1, min(SLOTS, int(rate / 1000))), int(rate * seconds)
        drops, step, sent = [0] * 64, batch.slot_bytes, 0
        start = time.monotonic()
        while sent < total:
            behind = (time.monotonic() - start) * rate - sent
            if behind < burst:
                time.sleep((burst - behind) / rate)
                continue
            for slot in range(burst):
                NUMBER.pack_into(batch.pool, slot * step + NUMBER_AT, sent + slot)
            batch.put(sock, 0, burst, hop_mac + own.mac, drops)
            sent += burst
        answer(sent=sent, refused=sum(drops), start_s=start, end_s=time.monotonic())
        sock.close()


def ping(plane: Any, hop_mac: bytes, count: int, payload_bytes: int) -> list[float]:
    """Return round-trip times in microseconds of frames sent one at a time."""
    times = []
    for number in range(count + 20):
        header = Header(Kind.ECHO_REQUEST, 0, HOPS_MAX, 0, payload_bytes, number, 0, 1, 1, ECHO, SOURCE)
        frame = encode(header) + bytes(payload_bytes)
        start = time.perf_counter()
        plane.transmit(0, hop_mac, [frame])
        if plane.poll(1.0) and number >= 20:  # the first ones only warm up
            times.append((time.perf_counter() - start) * 1e6)
    return times


def sink(**_: Any) -> None:
    """Count what arrives; on command, wait for silence and tell how many, and when the last one came."""
    from gdp.ports.batch import make_batch
    from gdp.ports.sockets import kernel_drops, open_port

    sock = open_port("left")
    batch = make_batch(1 << 16)
    epoll = select.epoll()
    epoll.register(sock, select.EPOLLIN)
    epoll.register(sys.stdin, select.EPOLLIN)
    answer(event="ready")
    got, last = 0, 0.0
    while True:
        for fd, _events in epoll.poll():
            if fd == sock.fileno():
                got += len(batch.take(sock))
                last = time.monotonic()
                continue
            silence_s = command()["silence_s"]
            quiet = select.epoll()
            quiet.register(sock, select.EPOLLIN)
            while quiet.poll(silence_s):
                got += len(batch.take(sock))
                last = time.monotonic()
            quiet.close()
            answer(got=got, last_s=last, kernel_drops=kernel_drops(sock))
            got = 0


def echo(macs: dict[str, str], **_: Any) -> None:
    """Send every echo request back."""
    from gdp.frame.codec import decode
    from gdp.ports.raw import RawPlane

    plane = RawPlane(["left"])
    plane.watch(sys.stdin, command)
    answer(event="ready")
    while True:
        for arrival in plane.poll(None):
            header = decode(arrival.frame)
            back = encode(
                header._replace(
                    kind=Kind.ECHO_REPLY, hops_left=HOPS_MAX, destination=header.source, source=header.destination
                )
            )
            plane.transmit(0, bytes.fromhex(macs["left"]), [back + arrival.frame[HEADER_BYTES:]])


if __name__ == "__main__":
    settings = json.loads(sys.argv[1])
    enter(settings.pop("namespace"))
    {"switch": switch, "source": source, "sink": sink, "echo": echo}[settings.pop("role")](**settings)
