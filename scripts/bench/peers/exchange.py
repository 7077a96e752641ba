"""Measurement of the message bench: a message goes from A to B, a small answer comes back, the next one goes.

Runs in A's and B's processes. It reads clocks; the baseline carries the messages (``Way``).

The message is a ``sensor_msgs/msg/Image`` in CDR of exactly the stated size, its last eight bytes a number. The answer
has 16 bytes: the number, the bytes that arrived, and, where the number requests it, their CRC (once for every size).

CPU is the reading of the processes' own clocks over the measured messages: A's, B's, and that of all in between.
Kernel forwarding on the way runs in the process that was interrupted, mostly the one that sent.
"""

from __future__ import annotations

import os
import secrets
import struct
import time
import zlib
from collections.abc import Mapping, Sequence
from typing import Final, Protocol

from machine import processor_s

from peers.jsonl import Settings, say

IMAGE: Final = "sensor_msgs/msg/Image"
PATIENCE_S: Final = 20.0
ANSWER: Final = struct.Struct("!QII")  # number, bytes, CRC-32 or 0
_NUMBER: Final = struct.Struct("!Q")
_CHECKED: Final = 1 << 63  # in a number: answer with the CRC
_GREETING_S: Final = 0.1

# CDR_LE; stamp; frame_id "cam"; height 1, width; encoding "mono8"; is_bigendian, step; length of data.
_IMAGE_HEAD: Final = struct.Struct("<4siII4sIII6sBxII")
SIZE_MIN: Final = _IMAGE_HEAD.size + _NUMBER.size


class Way(Protocol):
    """A baseline from A's side."""

    def send(self, message: bytes) -> None:
        """Send a message."""

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next answer; None when the monotonic second has passed."""


def image(size: int) -> bytearray:
    """Return a serialised image of exactly ``size`` bytes, with random pixels.

    Raises ``ValueError``: too small for the number.
    """
    pixels = size - _IMAGE_HEAD.size
    if pixels < _NUMBER.size:
        raise ValueError(f"a message has at least {SIZE_MIN} bytes")
    head = _IMAGE_HEAD.pack(b"\x00\x01\x00\x00", 0, 0, 4, b"cam\x00", 1, pixels, 6, b"mono8\x00", 0, pixels, pixels)
    return bytearray(head + secrets.token_bytes(pixels))


def answer_to(message: bytes) -> bytes:
    """Return B's answer to a message."""
    (number,) = _NUMBER.unpack_from(message, len(message) - _NUMBER.size)
    return ANSWER.pack(number, len(message), zlib.crc32(message) if number & _CHECKED else 0)


def ping(way: Way, settings: Settings) -> None:
    """Measure ``count`` messages of ``size`` bytes, and report; ``pids``: further processes by machine, as below."""
    say(**exchange(way, settings["size"], settings["count"], {"sender": [os.getpid()], **settings["pids"]}))


def exchange(way: Way, size: int, count: int, pids: Mapping[str, Sequence[int]]) -> dict[str, object]:
    """Measure ``count`` messages of a size; return ``rtt_s`` of every message, and ``cpu_s`` a message by machine.

    ``pids``: of the processes at each machine. Raises ``TimeoutError``: an answer did not come. Raises ``ValueError``:
    B received other bytes than were sent.
    """
    numbers, message = iter(range(1, _CHECKED)), image(size)
    _greet(way)
    _once(way, message, next(numbers) | _CHECKED)
    for _ in range(count):  # windows open, caches fill
        _once(way, message, next(numbers))
    before = _used_s(pids)
    rtts = [_once(way, message, next(numbers)) for _ in range(count)]
    after = _used_s(pids)
    return {"rtt_s": rtts, "cpu_s": {place: (after[place] - before[place]) / count for place in pids}}


def _greet(way: Way) -> None:
    """Send small messages, all numbered 0, until one is answered: the path may not be ready yet."""
    message = bytes(image(SIZE_MIN)[: -_NUMBER.size]) + bytes(_NUMBER.size)
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        way.send(message)
        if way.wait(time.monotonic() + _GREETING_S) is not None:
            return
    raise TimeoutError("the far end never answered")


def _once(way: Way, image_bytes: bytearray, number: int) -> float:
    """Send one message, wait for its answer, return the seconds between."""
    _NUMBER.pack_into(image_bytes, len(image_bytes) - _NUMBER.size, number)
    message = bytes(image_bytes)
    begun_s = time.monotonic()
    way.send(message)
    while True:
        answer = way.wait(begun_s + PATIENCE_S)
        ended_s = time.monotonic()
        if answer is None:
            raise TimeoutError(f"a message of {len(message)} bytes was not answered")
        if ANSWER.unpack(answer)[0]:  # otherwise one more answer to a greeting
            break
    if answer != answer_to(message):
        raise ValueError(f"of {len(message)} bytes something else arrived: {ANSWER.unpack(answer)}")
    return ended_s - begun_s


def _used_s(pids: Mapping[str, Sequence[int]]) -> dict[str, float]:
    return {place: sum(map(processor_s, each)) for place, each in pids.items()}
