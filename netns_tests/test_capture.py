"""Capture command in a child process, read back by Scapy."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from scapy.layers.l2 import Ether
from scapy.utils import PcapNgReader, RawPcapReader

from gdp.frame.codec import Header, encode, ethernet
from gdp.frame.kinds import Kind
from netns_tests.spaces import Space

pytestmark = pytest.mark.netns

MACS = [bytes([2, 0, 0, 0, 0, number]) for number in range(4)]
ROOT = Path(__file__).parents[1]


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


def start(*arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "gdp.ports.capture", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def frame(number: int) -> bytes:
    header = Header(Kind.DATA, 0, 64, 1, 7, number, 0, 1, 1, b"d" * 32, b"s" * 32)
    return ethernet(MACS[1], MACS[0]) + encode(header) + b"payload"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_frame_of_both_links_is_in_the_file_when_it_is_ended(
    number: signal.Signals, links: list[socket.socket], tmp_path: Path
) -> None:
    file = tmp_path / "seen.pcap"
    with start("--iface", "b0", "--iface", "a1", str(file)) as capture:
        assert capture.stdout is not None
        assert json.loads(capture.stdout.readline()) == {"event": "ready", "file": str(file)}
        for at in range(300):
            links[0].send(frame(at))  # comes in at b0
        links[1].send(frame(1_000))  # goes out of a1
        links[1].send(frame(1_001)[:12] + b"\x08\x00" + bytes(60))
        capture.send_signal(number)
        out, err = capture.communicate(timeout=20)
    assert (capture.returncode, err) == (0, "")
    assert json.loads(out) == {"event": "done", "frames": 302, "lost": 0}
    with RawPcapReader(str(file)) as reader:
        assert not isinstance(reader, PcapNgReader)
        assert (reader.nano, reader.linktype) == (True, 1)
        seen = sorted(reader, key=lambda read: (read[1].sec, read[1].usec))
    assert [data for data, _ in seen if data[13] == 0xB5] == [*map(frame, range(300)), frame(1_000)]
    assert len(seen) == 302
    assert all(meta.sec > 1_600_000_000 and meta.wirelen == len(data) for data, meta in seen)
    assert Ether(seen[0][0]).payload.name == "GDP"


def test_a_device_that_is_not_there_ends_it_with_a_word(space: Space, tmp_path: Path) -> None:
    with start("--iface", "nothing", str(tmp_path / "seen.pcap")) as capture:
        _, err = capture.communicate(timeout=20)
    assert capture.returncode == 2
    assert "device nothing: No such device" in err
