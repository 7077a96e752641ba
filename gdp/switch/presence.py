"""Presence answers: a switch reports to RIBs whether an attached node is still there.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A node is there when it has sent a sign of life since the
question came, and gone when it is no neighbour any more. One of the two comes within the dead-neighbour interval.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from gdp.control.presence import Presence
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.unicast import Unicast

_OPEN_MAX: Final = 256


@dataclass(frozen=True, slots=True)
class _Question:
    presence: Presence
    rib: Name
    asked_s: float


class PresenceAnswers:
    """Open questions of RIBs about attached nodes; ``open``: by the node that each is about."""

    def __init__(self, state: ForwardingState, unicast: Unicast) -> None:
        self._state = state
        self._unicast = unicast
        self.open: dict[Name, _Question] = {}

    def handle_question(self, presence: Presence, rib: Name, wire: bytes, now_s: float) -> None:
        """Handle a RIB's verified question; the node receives it, too, if it is there."""
        if len(self.open) >= _OPEN_MAX and presence.node not in self.open:
            return  # the RIB repeats its question
        self.open[presence.node] = _Question(presence, rib, now_s)
        held = self._state.attached.get(presence.node, presence.node)
        if held is not None and held.advertisement.incarnation == presence.incarnation:
            self._state.outbox.say_at(held.port, held.mac, Kind.ADVERTISE_ACK, wire)
        self.answer(now_s)

    def answer(self, now_s: float) -> None:
        """Answer the questions that can be answered; cheap when none is open."""
        for question in list(self.open.values()):
            is_there = self._is_there(question)
            if is_there is not None:
                del self.open[question.presence.node]
                answer = replace(question.presence, is_answer=True, is_there=is_there)
                wire = self._state.identity.signed(answer)
                self._unicast.send_statement(Kind.RIB_REQUEST, wire, question.rib, now_s)

    def _is_there(self, question: _Question) -> bool | None:
        """Return whether the node is there; None while that is not known."""
        node = question.presence.node
        held = self._state.attached.get(node, node)
        if held is None or held.advertisement.incarnation != question.presence.incarnation:
            return False
        neighbour = self._state.neighbours.get(held.port, node)
        if neighbour is None:
            return False
        return True if neighbour.heard_s > question.asked_s else None
