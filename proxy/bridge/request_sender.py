"""Sender of the requests of one imported service, to all remote servers or to some.

I/O through the overlay's participant and publisher.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import TypeAlias

from gdp.client.publisher import Publisher
from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.dispatch import Ask, Dispatch, End, Probe
from gdp.service.dispatch import Stop as DispatchStop
from gdp.service.frames import Stop
from gdp.service.replication_messages import ReplicaCommand
from proxy.bridge.core.action_interface import CANCEL, RESULT
from proxy.bridge.core.goals import Goals
from proxy.bridge.server_discovery import ServerCalls
from proxy.bridge.service_flow import ServiceFlow
from proxy.wire.replication import to_wire

DispatchEffect: TypeAlias = "Ask | DispatchStop"
Effect: TypeAlias = "DispatchEffect | ReplicaCommand"


def wire_of(part: int, effect: Effect) -> bytes:
    """Return the encoded form of an effect. Raises ``LocalError``: it cannot be encoded."""
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


class RequestSender:
    """Sends the effects of the calls of each part; effects for all servers wait for capacity of their common stream.

    Attributes:
        publisher: the stream that all servers receive; None while the service is not joined.
    """

    def __init__(self, flow: ServiceFlow, calls: Sequence[ServerCalls], goals: Goals | None) -> None:
        self._flow = flow
        self._calls = calls
        self._goals = goals
        self.publisher: Publisher | None = None
        self._for_all = BroadcastQueue()
        self._goal_of: dict[tuple[int, int], bytes] = {}  # part and call -> goal, while under way

    @property
    def is_ready(self) -> bool:
        """Return whether a waiting effect can be sent now."""
        return bool(self._for_all) and self.publisher is not None and self.publisher.has_space()

    def note_goal(self, part: int, call: int, goal: bytes) -> None:
        """Record the goal of a call."""
        self._goal_of[part, call] = goal

    def discard(self, part: int, call: int, *, is_cancelled: bool) -> None:
        """Forget a call that has ended; ``is_cancelled``: its request must not be sent any more."""
        self._goal_of.pop((part, call), None)
        if is_cancelled:
            self._for_all.end(part, call)

    def clear(self) -> None:
        """Drop waiting effects."""
        self._for_all.clear()

    def flush(self, now_s: float) -> None:
        """Send decided effects, as far as the stream has capacity."""
        for part, dispatch in enumerate(self._calls):
            while effects := dispatch.poll_effects():
                for effect in effects:
                    if isinstance(effect, End):
                        self._flow.context.member.services.end_call(self._flow.name, (part, effect.call))
                        continue
                    if isinstance(effect, Probe):
                        self._flow.context.member.services.probe(self._flow.name, effect.server)
                        continue
                    whom = effect.servers if isinstance(effect, Ask) else effect.server and (effect.server,)
                    if whom is None and not isinstance(effect, ReplicaCommand):
                        self._for_all.add(part, effect)
                    for server in whom or ():
                        self._send_to(server, part, effect, now_s)
        while self.is_ready:
            self._send_to_all(*self._for_all.poll_effect(), now_s)

    def _send_to_all(self, part: int, effect: Effect, now_s: float) -> None:
        servers = self._calls[part].servers
        if isinstance(effect, Ask):
            if effect.call not in self._calls[part]:
                return  # of a log that has ended
            self._record_holders(part, effect.call, set(servers))
        try:
            wire = wire_of(part, effect)
            call = self._key_of(part, effect)
            if call is not None:
                self._flow.context.member.services.send_requests(self._flow.name, wire, call)
            elif self.publisher is not None:
                self.publisher.publish(wire)
            self._flow.context.traffic.sent(len(wire))
            self._trace(part, effect, servers)
        except LocalError as error:
            self._refuse(part, effect, servers, str(error), now_s)

    def _send_to(self, server: Name, part: int, effect: Effect, now_s: float) -> None:
        again = None
        if isinstance(effect, Ask) and self._goals is not None:
            goal = self._goal_of.get((part, effect.call), b"")
            if part == RESULT and server not in self._goals.holders(goal):
                again = self._goals.again(goal)  # a server that joined later executes the goal as well
            self._record_holders(part, effect.call, {server})
        try:
            for wire in (*([] if again is None else [again]), wire_of(part, effect)):
                self._flow.context.member.services.send_request(
                    self._flow.name, server, wire, self._key_of(part, effect)
                )
                self._flow.context.traffic.sent(len(wire))
            self._trace(part, effect, [server])
        except LocalError as error:
            self._refuse(part, effect, [server], str(error), now_s)

    def _key_of(self, part: int, effect: Effect) -> tuple[int, int] | None:
        """Return what cancels a request when its call ends; None: goals and entries of a log depend on their order."""
        is_free = self._goals is None and isinstance(self._calls[part], Dispatch)
        return (part, effect.call) if isinstance(effect, Ask) and is_free else None

    def _trace(self, part: int, effect: Effect, servers: list[Name]) -> None:
        if isinstance(effect, Ask):
            self._flow.context.tracer.asked(self._flow.own_key(part, effect.call), servers)

    def _refuse(self, part: int, effect: Effect, servers: list[Name], reason: str, now_s: float) -> None:
        self._flow.context.traffic.unread += 1
        if isinstance(effect, Ask):
            for server in servers:
                self._calls[part].refused(effect.call, server, reason, now_s)

    def _record_holders(self, part: int, call: int, servers: set[Name]) -> None:
        if self._goals is not None and part != CANCEL:
            self._goals.holds(self._goal_of[part, call], servers)
