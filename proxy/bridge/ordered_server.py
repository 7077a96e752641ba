"""Ordered server: a local server with state, which executes one log's entries in order and exchanges snapshots.

I/O through the endpoint; ``gdp/service/follower.py`` decides. The state is a parameter of the server's node
(``state_parameter.py``), where the rule names one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, TypeAlias

from gdp.names import Name
from gdp.service.follower import Apply, Doing, Effect, Fetch, Follower, Load, Refuse, Say
from gdp.service.replication_messages import FollowerMessage, SequencerMessage
from proxy.bridge.faults import Fault
from proxy.bridge.service_flow import ServiceFlow
from proxy.bridge.state_parameter import GET, SET, read_request, state_in, was_set, write_request
from proxy.endpoints.core.endpoint import CallFailed, GraphEntity, ResponseReceived
from proxy.wire.replication import STATE_MAX_BYTES

DOUBT_S: Final = 2.0  # a server that was replaced may have executed an entry for this long before the graph shows it
AWAY_S: Final = 1.0  # a sequencer that sends nothing for this long is gone

Give: TypeAlias = Callable[[int, bytes], None]  # an entry's number here, and its request
Tell: TypeAlias = Callable[[Name, "FollowerMessage | Refuse"], None]


class OrderedServer:
    """One local server as a replica of the log; ``number``: the first request number for the local server, random."""

    def __init__(self, flow: ServiceFlow, number: int, *, give: Give, tell: Tell) -> None:
        node = flow.flow_spec.rule.state_node  # whose parameter is the server's state; None: it exports none
        self._endpoint = flow.dispatcher.endpoint
        self._follower = Follower(tells=node is not None)
        self._give, self._tell = give, tell
        self._complain = partial(flow.report, Fault.REFUSED)
        parts = () if node is None else tuple((f"{node}/{part}", type_name) for part, type_name in (GET, SET))
        self.handles = [flow.dispatcher.create_client(flow, *part) for part in parts]
        self._number = number  # of the operation under way
        self._apply: Apply | None = None
        self._given_s = -DOUBT_S
        self._heard_s = 0.0  # when the sequencer was last present
        self._keys: frozenset[str] | None = None
        self._is_closed = False

    @property
    def is_idle(self) -> bool:
        """Return whether no operation is under way."""
        return self._follower.doing is Doing.NOTHING

    def handle_message(self, client: Name, word: SequencerMessage, now_s: float) -> None:
        """Process a sequencer's message."""
        self._follower.handle_message(client, word)
        if client == self._follower.sequencer:
            self._heard_s = now_s
        self._act(now_s)

    def entry(self, client: Name, call: int, request: bytes, now_s: float) -> None:
        """Process a client's request."""
        if client == self._follower.sequencer:
            self._heard_s = now_s
        if not self._is_closed:
            self._follower.entry(client, call, request)
            self._act(now_s)

    def close(self) -> None:
        """Refuse further entries."""
        self._is_closed = True

    def done(self, event: ResponseReceived | CallFailed, now_s: float) -> Apply | None:
        """Process the end of the operation under way; return the entry, if it was one."""
        apply = None
        if event.call != self._number:
            return None
        if event.handle in self.handles:
            self._take_parameter(event)
        elif self._apply is not None:
            apply, self._apply = self._apply, None
            if isinstance(event, ResponseReceived):
                self._follower.applied()
            else:
                self._complain(f"its state is not known any more: {event.reason}")
                self._follower.failed()
        self._act(now_s)
        return apply

    def follow(self, ends: Sequence[GraphEntity], now_s: float) -> None:
        """Check whether it is still the same server; a new one has its initial state."""
        keys = frozenset(end.key for end in ends)
        if self._keys is not None and keys - self._keys:
            self._number += 1  # the previous server's operation is over
            self._apply = None
            self._follower.renewed(is_doubtful=now_s - self._given_s < DOUBT_S)
        self._keys = keys
        self._act(now_s)

    def update_sequencer(self, clients: Sequence[Name], now_s: float) -> None:
        """Accept another client as the sequencer when the present one is gone."""
        if self._follower.sequencer in clients:
            self._heard_s = now_s
        elif self._follower.sequencer is not None and now_s - self._heard_s >= AWAY_S:
            self._follower.sequencer_lost()

    def _act(self, now_s: float) -> None:
        while effects := self._follower.poll_effects():
            for effect in effects:
                self._apply_effect(effect, now_s)

    def _apply_effect(self, effect: Effect, now_s: float) -> None:
        match effect:
            case Apply():
                self._number += 1
                self._apply, self._given_s = effect, now_s
                self._give(self._number, effect.request)
            case Fetch():
                self._number += 1
                self._endpoint.call(self.handles[0], self._number, read_request())
            case Load(state):
                self._number += 1
                self._endpoint.call(self.handles[1], self._number, write_request(state))
            case Say(client, word):
                self._tell(client, word)
            case Refuse(client):
                self._tell(client, effect)

    def _take_parameter(self, event: ResponseReceived | CallFailed) -> None:
        if event.handle == self.handles[0]:
            state = state_in(event.raw) if isinstance(event, ResponseReceived) else None
            if state is None:
                self._complain("its node tells no parameter 'state' that is a byte array")
            elif len(state) > STATE_MAX_BYTES:
                self._complain(f"its state has {len(state)} bytes; at most {STATE_MAX_BYTES} can travel")
                state = None
            self._follower.receive_state(state)
        else:
            why_not = was_set(event.raw) if isinstance(event, ResponseReceived) else event.reason
            if why_not:
                self._complain(f"its node does not take on a state: {why_not}")
            self._follower.loaded(is_done=not why_not)
