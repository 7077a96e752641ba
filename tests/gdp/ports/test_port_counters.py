"""Counts of devices, as the kernel has them."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from gdp.ports.port_counters import PortCounters
from gdp.telemetry.sources import DeviceCounts


@pytest.fixture
def counters() -> Iterator[PortCounters]:
    made = PortCounters()
    yield made
    made.close()


def test_counts_of_a_device_rise_with_what_crosses_it(counters: PortCounters) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        before = DeviceCounts(*counters.read()["lo"])
        receiver.sendto(b"frame", receiver.getsockname())
        after = DeviceCounts(*counters.read()["lo"])
    assert after.frames_out > before.frames_out
    assert after.bytes_in > before.bytes_in
    assert all(later >= earlier for later, earlier in zip(after, before, strict=True))


def test_closed_counters_have_no_devices(counters: PortCounters) -> None:
    assert "none0" not in counters.read()
    counters.close()
    assert counters.read() == {}
