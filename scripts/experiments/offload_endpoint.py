"""Processes of ``offload.py``: a robot that calls, a server that computes, and a robot that computes by itself.

Process of its own: ``offload_endpoint.py robot|cloud|alone SETTINGS``. Both are nodes of ROS 2, by one of two
middlewares: ``rclpy`` with Fast DDS, or Cyclone DDS. Of the latter there is no wheel for rclpy. So rclpy serialises the
messages and this project's endpoint ``dds`` carries them, which is what ``rmw_cyclonedds`` does in one piece.

A request is numbered in its messages; requests up to ``at_once`` are answered without computing, so that what remains
is the network. All clocks are the one monotonic clock of the machine.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from select import select
from typing import Any, Final, TypeAlias

import bench_path  # noqa: F401 - finds ``peers``
from offload_tasks import TASKS, TYPES, Message, number_of, set_number
from peers.jsonl import say
from rclpy.serialization import deserialize_message, serialize_message

_GREETING_S: Final = 0.2
_LONG_S: Final = 3_600.0
Settings: TypeAlias = "Mapping[str, Any]"


class _FastEnd:
    """Node of rclpy, with Fast DDS."""

    def __init__(self, domain: int) -> None:
        del domain  # ROS_DOMAIN_ID
        import rclpy
        from ros_endpoint import End

        rclpy.init()
        self._end = End("offload")

    def publisher(self, topic: str, type_name: str) -> Callable[[Message], None]:
        """Return a publisher of a topic."""
        from ros_endpoint import reliable

        publish: Callable[[Message], None] = self._end.node.create_publisher(
            TYPES[type_name], topic, reliable()
        ).publish
        return publish

    def subscribe(self, topic: str, type_name: str, take: Callable[[Message], None]) -> None:
        """Call ``take`` with each message."""
        from ros_endpoint import reliable

        self._end.node.create_subscription(TYPES[type_name], topic, take, reliable())

    def run(self, look: Callable[[], bool], every_s: float) -> None:
        """Work until ``look``, called at least so often, returns that the series is over."""
        is_over = False

        def tick() -> None:
            nonlocal is_over
            if not is_over and look():
                is_over = True
                self._end.finish()

        self._end.every(every_s, tick)
        self._end.run()


class _CycloneEnd:
    """Node of ROS 2 on Cyclone DDS."""

    def __init__(self, domain: int) -> None:
        from gdp_extensions.dds.endpoint import DdsEndpoint

        self._endpoint = DdsEndpoint(domain, "offload")
        self._heard: dict[int, Callable[[bytes], None]] = {}

    def publisher(self, topic: str, type_name: str) -> Callable[[Message], None]:
        """Return a publisher of a topic."""
        handle = self._endpoint.advertise(self._endpoint.channel(topic, type_name))
        return lambda message: self._endpoint.publish(handle, serialize_message(message))

    def subscribe(self, topic: str, type_name: str, take: Callable[[Message], None]) -> None:
        """Call ``take`` with each message."""
        handle = self._endpoint.subscribe(topic, type_name, None)
        self._heard[handle] = lambda raw: take(deserialize_message(raw, TYPES[type_name]))

    def run(self, look: Callable[[], bool], every_s: float) -> None:
        """Work until ``look`` returns that the series is over."""
        from proxy.endpoints.core.endpoint import MessageReceived

        while not look():
            select([self._endpoint], [], [], every_s)
            for event in self._endpoint.poll_events():
                if isinstance(event, MessageReceived):
                    self._heard[event.handle](event.raw)


_End: TypeAlias = "_FastEnd | _CycloneEnd"

_ENDS: Final[Mapping[str, Callable[[int], _End]]] = {"fast": _FastEnd, "cyclone": _CycloneEnd}


def robot(settings: Settings) -> None:
    """Send one request after the other; print when each was sent and answered."""
    task, end, prefix = TASKS[settings["task"]](), _end(settings), settings["prefix"]
    at_once, count = int(settings["at_once"]), int(settings["count"])
    publish = [end.publisher(prefix + topic, type_name) for topic, type_name in task.parts]
    number, asked_s, greeted_s = 0, 0.0, 0.0

    def ask() -> None:
        nonlocal asked_s
        messages = task.request(max(number - at_once, 0))
        for message in messages:
            set_number(message, number)
        asked_s = time.monotonic()
        for send, message in zip(publish, messages, strict=True):
            send(message)

    def take(answer: Message) -> None:
        nonlocal number
        answered_s = time.monotonic()
        if number_of(answer) != number:
            return  # the answer to a repeated greeting
        if number:
            is_right = number <= at_once or task.is_right(number - at_once, answer)
            say(number=number, asked_s=asked_s, answered_s=answered_s, is_right=is_right)
        number += 1
        if number <= count:
            ask()

    def look() -> bool:
        nonlocal greeted_s
        now_s = time.monotonic()
        if not number and now_s >= greeted_s + _GREETING_S:
            greeted_s = now_s
            ask()
        return number > count

    answer_topic, answer_type = task.answer
    end.subscribe(prefix + answer_topic, answer_type, take)
    say(event="ready", request_bytes=sum(len(serialize_message(each)) for each in task.request(0)))
    end.run(look, _GREETING_S)
    say(event="over")
    end.run(lambda: False, _LONG_S)  # a reliable writer must stay to retransmit losses


def cloud(settings: Settings) -> None:
    """Answer until killed; print when all of each request had arrived and when the answer was ready."""
    task, end, prefix = TASKS[settings["task"]](), _end(settings), settings["prefix"]
    at_once = settings["at_once"]
    answer_topic, answer_type = task.answer
    publish = end.publisher(prefix + answer_topic, answer_type)
    waiting: dict[str, Message] = {}
    done = 0

    def take(topic: str, message: Message) -> None:
        nonlocal done
        waiting[topic] = message
        numbers = {number_of(each) for each in waiting.values()}
        if len(waiting) < len(task.parts) or len(numbers) > 1:
            return
        (number,) = numbers
        arrived_s = time.monotonic()
        if number and number <= done:
            return  # a duplicate part
        done = max(done, number)
        messages = [waiting[topic] for topic, _ in task.parts]
        answer = task.compute(messages) if number > at_once else TYPES[answer_type]()
        set_number(answer, number)
        computed_s = time.monotonic()
        publish(answer)
        say(number=number, arrived_s=arrived_s, computed_s=computed_s)

    for topic, type_name in task.parts:
        end.subscribe(prefix + topic, type_name, partial(take, topic))
    task.warm_up()
    say(event="ready")
    end.run(lambda: False, _LONG_S)


def alone(settings: Settings) -> None:
    """Compute without a server; print how long each request took."""
    task = TASKS[settings["task"]]()
    task.warm_up()
    is_limited = threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: is_limited.set())
    say(event="ready")
    is_limited.wait()  # wait until the parent process has put this one into its control group
    for number in range(1, settings["count"] + 1):
        messages = task.request(number)
        begun_s = time.monotonic()
        answer = task.compute(messages)
        took_s = time.monotonic() - begun_s
        say(number=number, took_s=took_s, is_right=task.is_right(number, answer))


def _end(settings: Settings) -> _End:
    return _ENDS[settings["middleware"]](settings["domain"])


if __name__ == "__main__":
    {"robot": robot, "cloud": cloud, "alone": alone}[sys.argv[1]](json.loads(sys.argv[2]))
