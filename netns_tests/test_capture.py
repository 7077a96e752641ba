"""Capture of the ring in a child process, read back by Scapy."""

from __future__ import annotations

import json
import signal
import socket
import sys
from collections.abc import Iterator

import pytest
from scapy.layers.l2 import Ether
from scapy.utils import PcapNgReader, RawPcapReader

from gdp.frame.codec import Header, Kind, encode, ethernet
from gdp.frame.layers import GDP
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import LabProcess

pytestmark = pytest.mark.netns

MACS = [bytes([2, 0, 0, 0, 0, number]) for number in range(4)]
PATIENCE_S = 20.0


@pytest.fixture
def links(space: Space) -> Iterator[list[socket.socket]]:
    """Two links, a0-b0 and a1-b1; the a ends as sockets."""
    ends = []
    for at in (0, 1):
        space.veth(f"a{at}", f"b{at}", MACS[2 * at], MACS[2 * at + 1])
        ends.append(socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0))
        ends[-1].bind((f"a{at}", 0))
    yield ends
    for end in ends:
        end.close()


def start(machine: LabMachine, *arguments: str) -> LabProcess:
    return machine.launch([sys.executable, "-m", "ring.capture", *arguments])


def frame(number: int) -> bytes:
    header = Header(Kind.DATA, 0, 64, 1, 7, number, 0, 1, 1, b"d" * 32, b"s" * 32)
    return ethernet(MACS[1], MACS[0]) + encode(header) + b"payload"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_frame_of_both_links_is_in_the_file_when_it_is_ended(
    number: signal.Signals, links: list[socket.socket], machine: LabMachine
) -> None:
    file = machine.folder / "seen.pcap"
    capture = start(machine, str(file), "b0", "a1")
    assert capture.read(PATIENCE_S) == {"event": "ready", "file": str(file)}
    for at in range(300):
        links[0].send(frame(at))  # comes in at b0
    links[1].send(frame(1_000))  # goes out of a1
    links[1].send(frame(1_001)[:12] + b"\x08\x00" + bytes(60))
    out = capture.finish(number)
    assert (capture.code, capture.logged) == (0, "")
    assert json.loads(out) == {"event": "done", "frames": 302, "lost": 0}
    with RawPcapReader(str(file)) as reader:
        assert not isinstance(reader, PcapNgReader)
        assert (reader.nano, reader.linktype) == (True, 1)
        seen = sorted(reader, key=lambda read: (read[1].sec, read[1].usec))
    assert [data for data, _ in seen if data[13] == 0xB5] == [*map(frame, range(300)), frame(1_000)]
    assert len(seen) == 302
    assert all(meta.sec > 1_600_000_000 and meta.wirelen == len(data) for data, meta in seen)
    assert isinstance(Ether(seen[0][0]).payload, GDP)


def test_a_device_that_is_not_there_ends_it_with_a_word(space: Space, machine: LabMachine) -> None:
    capture = start(machine, str(machine.folder / "seen.pcap"), "nothing")
    capture.reap(PATIENCE_S)
    assert capture.code == 1
    assert "No such device" in capture.logged
