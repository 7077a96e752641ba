"""Received frames of the slots of a pool, each of which begins with an Ethernet header; the twin in Python.

Sans-I/O.
"""

from __future__ import annotations

import struct
from functools import lru_cache

from gdp.sansio import ReceivedFrame

__all__ = ["received"]


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
