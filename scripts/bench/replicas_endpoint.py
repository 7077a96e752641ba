"""Client of the robot and replicas of ``replicas.py``: ordinary rclpy nodes without knowledge of the overlay.

Process of its own, started in a field (``scripts/experiments/field.py``) as ``serve``, ``straggle`` or ``ask``.

The type is ``rcl_interfaces/srv/ListParameters``, because its request has content: ``depth`` is the number
of the request, one prefix fills it up to 100 bytes of CDR. The answer names that number, the machine, and how many
requests to this service the machine has had.
"""

from __future__ import annotations

import json
import random
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from typing import Final

import rclpy
from peers.jsonl import say
from rcl_interfaces.srv import ListParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.service_introspection import ServiceIntrospectionState
from rclpy.task import Future
from ros_endpoint import End, Settings, reliable, run_role
from service_msgs.msg import ServiceEventInfo

_FILL: Final = "x" * 79  # 4 encapsulation, 4 count, 4 length, 80 text with its end, 8 depth: 100
_DEPTH: Final = 1_000
_EVENTS: Final = 10_000
_TICK_S: Final = 0.001
_REPORT_INTERVAL_S: Final = 1.0
_WARM_UP: Final = 50
_PATIENCE_S: Final = 30.0
_THREADS: Final = 8


def serve(end: End, settings: Settings) -> None:
    """Answer until killed."""
    _offer(end.node, settings)
    say(event="ready")
    end.run()


def straggle(settings: Settings) -> None:
    """Answer until killed; one in ``slow_in`` requests takes ``slow_s`` more, and delays no other."""
    slow_in, slow_s = int(str(settings["slow_in"])), float(str(settings["slow_s"]))

    def pause() -> None:
        if random.randrange(slow_in) == 0:
            time.sleep(slow_s)

    rclpy.init()
    node, executor = Node("bench_straggle"), MultiThreadedExecutor(_THREADS)
    executor.add_node(node)
    _offer(node, settings, pause)
    say(event="ready")
    executor.spin()


def _offer(node: Node, settings: Settings, pause: Callable[[], None] = lambda: None) -> None:
    """Create the services. ``pause`` is called before each answer."""
    machine, group = str(settings["machine"]), ReentrantCallbackGroup()
    had: Counter[str] = Counter()

    def answer(
        name: str, request: ListParameters.Request, response: ListParameters.Response
    ) -> ListParameters.Response:
        if not had:
            say(event="serving")
        had[name] += 1
        pause()
        response.result.names = [str(request.depth), machine, str(had[name])]
        return response

    for name in str(settings["services"]).split():
        node.create_service(
            ListParameters, name, partial(answer, name), qos_profile=reliable(_DEPTH), callback_group=group
        )


class _Asking:
    """Requests in progress, and their results."""

    def __init__(self, clients: dict[str, Client]) -> None:
        self._clients = clients
        self._under_way: dict[int, tuple[str, float]] = {}
        self.sent = self.ended = self.failed = self.wrong = 0
        self.times_s: defaultdict[str, list[float]] = defaultdict(list)
        self.had: defaultdict[str, Counter[str]] = defaultdict(Counter)  # service -> machine -> requests
        self.won: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._under_way)

    def begin(self, name: str, then: Callable[[], None]) -> None:
        """Send a request; ``then`` is called when it is answered."""
        number, begun_s = self.sent, time.perf_counter()
        self.sent += 1
        self._under_way[number] = name, begun_s

        def take(future: Future[ListParameters.Response]) -> None:
            if self._under_way.pop(number, None) is None:
                return  # already counted as failed
            self.times_s[name].append(time.perf_counter() - begun_s)
            said, machine, had = future.result().result.names
            self.wrong += said != str(number)
            self.had[name][machine] = max(self.had[name][machine], int(had))
            self.won[machine] += 1
            self.ended += 1
            then()

        request = ListParameters.Request(prefixes=[_FILL], depth=number)
        self._clients[name].call_async(request).add_done_callback(take)

    def give_up(self, patience_s: float) -> None:
        """Count requests as failed that have been in progress for longer."""
        now_s = time.perf_counter()
        for number, (_, begun_s) in list(self._under_way.items()):
            if now_s - begun_s < patience_s:
                return
            del self._under_way[number]
            self.failed += 1
            self.ended += 1


def ask(end: End, settings: Settings) -> None:
    """Call the services in turn, ``count`` requests in all, ``lanes`` at most at a time, at a steady rate."""
    names = str(settings["services"]).split()
    count, lanes, gap_s = int(str(settings["count"])), int(str(settings["lanes"])), 1 / float(str(settings["rate"]))
    patience_s = float(str(settings["patience_s"]))
    clients = {name: end.node.create_client(ListParameters, name, qos_profile=reliable(_DEPTH)) for name in set(names)}
    for name, client in clients.items():
        if not client.wait_for_service(_PATIENCE_S):
            raise TimeoutError(f"{name}: no server: the overlay did not come up")
    warm = _warm_up(end, clients, names)
    heard = _count_answers(end, clients) if settings.get("counts_answers") else None
    asking, begun_s = _Asking(clients), time.monotonic()
    reported_s = due_s = begun_s
    say(event="begins")

    def step() -> None:
        nonlocal due_s, reported_s
        now_s = time.monotonic()
        while asking.sent < count and len(asking) < lanes and due_s <= now_s:
            due_s = max(due_s, now_s - patience_s) + gap_s
            asking.begin(names[asking.sent % len(names)], _nothing)
        asking.give_up(patience_s)
        if now_s - reported_s >= _REPORT_INTERVAL_S:
            reported_s = now_s
            say(event="asked", ended=asking.ended, failed=asking.failed)
        if asking.ended >= count:
            end.finish()

    timer = end.node.create_timer(_TICK_S, step)
    end.run()
    timer.cancel()
    took_s = time.monotonic() - begun_s
    if heard is not None:
        _linger(end)  # wait for surplus answers
    say(
        event="asked all",
        failed=asking.failed,
        wrong=asking.wrong,
        heard=None if heard is None else sum(heard.values()),
        twice=None if heard is None else sum(number - 1 for number in heard.values()),
        took_s=took_s,
        times_s=asking.times_s,
        had=asking.had,
        asked={name: warm[name] + len(asking.times_s[name]) for name in clients},
        won=asking.won,
    )


def _warm_up(end: End, clients: dict[str, Client], names: list[str]) -> Counter[str]:
    asking, most = _Asking(clients), _WARM_UP * len(clients)

    def go_on() -> None:
        if asking.sent < most:
            asking.begin(names[asking.sent % len(names)], go_on)
        else:
            end.finish()

    go_on()
    end.run()
    return Counter({name: len(times_s) for name, times_s in asking.times_s.items()})


def _linger(end: End) -> None:
    timer = end.node.create_timer(_REPORT_INTERVAL_S, end.finish)
    end.run()
    timer.cancel()


def _count_answers(end: End, clients: dict[str, Client]) -> Counter[tuple[bytes, int]]:
    """Return a counter of the answers that reach each call of this node, by ROS 2's service introspection."""
    answers: Counter[tuple[bytes, int]] = Counter()

    def take(event: ListParameters.Event) -> None:
        if event.info.event_type == ServiceEventInfo.RESPONSE_RECEIVED:
            answers[bytes(event.info.client_gid), event.info.sequence_number] += 1

    for name, client in clients.items():
        end.node.create_subscription(ListParameters.Event, f"{name}/_service_event", take, reliable(_EVENTS))
        client.configure_introspection(end.node.get_clock(), reliable(_EVENTS), ServiceIntrospectionState.METADATA)
    return answers


def _nothing() -> None:
    """Do nothing."""


if __name__ == "__main__":
    if sys.argv[1] == "straggle":
        straggle(json.loads(sys.argv[2]))
    else:
        run_role({"serve": serve, "ask": ask})
