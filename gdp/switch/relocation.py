"""Relocation of nodes between switches: the former switch forwards frames and redirects senders to the new one.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source, in spirit: the binding update of RFC 6275 (section
11.7) and the fast neighbour advertisement of RFC 5568; the context transfer of RFC 4067; the ICMP redirect of RFC 1122
(section 3.2.2.2). No RIB takes part, so it works while none responds.

::

    node --advertisement (previous: old)--> new switch --RELOCATE (the advertisement, relayed)--> old switch
    old switch --RIB_ANSWER (received; the names that the node reads)--> new switch
    neighbour --frame for the node--> old switch --frame--> new switch
    neighbour <--REDIRECT (the same relay)-- old switch
    neighbour <--WHERE, while no RIB responds-- switch that got its frame for a node it does not know

An advertisement proves itself and names the new switch, so the old switch and its neighbours need not trust the sender.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.control.rib_statements import Query, relayed
from gdp.frame.codec import Kind
from gdp.intervals import PACE_S
from gdp.names import ZERO, Name
from gdp.requests import Backoff, Requests
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.multicast import MulticastTrees
from gdp.switch.name_cache import Location
from gdp.switch.unicast import Unicast
from gdp.trust.advertisement import Advertisement

GRACE_S: Final = 4.0  # for which the former switch handles frames for a moved node, redirects senders, and responds
_REMEMBERED_MAX: Final = 4_096
_NOTICES: Final = Backoff(0.1, 0.8)  # until the former switch answers; one datagram may be lost
_NOTICE_TRIES: Final = 5

_Key = tuple[Name, Name]  # name and advertiser


@dataclass(slots=True)
class _Notice:
    to: Name
    statement: bytes
    sequence: int


@dataclass(slots=True)
class _Moved:
    statement: bytes  # proof of the new location
    until_s: float


class Relocations:
    """Handles the nodes of one switch that came from, or went to, another switch.

    Attributes:
        moved_names: that went to another switch, and until when frames for them are redirected.
    """

    def __init__(self, state: ForwardingState, multicast: MulticastTrees, unicast: Unicast) -> None:
        self._state = state
        self._multicast = multicast
        self._unicast = unicast
        self._notices: OrderedDict[_Key, _Notice] = OrderedDict()
        self._requests = Requests[_Key]()
        self._former: OrderedDict[Name, float] = OrderedDict()  # switches whose responses are accepted, until when
        self._moved: OrderedDict[_Key, _Moved] = OrderedDict()
        self.moved_names: dict[Name, float] = {}
        self._said: OrderedDict[tuple[Name, int, bytes], float] = OrderedDict()

    def arrived(self, advertisement: Advertisement, now_s: float) -> None:
        """Notify the former switch of a node that advertises a name here."""
        if advertisement.previous in (ZERO, self._state.me):
            return
        statement = relayed(advertisement.wire, self._state.identity, self._state.policy.transit)
        key = advertisement.name, advertisement.node
        _remember(self._notices, key, _Notice(advertisement.previous, statement, advertisement.sequence))
        self._requests.start(key, now_s)
        _remember(self._former, advertisement.previous, now_s + GRACE_S)
        self.handle_timer(now_s)

    def acknowledged(self, name: Name, advertiser: Name, sequence: int) -> None:
        """Record that the former switch has the advertisement with this ``sequence``."""
        key = name, advertiser
        notice = self._notices.get(key)
        if notice is not None and sequence >= notice.sequence:
            self._forget(key)

    def is_former(self, switch: Name, now_s: float) -> bool:
        """Return whether a switch was recently notified as a former one, so that its response counts."""
        return self._former.get(switch, 0.0) > now_s

    def moved(self, location: Location, statement: bytes, now_s: float) -> None:
        """Record the new location of a node; redirect the switches that take its topic from here."""
        until_s = now_s + GRACE_S
        _remember(self._moved, (location.name, location.advertiser), _Moved(statement, until_s))
        if len(self.moved_names) > 2 * _REMEMBERED_MAX:
            self.moved_names = {name: end_s for name, end_s in self.moved_names.items() if end_s > now_s}
        self.moved_names[location.name] = until_s
        for at in self._multicast.below(location.name, location.advertiser):
            self._state.outbox.say_at(*at, Kind.REDIRECT, statement)

    def frame_came(self, destination: Name, neighbour: Neighbour, now_s: float) -> None:
        """Redirect the neighbour that sent a frame here for a node that has moved.

        For ``GRACE_S`` no table entry exists for such a node, so that each of its frames is punted here.
        """
        if self.moved_names.get(destination, 0.0) <= now_s:
            return
        self._unicast.remove(destination)
        if not neighbour.role.is_switch:
            return
        for (name, _), moved in self._moved.items():
            if name == destination and moved.until_s > now_s:
                self._redirect(neighbour, name, moved.statement, now_s)

    def redirect_join(self, name: Name, advertiser: Name, neighbour: Neighbour, now_s: float) -> None:
        """Redirect the neighbour that joins a publisher at its former location."""
        moved = self._moved.get((name, advertiser))
        if moved is not None and moved.until_s > now_s:
            self._redirect(neighbour, name, moved.statement, now_s)

    def ask_neighbour(self, name: Name, neighbour: Neighbour, now_s: float) -> None:
        """Request a node's location from the neighbour that sent a frame for it.

        No RIB responds, and the neighbour must have had the location to send the frame.
        """
        if neighbour.role.is_switch and self._may_say(name, neighbour, now_s):
            self._state.outbox.send_to_neighbour(neighbour, Kind.WHERE, self._state.identity.signed(Query(name, 0.0)))

    def handle_timer(self, now_s: float) -> None:
        """Send the notices that are due."""
        for key in self._requests.poll_due(now_s):
            notice = self._notices.get(key)  # None: too many were newer
            if notice is not None and self._requests.tries(key) < _NOTICE_TRIES:
                self._unicast.send_statement(Kind.RELOCATE, notice.statement, notice.to, now_s)
                self._requests.sent(key, now_s, _NOTICES)
            else:
                self._forget(key)

    def _forget(self, key: _Key) -> None:
        self._notices.pop(key, None)
        self._requests.cancel(key)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next notice, or None."""
        return self._requests.next_due()

    def _redirect(self, neighbour: Neighbour, name: Name, statement: bytes, now_s: float) -> None:
        if self._may_say(name, neighbour, now_s):
            self._state.outbox.send_to_neighbour(neighbour, Kind.REDIRECT, statement)

    def _may_say(self, name: Name, neighbour: Neighbour, now_s: float) -> bool:
        """Return whether a message to a neighbour about a name is allowed now, and record it as sent."""
        key = (name, neighbour.port, neighbour.mac)
        if now_s - self._said.get(key, float("-inf")) < PACE_S:
            return False
        _remember(self._said, key, now_s)
        return True


def _remember(memory: OrderedDict, key: object, value: object) -> None:  # type: ignore[type-arg]
    """Store a value as the newest; the oldest is removed when the memory is full."""
    memory[key] = value
    memory.move_to_end(key)
    if len(memory) > _REMEMBERED_MAX:
        memory.popitem(last=False)
