"""Frames in the slots of a pool, each from its Ethernet header on, and samples among frames; the twins in Python.

Sans-I/O; with the struct codec's offsets only.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

from gdp.frame.codec import CONTROL_FROM, ETHER_BYTES, HEADER_BYTES, HOPS_MASK, SECOND_PATH, VERSION, second_path_key
from gdp.sansio import ReceivedFrame

_SAMPLE_BITS: Final = 63  # of a frame's last byte: none is set in a sample

# From the header on: version, kind, hops left, payload length, destination and source as one key.
_GLANCE: Final = struct.Struct("!BBxBxxH24x64s")


@lru_cache(maxsize=4_096)  # more than the number of frequent sizes
def _shape(size: int) -> struct.Struct:
    """Return the struct that reads the sender's address and a frame of ``size`` bytes from a slot."""
    return struct.Struct(f"6x6s2x{size}s")  # addresses of receiver and sender, EtherType


def received(pool: bytearray, slot_bytes: int, sizes: list[int], port: int, waited_s: float) -> list[ReceivedFrame]:
    """Return the frames of the first slots; ``sizes``: their bytes after each Ethernet header."""
    return [
        ReceivedFrame(port, mac, frame, waited_s)
        for slot, size in zip(range(0, len(pool), slot_bytes), sizes, strict=False)
        for mac, frame in [_shape(size).unpack_from(pool, slot)]
    ]


def runs(pool: bytearray, slot_bytes: int, sizes: list[int]) -> list[tuple[int, int, bytes, int]]:
    """Return the runs of consecutive slots with one destination and source; ``sizes`` as in ``received``.

    Returns:
        first slot, count, key in the forwarding table, bytes of the largest frame. The key is empty, and the run one
        slot, where a frame is for the node itself or is not in order.
    """
    found, run_key, first, largest = list[tuple[int, int, bytes, int]](), b"", 0, 0
    for slot, size in enumerate(sizes):
        version, kind, hops_left, length, key = _GLANCE.unpack_from(pool, slot * slot_bytes + ETHER_BYTES)
        is_ours = version != VERSION or kind >= CONTROL_FROM or hops_left & HOPS_MASK <= 1
        if is_ours or HEADER_BYTES + length > size:
            key = b""
        elif hops_left & SECOND_PATH:
            key = second_path_key(key)
        if slot and (key != run_key or not key):
            found.append((first, slot - first, run_key, largest))
            first = slot
        largest = size if first == slot or size > largest else largest
        run_key = key
    return [*found, (first, len(sizes) - first, run_key, largest)] if sizes else found


def samples(frames: Sequence[ReceivedFrame] | Sequence[bytes], at: int, count: int) -> list[tuple[int, int]]:
    """Return place and seal of each sample among ``frames[at : at + count]``, the first of which has place 0."""
    found: list[tuple[int, int]] = []
    some: Sequence[ReceivedFrame | bytes] = frames[at : at + count]
    for place, each in enumerate(some):
        frame = each if isinstance(each, bytes) else each.frame
        if not frame[-1] & _SAMPLE_BITS:
            found.append((place, int.from_bytes(frame[-9:-1], "big")))
    return found
