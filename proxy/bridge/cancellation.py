"""Cancellation of calls at one exposed service, once no client waits for them any more; the calls of each goal.

I/O: it calls the local endpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from gdp.names import Name
from gdp.service.frames import Stop
from gdp.service.serving import Asked, Serving
from proxy.bridge.core.action_interface import GOAL, RESULT
from proxy.endpoints.core.endpoint import RosEndpoint

TRIGGER: Final = "std_srvs/srv/Trigger"

# empty request of a Trigger; ROS 2 fills a message without fields with one byte
NO_FIELDS: Final = {1: b"", 2: b"\0\1\0\0\0"}


class GoalCalls:
    """Requests to accept goals and requests for their results; each operation takes constant time."""

    def __init__(self) -> None:
        self._goals: dict[Asked, bytes] = {}
        self._calls: dict[tuple[int, bytes], dict[Asked, None]] = {}  # by part and goal

    def __len__(self) -> int:
        return len(self._goals)

    def add(self, asked: Asked, goal: bytes) -> None:
        """Add a call."""
        self._goals[asked] = goal
        self._calls.setdefault((asked.part, goal), {})[asked] = None

    def end(self, asked: Asked) -> bytes | None:
        """Remove a call that has ended; return its goal, None where it has none."""
        goal = self._goals.pop(asked, None)
        if goal is not None:
            calls = self._calls[asked.part, goal]
            del calls[asked]
            if not calls:
                del self._calls[asked.part, goal]
        return goal

    def accepting(self, goal: bytes) -> Asked | None:
        """Return the call by which the local server is asked to accept a goal."""
        return next(iter(self._calls.get((GOAL, goal), ())), None)

    def is_awaited(self, goal: bytes) -> bool:
        """Return whether a client waits for a goal's result."""
        return (RESULT, goal) in self._calls


class Cancellation:
    """Stops calls: of an action by cancelling the goal, of a service by calling the rule's ``stop``.

    Args:
        servers: handles of the local server, by part.
        stopper: handle of the rule's ``stop``; None: it has none.
        is_concurrent: the local server processes several calls at once; else it finishes one before the next.
        cancel_goal: sends the request that cancels a goal to the local server, at a monotonic second.
    """

    def __init__(
        self,
        *,
        endpoint: RosEndpoint,
        serving: Serving[bytes],
        goals: GoalCalls,
        servers: Sequence[int],
        stopper: int | None,
        is_concurrent: bool,
        cancel_goal: Callable[[bytes, float], None],
    ) -> None:
        self._endpoint = endpoint
        self._serving = serving
        self._goals = goals
        self._servers = servers
        self._stopper = stopper
        self._is_concurrent = is_concurrent
        self._cancel_goal = cancel_goal
        self._stops = 0  # number of the last call of the stopper

    def handle_stop(self, client: Name, stop: Stop, now_s: float) -> None:
        """Process that a client's calls have ended: pending requests are dropped, running ones are stopped."""
        is_working = False
        for call in stop.calls:
            asked = Asked(client, stop.part, call)
            goal = self._goals.end(asked)
            number = self._serving.stop(asked)
            if number is not None and stop.part < len(self._servers):
                is_working = True
                self._release(stop.part, number)
            if goal is not None and stop.part == RESULT and not self._goals.is_awaited(goal):
                self._cancel_goal(goal, now_s)
        if is_working:
            self._stop_work()

    def handle_client_gone(self, client: Name) -> None:
        """Drop the calls of a client that left. Its goals continue: it may return and request their results."""
        is_working = False
        for number, part, asked, is_given in self._serving.remove_client(client):
            if asked is not None:
                self._goals.end(asked)
            if is_given:
                is_working = True
                self._release(part, number)
        if is_working:
            self._stop_work()

    def handle_timeout(self, part: int, number: int) -> None:
        """Stop a call whose time has run out."""
        self._endpoint.drop(self._servers[part], number)
        self._stop_work()

    def _release(self, part: int, number: int) -> None:
        """Forget a running call, unless the next call waits for its end."""
        if self._is_concurrent:
            self._endpoint.drop(self._servers[part], number)

    def _stop_work(self) -> None:
        """Call the rule's ``stop``, if there is one."""
        if self._stopper is not None:
            self._endpoint.drop(self._stopper, self._stops)  # the response to the last one is not used
            self._stops += 1
            self._endpoint.call(self._stopper, self._stops, NO_FIELDS[self._endpoint.ros])
