"""Traffic of the uplink bench: streams of a robot and a cloud, their messages, and what a link could carry of them.

Sans-I/O. A message begins with its number and the moment when it was due, and ends with its number::

    !I  number   !Q  due, monotonic ns   ... random bytes ...   !I  number

CLOCK_MONOTONIC is one clock for all namespaces of a machine, so an age is a difference of two readings.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

Direction = Literal["up", "down"]
CAMERA_BYTES: Final = {"raw": 921_600, "jpeg": 40_000}  # 640x480 rgb8; the same as JPEG
SERVICE_ANSWER: Final = "service answer"
RELIABLE: Final = "reliable"  # in place of a camera: raw images alone, none of which may be dropped
TOGETHER, OWN_PACE = "together", "own-pace"  # in place of a camera: JPEG images alone, to several readers
_HEAD: Final = struct.Struct("!IQ")
_TAIL: Final = struct.Struct("!I")
_FRAME_PAYLOAD: Final = 1_400  # of 1,500 bytes; what is left is for addresses, security and order of every system
_FRAME_OVERHEAD: Final = 100


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic.

    ``period_s``: of its messages; 0: published when a message of ``answers`` arrives. ``urgent``: has the highest
    priority that a system offers. ``bulk``: fills what the others leave of the link. ``own_pace``: no reader waits for
    another.
    """

    name: str
    size: int
    period_s: float
    direction: Direction
    reliable: bool
    urgent: bool = False
    bulk: bool = False
    own_pace: bool = False
    answers: str = ""


def streams(camera: str) -> tuple[Stream, ...]:
    """Return the traffic of a robot with a camera of ``CAMERA_BYTES``, with QoS as in ROS, or its replacement."""
    if camera in (TOGETHER, OWN_PACE):
        size, own_pace = CAMERA_BYTES["jpeg"], camera == OWN_PACE
        return (Stream("camera", size, 1 / 30, "up", reliable=False, bulk=True, own_pace=own_pace),)
    if camera == RELIABLE:
        return (Stream("images", CAMERA_BYTES["raw"], 1 / 30, "up", reliable=True, bulk=True),)
    return (
        Stream("cmd_vel", 100, 1 / 50, "down", reliable=True, urgent=True),
        Stream("tf", 500, 1 / 100, "up", reliable=True, urgent=True),
        Stream("service request", 100, 1 / 5, "up", reliable=True, urgent=True),
        Stream(SERVICE_ANSWER, 1_000, 0.0, "down", reliable=True, urgent=True, answers="service request"),
        Stream("map", 50_000, 2.0, "up", reliable=True),
        Stream("lidar", 100_000, 1 / 10, "up", reliable=False, bulk=True),
        Stream("camera", CAMERA_BYTES[camera], 1 / 30, "up", reliable=False, bulk=True),
    )


def make_message(number: int, due_ns: int, body: bytes) -> bytes:
    """Return a message as long as ``body``, whose middle it keeps."""
    return _HEAD.pack(number, due_ns) + body[_HEAD.size : -_TAIL.size] + _TAIL.pack(number)


def open_message(message: bytes, size: int) -> tuple[int, int] | None:
    """Return number and due moment of a whole message; None for one that is not whole."""
    if len(message) != size:
        return None
    number, due_ns = _HEAD.unpack_from(message)
    (again,) = _TAIL.unpack_from(message, size - _TAIL.size)
    return (int(number), int(due_ns)) if number == again else None


def wire_bytes(size: int) -> int:
    """Return the bytes that a message takes of a link, with 100 B of overhead a frame."""
    return size + _FRAME_OVERHEAD * -(-size // _FRAME_PAYLOAD)


def carried_s(mix: Iterable[Stream], bits_s: float, loss: float) -> Mapping[str, float]:
    """Return how many messages a second of each stream the uplink could carry whole.

    The small streams come first. The bulk streams share what is left in bytes, max-min fair, and repair what is lost.
    ``loss``: share of lost frames, each of which is sent once more.
    """
    mine = [each for each in mix if each.direction == "up" and each.period_s]
    left = bits_s / 8 * (1 - loss)
    found: dict[str, float] = {}
    for each in (one for one in mine if not one.bulk):
        found[each.name] = min(1 / each.period_s, left / wire_bytes(each.size))
        left -= found[each.name] * wire_bytes(each.size)
    bulk = sorted((each for each in mine if each.bulk), key=lambda each: wire_bytes(each.size) / each.period_s)
    for at, each in enumerate(bulk):
        fair = max(left, 0.0) / (len(bulk) - at)
        found[each.name] = min(1 / each.period_s, fair / wire_bytes(each.size))
        left -= found[each.name] * wire_bytes(each.size)
    return found
