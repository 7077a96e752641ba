"""Broadcast queue: requests to all remote servers that wait for capacity of their common stream.

Sans-I/O.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TypeAlias

from gdp.service.dispatch import Ask
from gdp.service.dispatch import Stop as DispatchStop
from gdp.service.frames import Stop
from gdp.service.replication_messages import ReplicaCommand
from proxy.wire.replication import to_wire

__all__ = ["BroadcastQueue", "Effect", "wire_of"]

DispatchEffect: TypeAlias = "Ask | DispatchStop"
Effect: TypeAlias = "DispatchEffect | ReplicaCommand"


def wire_of(part: int, effect: Effect) -> bytes:
    """Return the encoded form of an effect.

    Raises:
        LocalError: it cannot be encoded.
    """
    if isinstance(effect, Ask):
        return effect.request
    return to_wire(effect.word) if isinstance(effect, ReplicaCommand) else Stop(part, effect.calls).to_wire()


class BroadcastQueue:
    """FIFO queue of effects; a request is removed when its call ends."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[tuple[int, int], DispatchEffect] = OrderedDict()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, part: int, effect: DispatchEffect) -> None:
        """Append an effect; each call is requested once, and its end is reported once."""
        self._waiting[part, effect.call if isinstance(effect, Ask) else ~effect.calls[0]] = effect

    def poll_effect(self) -> tuple[int, DispatchEffect]:
        """Remove and return the next effect with its part number; the queue must not be empty."""
        (part, _), effect = self._waiting.popitem(last=False)
        return part, effect

    def end(self, part: int, call: int) -> None:
        """Drop the request of a call that has ended."""
        self._waiting.pop((part, call), None)

    def clear(self) -> None:
        """Drop everything."""
        self._waiting.clear()
