"""What is to be sent to far servers, and what of it waits for room on the stream that all of them hear.

Place: pure.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TypeAlias

from gdp.service.dispatch import Ask
from gdp.service.dispatch import Effect as DispatchEffect
from gdp.service.replication_messages import ReplicaCommand
from proxy.wire.replication import to_wire
from proxy.wire.service import Stop

__all__ = ["BroadcastQueue", "Effect", "wire_of"]

Effect: TypeAlias = "DispatchEffect | ReplicaCommand"


def wire_of(part: int, effect: Effect) -> bytes:
    """Return what travels.

    Raises:
        LocalError: it cannot.
    """
    if isinstance(effect, Ask):
        return effect.request
    return to_wire(effect.word) if isinstance(effect, ReplicaCommand) else Stop(part, effect.calls).to_wire()


class BroadcastQueue:
    """What waits, in its order; a request no longer than its call."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[tuple[int, int], DispatchEffect] = OrderedDict()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, part: int, effect: DispatchEffect) -> None:
        """Let something wait; a call is asked, and is told to have ended, once."""
        self._waiting[part, effect.call if isinstance(effect, Ask) else ~effect.calls[0]] = effect

    def poll_effect(self) -> tuple[int, DispatchEffect]:
        """Return, once, what is next, and about which part; there must be something."""
        (part, _), effect = self._waiting.popitem(last=False)
        return part, effect

    def end(self, part: int, call: int) -> None:
        """Forget the request of a call that has ended."""
        self._waiting.pop((part, call), None)

    def clear(self) -> None:
        """Forget everything."""
        self._waiting.clear()
