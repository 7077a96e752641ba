"""Clients of the experiments: ordinary rclpy nodes without knowledge of the overlay.

Process of its own, started by ``field.py`` at the robot or at a server: ``robot.py ROLE SETTINGS``.

``ask`` makes a series of calls (``samples.py``), ``busy`` is the second client of figure 6.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Final

import bench_path  # noqa: F401 - finds ``peers``
from peers.jsonl import say
from rclpy.node import Node
from rclpy.service_introspection import ServiceIntrospectionState
from rclpy.task import Future
from ros_endpoint import End, Settings, reliable, run_role
from samples import Sample, Series
from service_msgs.msg import ServiceEventInfo
from tasks import WARM_UP, Response, Task, task_of

_PATIENCE_S: Final = 30.0
_TICK_S: Final = 0.002
_DEPTH: Final = 1_000  # every client receives the answers to all clients
_EVENTS: Final = 10_000
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
        self._clients = {
            name: node.create_client(task.kind, name, qos_profile=reliable(_DEPTH)) for name in dict.fromkeys(services)
        }
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
        deep = reliable(_EVENTS)

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

    def start_over(self) -> dict[str, int]:
        """Reset the count; return how often each service was called until now, in the warm-up."""
        self.give_up(0.0)
        called = Counter(self._services[number % len(self._services)] for number in range(self.sent))
        self.sent = self.ended = 0
        self.is_warm = True
        return dict(called)

    def _note(self, sample: Sample) -> None:
        self.ended += 1
        if self.is_warm:
            say(sample=asdict(sample))


def ask(end: End, settings: Settings) -> None:
    """Call so often, and print what came of each call, in a line of its own."""
    series = Series(**settings)
    client = _Client(end.node, task_of(series.task, series.problem), series.services)
    answers = client.count_answers() if series.counts_answers else None
    client.wait_for_servers()
    deadline_s = time.monotonic() + _PATIENCE_S
    while client.sent < series.warm_up or not client.winners.issuperset(series.machines):
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"no answer of {', '.join({*series.machines} - client.winners)}")
        client.ask(end.finish)
        end.run(series.patience_s)
    warm_up = client.start_over()
    if answers is not None:
        end.run(_LINGER_S)
        answers.clear()
    due_s = time.monotonic()
    say(event="begins", at_s=due_s, warm_up=warm_up)

    def tick() -> None:
        nonlocal due_s
        now_s = time.monotonic()
        while client.sent < series.count and len(client.under_way) < series.lanes and due_s <= now_s:
            due_s = max(due_s, now_s - _LATE_S) + series.gap_s  # a client that was delayed for long skips calls
            client.ask(tick)
        client.give_up(series.patience_s)
        if client.ended == series.count:
            end.finish()

    timer = end.every(_TICK_S, tick)
    end.run()
    timer.cancel()
    if answers is not None:
        end.run(_LINGER_S)
    heard = None if answers is None else sum(answers.values())
    say(event="over", heard=heard, twice=None if answers is None or heard is None else heard - len(answers))


def busy(end: End, settings: Settings) -> None:
    """Call one service, one call after the other for ``on_s``, none for ``off_s``, and so on, until killed."""
    on_s, off_s = settings["on_s"], settings["off_s"]
    client = _Client(end.node, task_of(settings["task"]), [settings["service"]])
    client.wait_for_servers()
    begun_s = time.monotonic()
    say(event="begins", at_s=begun_s)

    def tick() -> None:
        if (time.monotonic() - begun_s) % (on_s + off_s) < on_s and not client.under_way:
            client.ask(tick)

    end.every(_TICK_S, tick)
    end.run()


if __name__ == "__main__":
    run_role({"ask": ask, "busy": busy})
