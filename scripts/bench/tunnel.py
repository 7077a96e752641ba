"""Tunnel bench: images and small round trips between a robot and its border, next to TCP and UDP in the same WireGuard.

Sessions of the library, encrypted and authenticated end to end, use both switches. TCP and UDP use the inner addresses
of the WireGuard devices, without VXLAN and without keys of their own. The border's end is this process.

    sudo .venv/bin/python scripts/bench/tunnel.py                  # a minute; writes docs/benchmarks/tunnel.json
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from socket import AF_INET6, SHUT_WR, SOCK_DGRAM, create_connection, create_server, socket
from threading import Thread

from peers.jsonl import read_order, say
from report import percentile
from skeleton import Options, Outcome, Recorder, Trial, command_line, run_bench

import gdp
from gdp.control.endpoints import inner_address
from gdp.stores.keyring import CARD, load_card
from gdp.trust.right import Right
from lab.internet.access import Access
from lab.internet.laboratory import Laboratory
from lab.internet.overlay import Overlay
from lab.process import new_run

OURS, PLAIN, CASE = "gdp", "TCP and UDP", "one tunnel"
COLUMNS = RATE, TRIP, _ = "images, MB/s", "100 B round trip median, µs", "p99, µs"
_Do = Callable[..., object]
_IMAGES, _PING, _PONG = "images", "ping", "pong"
_PORT, _WAIT_S, _WARM_UP, _BUFFER_BYTES = 7_000, 60.0, 200, 1 << 20


def _near(node: str, address: str, seconds: float) -> None:
    with gdp.open(node) as session, socket(AF_INET6, SOCK_DGRAM) as udp:
        images, ping = (session.publisher(name, reliable=True) for name in (_IMAGES, _PING))
        pong = session.subscribe(_PONG)
        for each in (images, ping):
            each.wait_for_readers(timeout_s=_WAIT_S)
        udp.connect((address, _PORT))
        udp.settimeout(_WAIT_S)
        while True:
            if read_order()["row"] == OURS:
                _report(seconds, images.put, images.flush, ping.put, partial(pong.receive, _WAIT_S))
                continue
            with create_connection((address, _PORT)) as tcp:
                end = partial(lambda tcp: (tcp.shutdown(SHUT_WR), tcp.recv(1)), tcp)  # the reader closes it at its end
                _report(seconds, tcp.sendall, end, udp.send, partial(udp.recv, _BUFFER_BYTES))


def _report(seconds: float, put: _Do, end: _Do, send: _Do, receive: _Do) -> None:
    image, count, begun_s = os.urandom(921_600), 0, time.monotonic()
    while time.monotonic() < begun_s + seconds:
        put(image)
        count += 1
    end()
    marks = [time.monotonic()]
    rate, until_s = count * len(image) / 1e6 / (marks[0] - begun_s), marks[0] + seconds
    while marks[-1] < until_s or len(marks) < 2 * _WARM_UP:
        send(image[:100])
        receive()
        marks.append(time.monotonic())
    trips = [1e6 * (after - before) for before, after in pairwise(marks[_WARM_UP:])]
    say(**dict(zip(COLUMNS, (rate, percentile(trips, 0.5), percentile(trips, 0.99)), strict=True)))


def _answer(session: gdp.Session, listener: socket, udp: socket) -> None:
    images, asked = map(session.subscribe, (_IMAGES, _PING))
    pong, buffer = session.publisher(_PONG, reliable=True), bytearray(_BUFFER_BYTES)

    def read_streams() -> None:
        while True:
            with listener.accept()[0] as stream:
                while stream.recv_into(buffer):
                    continue

    def echo() -> None:
        while True:
            udp.sendto(*udp.recvfrom(_BUFFER_BYTES))

    for work in (read_streams, echo):
        Thread(target=work, daemon=True).start()
    while True:
        subscription, message = session.receive_any([images, asked])
        if subscription is asked:
            pong.put(message.payload)


def measure(options: Options) -> Outcome:
    """Measure both in the same tunnel, round by round."""
    recorder = Recorder()
    with new_run() as run, Laboratory(run) as laboratory:
        border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
        robot = laboratory.add_host("robot", laboratory.add_site("home", Access.PORT_RESTRICTED))
        overlay = Overlay(laboratory, border)
        overlay.stand_up(robot)
        rights = dict.fromkeys((_IMAGES, _PING, _PONG), (Right.PUBLISH, Right.READ))
        overlay.grant({host.label: rights for host in (robot, border)})
        overlay.wait_until_joined()
        where = inner_address(load_card(overlay.directory(border) / "switch" / CARD).name), _PORT
        listener = border.space.inside(lambda: create_server(where, family=AF_INET6))
        udp = border.space.inside(lambda: socket(AF_INET6, SOCK_DGRAM))
        udp.bind(where)
        far = (overlay.open_session(border), listener, udp)
        Thread(target=_answer, args=far, daemon=True).start()
        near = [sys.executable, __file__, str(overlay.directory(robot) / "proxy"), where[0], str(options.seconds)]
        with robot.launch(near, "near", has_orders=True) as end:
            rows = {row: partial(lambda row, _: end.ask(row=row), row) for row in (PLAIN, OURS)}
            recorder.interleave([Trial(CASE, row, COLUMNS, work) for row, work in rows.items()], options.rounds)
    ratio = partial(recorder.rounds.ratio, one=OURS, other=PLAIN, case=CASE)
    targets = [
        ratio("images / TCP", column=RATE, asked=0.8),
        ratio("round trip / UDP", column=TRIP, asked=3.0, at_most=True),
    ]
    return Outcome("tunnel", "A tunnel", recorder.rounds, targets, {"trouble": recorder.notes or "none"})


if __name__ == "__main__":
    if len(sys.argv) == 4 and sys.argv[1].startswith("/"):
        _near(sys.argv[1], sys.argv[2], float(sys.argv[3]))
    quick = {"rounds": 1, "seconds": 1.0}
    run_bench(command_line(__doc__, rounds=5, seconds=3.0, quick=quick, has_record=True), measure)
