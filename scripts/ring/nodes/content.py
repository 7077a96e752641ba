"""Content of the live ring's messages: each is unique, and reduced to a mark for comparison.

Sans-I/O. Messages are accessed by their fields, so that the same code serves ROS 1 and ROS 2.

A talker's messages are numbered from 1. Number 0 is a greeting, sent until the other side receives it; it does not
count.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cache
from hashlib import sha256, shake_128
from typing import Final, NamedTuple, TypeAlias

Fit: TypeAlias = Callable[["array[int]"], object]  # converts an array to the form of a ROS version

CAMERA_HZ: Final = 15.0  # unless a run asks for another pace
LAMP: Final = "/lamp"
LAMP_TYPE: Final = "std_srvs/srv/SetBool"
LAMP_HZ: Final = 5.0

_WIDTH, _HEIGHT, _PIXEL = 640, 480, 3
_PICTURE_BYTES: Final = _WIDTH * _HEIGHT * _PIXEL
_NUMBER_BYTES: Final = 4  # the first of a picture, as some cameras write their frame's number
_STEP_BYTES: Final = 977  # of the scene, from one picture to the next
_STEPS: Final = 64
_CELLS_X, _CELLS_Y = 96, 64
_SECOND_NS: Final = 1_000_000_000


class Mark(NamedTuple):
    """Properties that a listener reads from a message."""

    number: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Talk:
    """A topic of the robot, and the node that publishes it. ``latched``: late joiners get the newest message."""

    node: str
    topic: str
    type_name: str
    hz: float
    _: KW_ONLY
    fill: Callable[[object, int, int, Fit], None]  # a new message; its number; the wall clock in ns
    read: Callable[[object], Mark]
    latched: bool = False


def digest(message: object) -> str:
    """Return 32 hex digits that distinguish messages of different content.

    Both ROS versions give the same, except for the sequence number in a ROS 1 header, which does not cross.
    """
    sha = sha256()
    for leaf in _leaves(message):
        sha.update(leaf)
        sha.update(b"\0")
    return sha.hexdigest()[:32]


def lamp_says(number: int, *, on: bool) -> str:
    """Return the lamp's reply to its ``number``-th switching."""
    return f"{'on' if on else 'off'}, switched {number} times"


def _say(message: object, number: int, now_ns: int, fit: Fit) -> None:
    del fit
    _put(message, {"data": f"hello {number} at {now_ns}"})


def _listen(message: object) -> Mark:
    _, number, _, stamp_ns = str(_get(message, "data")).split()
    return Mark(int(number), int(stamp_ns))


def _take_picture(message: object, number: int, now_ns: int, fit: Fit) -> None:
    size = _PICTURE_BYTES - _NUMBER_BYTES
    at = number % _STEPS * _STEP_BYTES
    pixels = _scene()[at : at + size] if number else bytes(size)  # a greeting is black
    _put_time(_get(message, "header.stamp"), now_ns)
    _put(
        message,
        {
            "header.frame_id": "camera",
            "height": _HEIGHT,
            "width": _WIDTH,
            "encoding": "rgb8",
            "step": _WIDTH * _PIXEL,
            "data": fit(array("B", number.to_bytes(_NUMBER_BYTES, "big") + pixels)),
        },
    )


def take_small_picture(rows: int, message: object, number: int, now_ns: int, fit: Fit) -> None:
    """Fill an image with the first rows of a picture."""
    _take_picture(message, number, now_ns, fit)
    pixels = _get(message, "data")
    assert isinstance(pixels, bytes | array)
    _put(message, {"height": rows, "data": pixels[: rows * _WIDTH * _PIXEL]})


def _look_at_picture(message: object) -> Mark:
    pixels = _get(message, "data")
    number = bytes(pixels[:_NUMBER_BYTES]) if isinstance(pixels, bytes | array) else b""
    return Mark(int.from_bytes(number, "big"), _time_ns(_get(message, "header.stamp")))


def _draw_map(message: object, number: int, now_ns: int, fit: Fit) -> None:
    cells = array("b", [-1]) * (_CELLS_X * _CELLS_Y)  # unknown
    for at in range(min(number * _CELLS_X, len(cells))):  # each map adds one known row
        cells[at] = 100 if at % 7 == number % 7 else 0
    _put_time(_get(message, "header.stamp"), now_ns)
    _put_time(_get(message, "info.map_load_time"), now_ns)
    _put(
        message,
        {
            "header.frame_id": "map",
            "info.resolution": 0.125,
            "info.width": _CELLS_X,
            "info.height": _CELLS_Y,
            "info.origin.position.x": -6.1,
            "info.origin.orientation.w": 1.0,
            "data": fit(cells),
        },
    )


def _look_at_map(message: object) -> Mark:
    return Mark(1, _time_ns(_get(message, "header.stamp")))  # this topic has no greetings


TALKS: Final = (
    Talk("talker", "/chatter", "std_msgs/msg/String", 10.0, fill=_say, read=_listen),
    Talk("camera", "/camera/image", "sensor_msgs/msg/Image", CAMERA_HZ, fill=_take_picture, read=_look_at_picture),
    Talk("mapper", "/map", "nav_msgs/msg/OccupancyGrid", 1.0, fill=_draw_map, read=_look_at_map, latched=True),
)


@cache
def _scene() -> bytes:
    return shake_128(b"scene").digest(_PICTURE_BYTES + _STEP_BYTES * _STEPS)


def _get(value: object, path: str) -> object:
    for name in path.split("."):
        value = getattr(value, name)
    return value


def _put(message: object, fields: Mapping[str, object]) -> None:
    for path, value in fields.items():
        inside, _, name = path.rpartition(".")
        setattr(_get(message, inside) if inside else message, name, value)


def _time_names(stamp: object) -> tuple[str, str]:
    return ("secs", "nsecs") if hasattr(stamp, "secs") else ("sec", "nanosec")


def _put_time(stamp: object, ns: int) -> None:
    for name, value in zip(_time_names(stamp), divmod(ns, _SECOND_NS), strict=True):
        setattr(stamp, name, value)


def _time_ns(stamp: object) -> int:
    seconds, ns = (getattr(stamp, name) for name in _time_names(stamp))
    return int(seconds) * _SECOND_NS + int(ns)


def _leaves(value: object) -> Iterator[bytes]:
    """Yield the values of a message, in the order of its definition."""
    if isinstance(value, array) and value.typecode == "B":
        yield value.tobytes()
    elif isinstance(value, bytes):
        yield value
    elif isinstance(value, array | list | tuple):
        yield str(len(value)).encode()
        for item in value:
            yield from _leaves(item)
    elif names := _field_names(value):
        for name in names:
            yield from _leaves(getattr(value, name))
    else:
        yield repr(value).encode()


def _field_names(value: object) -> list[str]:
    described = getattr(value, "get_fields_and_field_types", None)  # ROS 2
    names = described() if callable(described) else getattr(value, "__slots__", ())
    return [name for name in names if name != "seq"]
