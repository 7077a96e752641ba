"""Robot and cloud of ``fogros.py``: the robot sends the messages of a task, the cloud answers once it has all of them.

Process of its own, started by ``ros_row.py`` as ``robot`` or ``cloud``. Nothing is computed: the time is
that of the network, both ways. Pixels and meshes are random bytes. Every message carries the number of its request, in
its header's ``frame_id`` or its layout's ``data_offset``; requests numbered 0 are greetings.
"""

from __future__ import annotations

import array
import secrets
import time
from functools import partial
from typing import Final, TypeAlias

from fogros_tasks import CAMERA, IMAGE, NUMBERS, OCTETS, POSE, TASKS, Part, Task
from geometry_msgs.msg import PoseStamped
from peers.jsonl import say
from rclpy.serialization import serialize_message
from report import percentile
from ros_endpoint import End, Settings, reliable, run_role
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray, MultiArrayLayout, UInt8MultiArray

__all__ = ["TYPES", "Message", "message_of", "number_of", "set_number"]

Message: TypeAlias = "CameraInfo | Float64MultiArray | Image | PoseStamped | UInt8MultiArray"

TYPES: Final = {
    CAMERA: CameraInfo,
    IMAGE: Image,
    NUMBERS: Float64MultiArray,
    OCTETS: UInt8MultiArray,
    POSE: PoseStamped,
}
_GREETING_S: Final = 0.2
_PATIENCE_S: Final = 10.0
_WARM_UP: Final = 10


def message_of(part: Part) -> Message:
    """Return a message of the right kind and size."""
    if part.type_name == IMAGE:
        step = part.width * part.pixel
        data = array.array("B", secrets.token_bytes(part.height * step))
        return Image(height=part.height, width=part.width, encoding=part.encoding, step=step, data=data)
    if part.type_name == OCTETS:
        return UInt8MultiArray(layout=MultiArrayLayout(), data=array.array("B", secrets.token_bytes(part.count)))
    if part.type_name == NUMBERS:
        return Float64MultiArray(layout=MultiArrayLayout(), data=array.array("d", range(part.count)))
    return CameraInfo() if part.type_name == CAMERA else PoseStamped()


def set_number(message: Message, number: int) -> None:
    """Write the number of its request into a message."""
    if isinstance(message, Float64MultiArray | UInt8MultiArray):
        message.layout.data_offset = number
    else:
        message.header.frame_id = str(number)


def number_of(message: Message) -> int:
    """Return the number of the request of a message."""
    if isinstance(message, Float64MultiArray | UInt8MultiArray):
        return int(message.layout.data_offset)
    return int(message.header.frame_id)


class _Robot:
    """Client that sends the next request when the answer has arrived."""

    def __init__(self, end: End, task: Task, prefix: str, seconds: float) -> None:
        self._end = end
        self._messages = [message_of(part) for part in task.parts]
        self.bytes = sum(len(serialize_message(message)) for message in self._messages)
        self._publishers = [
            end.node.create_publisher(TYPES[part.type_name], prefix + part.topic, reliable()) for part in task.parts
        ]
        end.node.create_subscription(TYPES[task.answer.type_name], prefix + task.answer.topic, self._take, reliable())
        self._seconds = seconds
        self._number = 0
        self._asked_s = self._until_s = 0.0
        self.times_s: list[float] = []
        end.every(_GREETING_S, self._look)

    def _ask(self) -> None:
        self._asked_s = time.monotonic()
        for publisher, message in zip(self._publishers, self._messages, strict=True):
            set_number(message, self._number)
            publisher.publish(message)

    def _take(self, answer: Message) -> None:
        now_s = time.monotonic()
        if number_of(answer) != self._number:
            return  # the answer to a repeated greeting
        if self._number == _WARM_UP:
            self._until_s = now_s + self._seconds
            say(event="begins", bytes=self.bytes)
        elif self._number > _WARM_UP:
            self.times_s.append(now_s - self._asked_s)
            if now_s > self._until_s:
                self._end.finish()
                return
        self._number += 1
        self._ask()

    def _look(self) -> None:
        if not self._number:
            self._ask()
        elif time.monotonic() > self._asked_s + _PATIENCE_S:
            self._end.finish()  # an answer did not come


def robot(end: End, settings: Settings) -> None:
    """Send requests for so many seconds, one after the other; report how long each took."""
    asking = _Robot(end, _task_of(settings), str(settings["prefix"]), float(str(settings["seconds"])))
    end.run()
    figures = {f"p{at}_s": percentile(asking.times_s, at / 100) for at in (50, 99) if asking.times_s}
    say(requests=len(asking.times_s), **figures)


def cloud(end: End, settings: Settings) -> None:
    """Answer until killed."""
    task, prefix = _task_of(settings), str(settings["prefix"])
    answer = message_of(task.answer)
    publisher = end.node.create_publisher(TYPES[task.answer.type_name], prefix + task.answer.topic, reliable())
    latest = dict.fromkeys((part.topic for part in task.parts), -1)

    def take(topic: str, message: Message) -> None:
        latest[topic] = number = number_of(message)
        if all(each == number for each in latest.values()):
            set_number(answer, number)
            publisher.publish(answer)

    for part in task.parts:
        kind = TYPES[part.type_name]
        end.node.create_subscription(kind, prefix + part.topic, partial(take, part.topic), reliable())
    say(event="ready")
    end.run()


def _task_of(settings: Settings) -> Task:
    return next(task for task in TASKS if task.name == settings["task"])


if __name__ == "__main__":
    run_role({"robot": robot, "cloud": cloud})
