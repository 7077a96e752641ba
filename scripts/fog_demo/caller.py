"""Robot's node that calls ``/echo`` at a fixed rate and prints statistics as lines of JSON.

I/O; needs rclpy. Parameters: ``rate_hz``; ``calls``: total number, 0: until Ctrl-C; ``timeout_s``: time after which a
call counts as failed; ``report_s``: interval of lines; ``depth``: queue of responses for this node (ROS 2's default is
10, and it drops the oldest of more). After SIGUSR1 the node starts no calls and ends when the pending ones have ended.
A line is ``{"calls", "answered", "failed", "wrong", "unserved", "under_way", "median_ms", "p99_ms", "silence_ms",
"by_machine", "done"}``. ``unserved`` are calls omitted because no server existed after the first call. ``silence_ms``
is the longest time between two responses since the previous line. The last line has ``"done": true``. Exit status 1 if
any call failed.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import Counter, deque
from copy import copy
from dataclasses import dataclass, field
from typing import Protocol

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.qos import qos_profile_services_default
from std_srvs.srv import SetBool


class _Answer(Protocol):
    success: bool
    message: str


@dataclass(slots=True, kw_only=True)
class Tally:
    """Statistics of calls; only the newest latencies are kept."""

    calls: int = 0
    failed: int = 0
    wrong: int = 0
    unserved: int = 0
    by_machine: Counter[str] = field(default_factory=Counter)
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))
    silence_s: float = 0.0
    answered_s: float | None = None

    def answered(self, asked: bool, answer: _Answer, took_s: float, now_s: float) -> None:
        """Count a response; ``now_s``: monotonic seconds."""
        self.silence_s = max(self.silence_s, now_s - (now_s if self.answered_s is None else self.answered_s))
        self.answered_s = now_s
        if answer.success != asked:
            self.wrong += 1
        self.by_machine[answer.message] += 1
        self.latencies_s.append(took_s)

    def line(self, *, done: bool) -> str:
        """Return the counts as one line of JSON; resets the longest silence."""
        silence_s, self.silence_s = self.silence_s, 0.0
        answered = self.by_machine.total()
        ranked = sorted(self.latencies_s)
        spread = {
            f"{name}_ms": round(1e3 * ranked[int(share * (len(ranked) - 1))], 3) if ranked else None
            for name, share in (("median", 0.5), ("p99", 0.99))
        }
        counts = {
            "calls": self.calls,
            "answered": answered,
            "failed": self.failed,
            "wrong": self.wrong,
            "unserved": self.unserved,
            "under_way": self.calls - answered - self.failed,
        }
        spread["silence_ms"] = round(1e3 * silence_s, 3)
        return json.dumps({**counts, **spread, "by_machine": dict(self.by_machine), "done": done})


def main() -> None:
    """Call until Ctrl-C or SIGTERM, or until enough calls have ended."""
    rclpy.init()
    node = rclpy.create_node("caller")
    number = ParameterDescriptor(dynamic_typing=True)  # accepts 20 as well as 20.0
    rate_hz = float(node.declare_parameter("rate_hz", 20.0, number).value)
    most = int(node.declare_parameter("calls", 0).value)
    timeout_s = float(node.declare_parameter("timeout_s", 10.0, number).value)
    report_s = float(node.declare_parameter("report_s", 1.0, number).value)
    profile = copy(qos_profile_services_default)
    profile.depth = int(node.declare_parameter("depth", profile.depth).value)
    client = node.create_client(SetBool, "/echo", qos_profile=profile)
    stats = Tally()
    waiting: dict[object, tuple[bool, float]] = {}

    def finish(*_: object) -> None:
        nonlocal most
        most = max(stats.calls, 1)

    def call() -> None:
        overdue = [future for future, (_, began_s) in waiting.items() if time.monotonic() - began_s > timeout_s]
        for future in overdue:
            _, began_s = waiting.pop(future)
            client.remove_pending_request(future)
            stats.failed += 1
            node.get_logger().warning(f"no answer to what was asked {time.monotonic() - began_s:.3f} s ago")
        if most and stats.calls >= most:
            return
        if not client.service_is_ready():
            stats.unserved += stats.calls > 0
            return
        asked = stats.calls % 2 == 0
        future = client.call_async(SetBool.Request(data=asked))
        stats.calls += 1
        waiting[future] = (asked, time.monotonic())
        future.add_done_callback(answered)

    def answered(future: rclpy.Future) -> None:
        if future in waiting and future.done():
            asked, began_s = waiting.pop(future)
            now_s = time.monotonic()
            stats.answered(asked, future.result(), now_s - began_s, now_s)

    signal.signal(signal.SIGUSR1, finish)
    node.create_timer(1.0 / rate_hz, call)

    def report(*, done: bool = False) -> None:
        print(stats.line(done=done), flush=True)  # the program's output

    node.create_timer(report_s, report)
    try:
        while not (most and stats.calls >= most and not waiting):
            rclpy.spin_once(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal and its launch both send one: the second cuts nothing
    report(done=True)
    node.destroy_node()
    rclpy.try_shutdown()
    sys.exit(1 if stats.failed or stats.wrong else 0)


if __name__ == "__main__":
    main()
