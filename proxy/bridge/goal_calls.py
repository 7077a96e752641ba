"""Index of the calls under way at an action's server, by goal."""

from __future__ import annotations

from gdp.service.serving import Asked
from proxy.bridge.core.action_interface import GOAL, RESULT


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
