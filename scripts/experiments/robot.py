"""Clients of the experiments: ordinary rclpy nodes without knowledge of the overlay.

Process of its own, started by ``field.py`` at the robot or at a server: ``robot.py ROLE SETTINGS``.

``ask`` makes a series of calls, ``busy`` is the second client of figure 6; see ``series.py`` for their settings.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Final

import bench_path  # noqa: F401 - finds ``peers``
import rclpy
from peers.jsonl import say
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service_introspection import ServiceIntrospectionState
from rclpy.task import Future
from samples import Sample
from series import Contention, Series
from service_msgs.msg import ServiceEventInfo
from tasks import TASKS, WARM_UP, Response, Task

_PATIENCE_S: Final = 30.0
_TICK_S: Final = 0.002
_EVENTS: Final = 1_000
_LATE_S: Final = 0.02
_LINGER_S: Final = 0.5  # in which a surplus answer would arrive


class _Client:
    """Client that calls the services in turn.

    Each round carries the same request, so that the services can be compared.
    """

    def __init__(self, node: Node, task: Task, services: Sequence[str]) -> None:
        self._node = node
        self._task = task
        self._services = list(services)
        self._clients = {name: node.create_client(task.kind, name) for name in dict.fromkeys(services)}
        self.under_way: dict[int, tuple[str, float]] = {}
        self.sent = self.ended = 0
        self.is_warm = False
        self.winners: set[str] = set()

    def wait_for_servers(self) -> None:
        """Wait until each service is there."""
        for name, client in self._clients.items():
            if not client.wait_for_service(_PATIENCE_S):
                raise TimeoutError(f"{name}: no server")

    def count_answers(self) -> Counter[tuple[bytes, int]]:
        """Return a counter of the answers that reach each call of this node, by ROS 2's service introspection."""
        answers: Counter[tuple[bytes, int]] = Counter()
        deep = QoSProfile(depth=_EVENTS, reliability=ReliabilityPolicy.RELIABLE)

        def take(event: object) -> None:
            info: ServiceEventInfo = event.info  # type: ignore[attr-defined]
            if info.event_type == ServiceEventInfo.RESPONSE_RECEIVED:
                answers[bytes(info.client_gid), info.sequence_number] += 1

        for name, client in self._clients.items():
            self._node.create_subscription(self._task.kind.Event, f"{name}/_service_event", take, deep)
            client.configure_introspection(self._node.get_clock(), deep, ServiceIntrospectionState.METADATA)
        return answers

    def ask(self, then: Callable[[], None]) -> None:
        """Call the next service; ``then`` is called when it has answered."""
        number, self.sent = self.sent, self.sent + 1
        name = self._services[number % len(self._services)]
        turn = number // len(self._services) if self.is_warm else WARM_UP
        request = self._task.request(turn)
        begun_s = time.monotonic()
        self.under_way[number] = (name, begun_s)

        def take(future: Future[Response]) -> None:
            took_s = time.monotonic() - begun_s
            if self.under_way.pop(number, None) is None:
                return
            judged = self._task.judge(turn, future.result())
            self.winners.add(judged.machine)
            sample = Sample(name, begun_s, took_s, judged.machine, judged.worked_s, judged.is_right, judged.note)
            self._note(sample)
            then()

        self._clients[name].call_async(request).add_done_callback(take)

    def give_up(self, patience_s: float) -> None:
        """Count calls as failed that have been in progress for longer; later answers to them are ignored."""
        now_s = time.monotonic()
        for number, (name, begun_s) in list(self.under_way.items()):
            if now_s - begun_s >= patience_s:
                del self.under_way[number]
                self._note(Sample(name, begun_s, now_s - begun_s, "", 0.0, is_right=False))

    def start_over(self) -> None:
        """Reset the count: the calls until now were the warm-up."""
        self.give_up(0.0)
        self.sent = self.ended = 0
        self.is_warm = True

    def _note(self, sample: Sample) -> None:
        self.ended += 1
        if self.is_warm:
            say(sample=asdict(sample))


def ask(node: Node, executor: SingleThreadedExecutor, settings: Mapping[str, object]) -> None:
    """Call so often, and print what came of each call, in a line of its own."""
    series = Series(**settings)  # type: ignore[arg-type]
    client = _Client(node, TASKS[series.task](series.problem), series.services)
    answers = client.count_answers() if series.counts_answers else None
    done: Future[None] = Future()
    client.wait_for_servers()
    deadline_s = time.monotonic() + _PATIENCE_S
    while client.sent < series.warm_up or not client.winners.issuperset(series.machines):
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"no answer of {', '.join({*series.machines} - client.winners)}")
        first: Future[None] = Future()
        client.ask(partial(first.set_result, None))
        executor.spin_until_future_complete(first, timeout_sec=series.patience_s)
    client.start_over()
    if answers is not None:
        executor.spin_until_future_complete(Future(), timeout_sec=_LINGER_S)
        answers.clear()
    due_s = time.monotonic()
    say(event="begins", at_s=due_s)

    def tick() -> None:
        nonlocal due_s
        now_s = time.monotonic()
        while client.sent < series.count and len(client.under_way) < series.lanes and due_s <= now_s:
            due_s = max(due_s, now_s - _LATE_S) + series.gap_s  # a client that was delayed for long skips calls
            client.ask(tick)
        client.give_up(series.patience_s)
        if not done.done() and client.ended == series.count:
            done.set_result(None)

    node.create_timer(_TICK_S, tick)
    executor.spin_until_future_complete(done)
    if answers is not None:
        executor.spin_until_future_complete(Future(), timeout_sec=_LINGER_S)
    heard = None if answers is None else sum(answers.values())
    say(event="over", heard=heard, twice=None if answers is None or heard is None else heard - len(answers))


def busy(node: Node, executor: SingleThreadedExecutor, settings: Mapping[str, object]) -> None:
    """Run as the second client, until killed."""
    contention = Contention(**settings)  # type: ignore[arg-type]
    client = _Client(node, TASKS[contention.task](""), [contention.service])
    client.wait_for_servers()
    begun_s = time.monotonic()
    say(event="begins", at_s=begun_s)

    def tick() -> None:
        period_s = contention.on_s + contention.off_s
        if (time.monotonic() - begun_s) % period_s < contention.on_s and not client.under_way:
            client.ask(tick)

    node.create_timer(_TICK_S, tick)
    executor.spin()


_ROLES: Final[Mapping[str, Callable[[Node, SingleThreadedExecutor, Mapping[str, object]], None]]] = {
    "ask": ask,
    "busy": busy,
}


def main() -> None:
    """Run the role of the first argument."""
    rclpy.init()
    node, executor = Node(f"robot_{sys.argv[1]}"), SingleThreadedExecutor()
    executor.add_node(node)
    _ROLES[sys.argv[1]](node, executor, json.loads(sys.argv[2]))


if __name__ == "__main__":
    main()
