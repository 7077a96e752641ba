"""Ports of a node as the kernel counts them."""

from __future__ import annotations

import socket

from gdp.nodes.port_rows import port_rows
from gdp.ports.plane import Port


def test_a_port_has_the_counts_of_its_device_and_an_absent_one_has_none() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        before, _ = port_rows(_ports())
        receiver.sendto(b"frame", receiver.getsockname())
        after, absent = port_rows(_ports())
    assert before.counts is not None
    assert after.counts is not None
    assert after.counts.frames_out > before.counts.frames_out
    assert after.counts.bytes_in > before.counts.bytes_in
    assert (absent.port, absent.counts, absent.is_up) == ("none0", None, False)


def _ports() -> dict[int, Port]:
    return {0: Port(0, "none0", bytes(6), 0, up=False), 1: Port(1, "lo", bytes(6), 65_536, up=True)}
