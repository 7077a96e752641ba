"""Capture files that claim more than they hold."""

from __future__ import annotations

import contextlib
import gzip
import struct
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp_extensions.dissector.pcap_files import ETHERNET, CapturedFrame, PcapngWriter, read_capture

BOUND_BYTES = 40 << 20
SECTION = struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
PCAP = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, ETHERNET)


def frames_of(path: Path) -> list[CapturedFrame]:
    """Return the frames of a capture, which may take 40 MiB to read."""
    tracemalloc.start()
    try:
        return list(read_capture(path))
    finally:
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak_bytes < BOUND_BYTES


@pytest.mark.parametrize("claimed", [1 << 20, 64 << 20, 0xFFFF_FFF0])
@pytest.mark.parametrize("kind", [1, 2, 3, 6, 10, 0x80000001, 99])
@pytest.mark.parametrize("is_packed", [False, True])
def test_z05_a_block_that_claims_gigabytes_costs_no_memory(
    claimed: int, kind: int, is_packed: bool, tmp_path: Path
) -> None:
    path, data = tmp_path / "c.pcapng", SECTION + struct.pack("<II", kind, claimed) + bytes(64)
    path.write_bytes(gzip.compress(data) if is_packed else data)
    if claimed > 16 << 20:
        with pytest.raises(LocalError, match="a block is said to have"):
            frames_of(path)
    else:
        assert frames_of(path) == []


def test_z05_a_frame_of_a_pcap_file_that_claims_gigabytes_costs_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "c.pcap"
    path.write_bytes(PCAP + struct.pack("<IIII", 1, 2, 0xFFFF_FFF0, 0xFFFF_FFF0) + bytes(64))
    frames_of(path)


@pytest.mark.parametrize(
    "head", [SECTION[:4], PCAP[:4], b"\x1f\x8b", gzip.compress(gzip.compress(SECTION, mtime=0), mtime=0)]
)
def test_z05_a_file_of_a_few_bytes_is_one_error(head: bytes, tmp_path: Path) -> None:
    path = tmp_path / "c"
    path.write_bytes(head)
    with pytest.raises(LocalError):
        frames_of(path)


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_z05_a_damaged_capture_gives_its_frames_or_one_error(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "c.pcapng"
    with path.open("wb") as file:
        writer = PcapngWriter(file)
        for number in range(3):
            writer.write(CapturedFrame(ETHERNET, "eth0", number, bytes([number]) * 60, 60))
    whole = bytearray(path.read_bytes())
    for at in data.draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=4)):
        whole[at] = data.draw(st.integers(0, 255))
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])
    with contextlib.suppress(LocalError):
        assert len(frames_of(path)) <= 3
