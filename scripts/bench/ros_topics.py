"""Talker and listener of ``ros.py``, camera and viewer of ``first_topic.py``: ordinary rclpy nodes.

Process of its own, started by ``ros_row.py`` as ``talk`` or ``listen``. A message carries the wall clock at
which it was published and its number, 1 and up. Until the talker gets the signal to start it sends greetings, numbered
0: topics may not be joined yet. The listener ends when all came, or when nothing came for a while.
"""

from __future__ import annotations

import array
import secrets
import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final

from peers.jsonl import say
from ros_endpoint import End, Settings, percentiles, reliable, run_role
from sensor_msgs.msg import Image
from std_msgs.msg import String

TEXT_BYTES: Final = 100  # in CDR: prefix 4, length 4, 91 characters, one 0
IMAGE_BYTES: Final = 921_600  # 640 x 480, rgb8; its header comes on top
_TEXT_CHARS: Final = TEXT_BYTES - 9
_WIDTH, _HEIGHT, _PIXEL = 640, 480, 3
_DEPTHS: Final = {"text": 10, "image": 10, "small": 1_000}  # ten of 200/s would be 50 ms
_GREETING_S: Final = 0.05
_QUIET_S: Final = 8.0  # Fast DDS requests losses after 3 s
_CAMERA_S: Final = 0.1
_SIDE: Final = 64


class _Texts:
    """Texts of 100 bytes: the time in ns, the number, and blanks."""

    kind = String

    def fill(self, number: int) -> String:
        """Return the next message."""
        return String(data=f"{time.time_ns():019d} {number:09d}".ljust(_TEXT_CHARS))

    @staticmethod
    def read(message: String) -> tuple[int, int]:
        """Return when it was published, and its number."""
        return int(message.data[:19]), int(message.data[20:29])


class _Images:
    """Camera images: the time in the header, the number in the frame's name."""

    kind = Image

    def __init__(self) -> None:
        self._image = Image(height=_HEIGHT, width=_WIDTH, encoding="rgb8", step=_PIXEL * _WIDTH)
        self._image.data = array.array("B", secrets.token_bytes(IMAGE_BYTES))

    def fill(self, number: int) -> Image:
        """Return the next message."""
        header = self._image.header
        header.frame_id = f"{number:09d}"
        header.stamp.sec, header.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        return self._image

    @staticmethod
    def read(message: Image) -> tuple[int, int]:
        """Return when it was published, and its number; 0 for an incomplete one."""
        stamp = message.header.stamp
        number = int(message.header.frame_id) if len(message.data) == IMAGE_BYTES else 0
        return stamp.sec * 1_000_000_000 + stamp.nanosec, number


_KINDS: Final[Mapping[str, type[_Texts] | type[_Images]]] = {
    "text": _Texts,
    "image": _Images,
    "small": _Texts,
}


def talk(end: End, settings: Settings) -> None:
    """Publish ``count`` messages on every topic, one each ``every_s``."""
    kind, count = settings["kind"], settings["count"]
    source, profile = _KINDS[kind](), reliable(_DEPTHS[kind])
    publishers = [end.node.create_publisher(source.kind, topic, profile) for topic in settings["topics"]]
    steps: Iterator[int] = iter(range(1, count + 1))

    def greet() -> None:
        if not end.may_start:
            for publisher in publishers:
                publisher.publish(source.fill(0))

    def tick() -> None:
        if not end.may_start:
            return
        number = next(steps, None)
        if number is None:
            end.finish()
            return
        for publisher in publishers:
            publisher.publish(source.fill(number))

    end.every(_GREETING_S, greet)
    end.every(settings["every_s"], tick)
    end.run()


class _Listener:
    """Subscriber of all topics that records arrivals."""

    def __init__(self, end: End, settings: Settings) -> None:
        self._end = end
        self._kind = _KINDS[settings["kind"]]
        self._greeted: set[str] = set()
        self._came: dict[str, set[int]] = {topic: set() for topic in settings["topics"]}
        self._last_s = time.monotonic()
        self.missing = settings["count"] * len(self._came)
        self.twice = 0
        self.latencies_s: list[float] = []
        profile = reliable(_DEPTHS[settings["kind"]])
        for topic in self._came:
            end.node.create_subscription(self._kind.kind, topic, partial(self._take, topic), profile)

    def _take(self, topic: str, message: String | Image) -> None:
        now_ns = time.time_ns()
        stamp_ns, number = self._kind.read(message)
        if not number:
            self._greet(topic)
            return
        self._last_s = time.monotonic()
        if number in self._came[topic]:
            self.twice += 1
            return
        self._came[topic].add(number)
        self.latencies_s.append((now_ns - stamp_ns) / 1e9)
        self.missing -= 1
        if not self.missing:
            self._end.finish()

    def _greet(self, topic: str) -> None:
        if len(self._greeted) < len(self._came):
            self._greeted.add(topic)
            if len(self._greeted) == len(self._came):
                self._last_s = time.monotonic()
                self._end.finish()

    def look(self) -> None:
        """Give up messages that do not arrive."""
        if time.monotonic() > self._last_s + _QUIET_S:
            self._end.finish()


def listen(end: End, settings: Settings) -> None:
    """Report when every topic was received, and the results when all messages have arrived."""
    listener = _Listener(end, settings)
    end.run()
    say(event="hears")
    end.every(1.0, listener.look)
    end.run()
    say(lost=listener.missing, twice=listener.twice, **percentiles(listener.latencies_s))


def camera(end: End, settings: Settings) -> None:
    """Publish until killed."""
    publisher = end.node.create_publisher(Image, settings["topic"], reliable())
    image = Image(width=_SIDE, height=_SIDE, step=_SIDE, encoding="mono8", data=bytes(_SIDE * _SIDE))
    end.every(_CAMERA_S, lambda: publisher.publish(image))
    say(event="publishes")
    end.run()


def viewer(end: End, settings: Settings) -> None:
    """Read until the first image."""
    end.node.create_subscription(Image, settings["topic"], lambda _: end.finish(), reliable())
    say(event="reads")
    end.run()
    say(event="image", at_s=time.monotonic())


if __name__ == "__main__":
    run_role({"talk": talk, "listen": listen, "camera": camera, "viewer": viewer})
