"""Endpoint processes of the uplink bench: traffic of robot and cloud over one system, and TCP.

Processes of their own, started by ``uplink.py``::

    robot, cloud             the traffic over ``system``: gdp or zenoh
    tcp-send, tcp-read       one TCP flow (CUBIC) from the robot to the cloud
"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections import Counter
from dataclasses import asdict
from functools import partial
from typing import Final

from peers.jsonl import Settings, read_order, run_role, say
from thin_link.carriers import CARRIERS
from thin_link.exchange import Exchange, Window
from thin_link.relay import MARKED_PORT
from thin_link.traffic import Direction, streams

from lab.process import until

_PATIENCE_S: Final = 30.0
_CHUNK: Final = 1 << 16


def traffic(settings: Settings, direction: Direction) -> None:
    """Exchange the traffic once for each command with a window; report every stream after it."""
    exchange = Exchange(streams(settings["camera"]), direction)
    carrier = CARRIERS[settings["system"]](settings["own"], exchange.take)
    exchange.join(carrier)
    until(carrier.is_matched, "a reader: the other end did not appear", _PATIENCE_S)
    say(event="ready")
    order = read_order()
    window = Window(order["start_ns"], order["begin_ns"], order["end_ns"])
    exchange.start(window)
    time.sleep(max(order["drained_ns"] - time.monotonic_ns(), 0) / 1e9)
    streams_of = {name: asdict(tally) for name, tally in exchange.tallies.items()}
    say(streams=streams_of, refusals=dict(Counter(exchange.refusals)))
    sys.stdout.flush()
    os._exit(0)  # a publisher may still wait; nothing of it is to be kept


def tcp_send(settings: Settings) -> None:
    """Send as fast as TCP allows, until ended."""
    with socket.socket() as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"cubic")
        connection.settimeout(_PATIENCE_S)
        connection.connect((settings["address"], MARKED_PORT))
        chunk = os.urandom(_CHUNK)
        say(event="ready")
        while True:
            connection.sendall(chunk)


def tcp_read(settings: Settings) -> None:
    """Read one connection until it ends."""
    with socket.create_server((settings["address"], MARKED_PORT)) as listener:
        say(event="ready")
        connection, _ = listener.accept()
        buffer = bytearray(_CHUNK)
        with connection:
            while connection.recv_into(buffer):
                pass


if __name__ == "__main__":
    robot, cloud = (partial(traffic, direction=direction) for direction in ("up", "down"))
    run_role({"robot": robot, "cloud": cloud, "tcp-send": tcp_send, "tcp-read": tcp_read})
