"""Common parts of the ROS nodes of the benches: a node with an executor, and two signals for the parent process.

Process of its own, started by ``ros_row.py``; only it and the nodes themselves import rclpy. The nodes have
no knowledge of the overlay.

The executor is rclpy's ``EventsExecutor`` where it exists. The ordinary one takes longer the more subscriptions a node
has, and would distort the measurement.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import FrameType
from typing import Any, Final

import rclpy
from peers.jsonl import say
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rclpy.timer import Timer
from report import percentile

try:
    from rclpy.experimental import EventsExecutor as BestExecutor
except ImportError:  # before Kilted and late Jazzy
    from rclpy.executors import SingleThreadedExecutor as BestExecutor

_STEP_S: Final = 60.0  # without a timeout, rclpy 7.1's EventsExecutor never checks the future

Settings = Mapping[str, Any]


class End:
    """Node at A or B; more ``threads`` than one have rclpy's executor for that."""

    def __init__(self, name: str, threads: int = 1) -> None:
        self.node = Node(name)
        self._executor = BestExecutor() if threads == 1 else MultiThreadedExecutor(threads)
        self._executor.add_node(self.node)
        self._done: Future[None] = Future()
        self._may_start = False
        signal.signal(signal.SIGUSR1, self._go)

    @property
    def may_start(self) -> bool:
        """Return whether a SIGUSR1 came: the other endpoint receives, the measurement may begin."""
        return self._may_start

    def finish(self) -> None:
        """End ``run``; call it from within ``run``."""
        if not self._done.done():
            self._done.set_result(None)

    def run(self, patience_s: float = math.inf) -> None:
        """Work until ``finish``, or for so long."""
        end_s = time.monotonic() + patience_s
        while not self._done.done() and (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_until_future_complete(self._done, timeout_sec=min(_STEP_S, left_s))
        self._done = Future()

    def every(self, seconds: float, work: Callable[[], None]) -> Timer:
        """Call a function at a steady rate; within ``run``, until the returned timer is cancelled."""
        return self.node.create_timer(seconds, work)

    def _go(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._may_start = True


def reliable(depth: int = 10) -> QoSProfile:
    """Return the profile of all topics here: reliable, volatile, with this depth in messages."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)


def percentiles(times_s: Sequence[float]) -> dict[str, float]:
    """Return the figures of a report: ``p50_s`` and ``p99_s``; none of no times."""
    return {f"p{at}_s": percentile(times_s, at / 100) for at in (50, 99) if times_s}


def run_role(roles: Mapping[str, Callable[[End, Settings], None]]) -> None:
    """Run the role of the first argument, with the settings of the second, until killed; ``threads`` is one."""
    role, settings = sys.argv[1], json.loads(sys.argv[2])
    rclpy.init()
    end = End(f"bench_{role}", settings.get("threads", 1))
    roles[role](end, settings)
    say(event="over")
    end.run()  # a reliable writer must stay to retransmit losses
