"""Client and server of ``ros.py --calls``, and replicas of ``replicas.py``: ordinary rclpy nodes.

Process of its own, started by ``ros_row.py`` as ``serve``, ``call`` (one call at a time) or ``load`` (many
clients, calls at a steady rate). The server echoes the request, so that an answer to another call is detected.
``replicate`` runs in a field (``scripts/experiments/field.py``).
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from peers.jsonl import say
from rcl_interfaces.srv import ListParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.task import Future
from ros_endpoint import End, Settings, percentiles, reliable, run_role
from std_srvs.srv import SetBool

_WARM_UP: Final = 100
_TICK_S: Final = 0.001
_PATIENCE_S: Final = 10.0
_DEPTH: Final = 1_000  # every client receives the answers to all clients; a queue of ten fills soon


def serve(end: End, settings: Settings) -> None:
    """Answer until killed."""

    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = request.data
        return response

    end.node.create_service(SetBool, settings["service"], answer, qos_profile=reliable(_DEPTH))
    say(event="ready")
    end.run()


class _Calls:
    """Calls in progress, and their results."""

    def __init__(self) -> None:
        self.sent = self.wrong = 0
        self.times_s: list[float] = []  # of those that were answered

    def begin(self, client: Client, then: Callable[[], None]) -> None:
        """Call; ``then`` is called when the answer is there."""
        data, begun_s = random.random() < 0.5, time.perf_counter()

        def take(future: Future[SetBool.Response]) -> None:
            self.times_s.append(time.perf_counter() - begun_s)
            self.wrong += future.result().success != data
            then()

        self.sent += 1
        client.call_async(SetBool.Request(data=data)).add_done_callback(take)

    def in_turn(self, end: End, clients: Iterator[Client]) -> None:
        """Call by one client after the other, each when the one before has its answer."""
        client = next(clients, None)
        if client is None:
            end.finish()
        else:
            self.begin(client, partial(self.in_turn, end, clients))

    def report(self) -> None:
        """Print the figures."""
        say(sent=self.sent, lost=self.sent - len(self.times_s), wrong=self.wrong, **percentiles(self.times_s))


def _warm_clients(end: End, settings: Settings, count: int) -> list[Client]:
    """Return clients that have each called more than once."""
    name, profile = settings["service"], reliable(_DEPTH)
    clients = [end.node.create_client(SetBool, name, qos_profile=profile) for _ in range(count)]
    for client in clients:
        if not client.wait_for_service(_PATIENCE_S):
            raise TimeoutError("no server: the overlay did not come up")
    _Calls().in_turn(end, iter(clients * max(_WARM_UP // count, 2)))
    end.run()
    say(event="begins")
    return clients


def call(end: End, settings: Settings) -> None:
    """Call, one after the other, for so many seconds."""
    (client,) = _warm_clients(end, settings, 1)
    calls, until_s = _Calls(), time.monotonic() + settings["seconds"]
    calls.in_turn(end, iter(lambda: client if time.monotonic() < until_s else None, None))
    end.run(settings["seconds"] + _PATIENCE_S)  # an answer may not come
    calls.report()


def load(end: End, settings: Settings) -> None:
    """Have ``clients`` call in turn, ``rate`` calls a second in all, each without waiting for the others' answers."""
    clients = _warm_clients(end, settings, settings["clients"])
    calls, count, gap_s = _Calls(), settings["count"], 1 / settings["rate"]
    begun_s = time.monotonic()

    def tick() -> None:
        now_s = time.monotonic()
        while calls.sent < count and begun_s + calls.sent * gap_s <= now_s:
            calls.begin(clients[calls.sent % len(clients)], finish_if_all)

    def finish_if_all() -> None:
        if len(calls.times_s) == count:
            end.finish()

    end.every(_TICK_S, tick)
    end.run(count * gap_s + _PATIENCE_S)
    calls.report()


def replicate(end: End, settings: Settings) -> None:
    """Answer until killed: the number of the request, the machine, and how many requests it has had to this service.

    One in ``slow_in`` requests takes ``slow_s`` more; with ``threads`` it delays no other. The type is
    ``rcl_interfaces/srv/ListParameters``, because its request has content (``Number`` in ``tasks.py``).
    """
    machine, group = settings["machine"], ReentrantCallbackGroup()
    slow_in, slow_s = settings.get("slow_in", 0), settings.get("slow_s", 0.0)
    had: Counter[str] = Counter()

    def answer(
        name: str, request: ListParameters.Request, response: ListParameters.Response
    ) -> ListParameters.Response:
        if not had:
            say(event="serving")
        had[name] += 1
        if slow_in and random.randrange(slow_in) == 0:
            time.sleep(slow_s)
        response.result.names = [str(request.depth), machine, str(had[name])]
        return response

    for name in settings["services"].split():
        end.node.create_service(
            ListParameters, name, partial(answer, name), qos_profile=reliable(_DEPTH), callback_group=group
        )
    say(event="ready")
    end.run()


if __name__ == "__main__":
    run_role({"serve": serve, "call": call, "load": load, "replicate": replicate})
