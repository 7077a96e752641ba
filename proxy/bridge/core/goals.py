"""Goals of an action with several servers: which server is the leader of each goal.

Sans-I/O. Functions that read a message raise ``RemoteError`` (MALFORMED) where it is too short.
Source: the interfaces of ``action_msgs`` and of the hidden services of an action, in CDR. A goal's id is the first 16
bytes of its request, of its feedback, and of a request for its result. Responses begin with one byte: yes or no.

Every server executes the goal. Its client receives messages of one server at a time, the leader: the server whose
acceptance it got, until that server leaves. At last the leader is the server whose result the client got, even if
others report later that they were cancelled.

Goals that only servers name, of other machines' clients or invented, have a separate quota and evict no other goals.
When the quota is full, the oldest goal of the server that named the most is dropped.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final

from gdp.errors import DropReason, RemoteError
from gdp.names import Name
from proxy.bridge.core.action_interface import CANCEL

GOALS_MAX: Final = 1_024  # requested by clients here, and as many that only servers named
HEARTBEATS_MAX: Final = 16_384  # goals in one status message
GOAL_KEPT_MAX_BYTES: Final = 64 << 10  # larger goals are not sent again to a server that joins later
_HEAD: Final = 4  # bytes of the CDR encapsulation
_ID: Final = 16
_STAMP: Final = {order: struct.Struct(f"{order}iI") for order in "<>"}
_COUNT: Final = {order: struct.Struct(f"{order}I") for order in "<>"}
_ENTRY_MIN: Final = _ID + _STAMP["<"].size + 1
_DONE: Final = 4  # SUCCEEDED; CANCELED and ABORTED follow
_ALL: Final = bytes(_ID)


def goal_of(raw: bytes) -> bytes:
    """Return the id of the goal that a message is about."""
    if len(raw) < _HEAD + _ID:
        raise RemoteError(DropReason.MALFORMED, "a message about a goal that names none")
    return raw[_HEAD : _HEAD + _ID]


def says_yes(part: int, raw: bytes) -> bool:
    """Return whether a response is worth more than another server's: accepted, cancels, or knows the goal."""
    if len(raw) <= _HEAD:
        return True
    return (raw[_HEAD] == 0) is (part == CANCEL)


def cancel_of(goal: bytes) -> bytes:
    """Return the request that cancels one goal."""
    return b"\0\1\0\0" + goal + bytes(_STAMP["<"].size)


@dataclass(slots=True, eq=False, kw_only=True)
class _Goal:
    leader: Name | None = None
    holders: set[Name] = field(default_factory=set)
    request: bytes | None = None  # as it was sent; None: it must not be sent again
    result: int | None = None  # the status that its client got
    status: tuple[int, int, int] | None = None  # stamp and status, as the client has them
    led_by: Name | None = None  # the server that reported it
    named_by: Name | None = None  # the server that named it first; None: a client here requested it


class Goals:
    """State of an action's goals, as the clients here know it."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget every goal."""
        self._goals: dict[bytes, _Goal] = {}
        self._ours: OrderedDict[bytes, None] = OrderedDict()
        self._named: dict[Name, OrderedDict[bytes, None]] = {}  # by server
        self._named_count = 0
        self._reported = _write({})

    def sent(self, goal: bytes, request: bytes) -> None:
        """Record that a client here sends a goal; the request is kept for servers that join later."""
        self._of(goal).request = request if len(request) <= GOAL_KEPT_MAX_BYTES else None

    def holds(self, goal: bytes, servers: set[Name]) -> None:
        """Record that servers were sent a goal."""
        self._of(goal).holders |= servers

    def holders(self, goal: bytes) -> set[Name]:
        """Return the servers that were sent a goal."""
        known = self._goals.get(goal)
        return set() if known is None else set(known.holders)

    def again(self, goal: bytes) -> bytes | None:
        """Return the request of a goal, to send it to one more server; None where it must not be sent."""
        known = self._goals.get(goal)
        return None if known is None else known.request

    def accepted(self, goal: bytes, server: Name) -> None:
        """Record the server whose acceptance the client got."""
        self._of(goal).leader = server

    def cancelled(self, goal: bytes) -> None:
        """Record that a client cancels a goal, or all: no further servers get it."""
        for each in self._goals.values() if goal == _ALL else filter(None, [self._goals.get(goal)]):
            each.request = None

    def ended(self, goal: bytes, server: Name, raw: bytes) -> bytes | None:
        """Record the server whose result the client got; return the matching status message, if clients need one."""
        known = self._of(goal)
        known.request, known.leader = None, server
        known.result = raw[_HEAD] if len(raw) > _HEAD else None
        if known.result is not None and known.status is not None:
            known.status = (*known.status[:2], known.result)
        return self._news()

    def remove_server(self, server: Name) -> None:
        """Remove a server: another one becomes the leader of its goals."""
        for known in self._goals.values():
            known.holders.discard(server)
            known.led_by = None if known.led_by == server else known.led_by
            if known.leader == server and known.result is None:
                known.leader = None

    def may_feed(self, server: Name, raw: bytes) -> bool:
        """Return whether feedback is passed on to the clients."""
        return self._led(goal_of(raw), server) is not None

    def statuses(self, server: Name, raw: bytes) -> bytes | None:
        """Return the status message for the clients after a server has sent this one; None: nothing new."""
        said = _read(raw)
        for goal, known in self._goals.items():
            is_its = known.led_by == server or (known.led_by is None and known.result is None)
            if is_its and goal not in said:
                known.status = known.led_by = None  # its server has forgotten it, or has left
        for goal, status in said.items():
            led = self._led(goal, server)
            if led is not None:
                led.led_by = server
                led.status = status if led.result is None else (*status[:2], led.result)
        return self._news()

    def _led(self, goal: bytes, server: Name) -> _Goal | None:
        """Return a goal if this server is its leader; it becomes the leader if there was none."""
        known = self._goals.get(goal) or self._name(goal, server)
        if known.leader is None:
            known.leader = server
        return known if known.leader == server else None

    def _of(self, goal: bytes) -> _Goal:
        """Return a goal that a client here requested."""
        known = self._goals.setdefault(goal, _Goal())
        if goal not in self._ours:
            self._unname(goal, known)
            self._ours[goal] = None
            if len(self._ours) > GOALS_MAX:
                over = (each for each in self._ours if self._goals[each].result is not None)
                oldest = next(over, None) or next(iter(self._ours))
                del self._ours[oldest], self._goals[oldest]
        return known

    def _name(self, goal: bytes, server: Name) -> _Goal:
        """Return a new goal that no client here requested."""
        known = self._goals[goal] = _Goal(named_by=server)
        self._named.setdefault(server, OrderedDict())[goal] = None
        self._named_count += 1
        if self._named_count > GOALS_MAX:
            _, most = max(self._named.items(), key=lambda each: len(each[1]))
            oldest = next(iter(most))
            self._unname(oldest, self._goals.pop(oldest))
        return known

    def _unname(self, goal: bytes, known: _Goal) -> None:
        if known.named_by is None:
            return
        named = self._named[known.named_by]
        del named[goal]
        if not named:
            del self._named[known.named_by]
        known.named_by = None
        self._named_count -= 1

    def _news(self) -> bytes | None:
        raw = _write({goal: known.status for goal, known in self._goals.items() if known.status is not None})
        if raw == self._reported:
            return None
        self._reported = raw
        return raw


def _read(raw: bytes) -> dict[bytes, tuple[int, int, int]]:
    """Read ``action_msgs/GoalStatusArray``: id -> stamp (two numbers) and status."""
    order = "<" if raw[1:2] == b"\1" else ">"
    body, said = raw[_HEAD:], dict[bytes, tuple[int, int, int]]()
    try:
        (count,) = _COUNT[order].unpack_from(body)
        if count > HEARTBEATS_MAX:
            raise RemoteError(
                DropReason.MALFORMED, f"a status message of {count} goals; at most {HEARTBEATS_MAX} can be"
            )
        at = _COUNT[order].size
        for _ in range(min(count, len(body) // _ENTRY_MIN)):
            stamp_at = -(-(at + _ID) // 4) * 4
            said[body[at : at + _ID]] = (*_STAMP[order].unpack_from(body, stamp_at), body[stamp_at + 8])
            at = stamp_at + 9
    except (struct.error, IndexError) as error:
        raise RemoteError(DropReason.MALFORMED, "a status message that is too short") from error
    return said


def _write(statuses: dict[bytes, tuple[int, int, int]]) -> bytes:
    body = bytearray(_COUNT["<"].pack(len(statuses)))
    for goal, (seconds, nanoseconds, status) in statuses.items():
        body += goal
        body += bytes(-len(body) % 4) + _STAMP["<"].pack(seconds, nanoseconds) + bytes([status])
    return b"\0\1\0\0" + bytes(body)
