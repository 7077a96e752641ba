"""Presence query: whether the older of two nodes with one identity is still alive.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A node that runs twice (copied keys, a cloned disk) has two
incarnations. A node that was restarted has two as well, but the older one has ended. When a RIB receives a known node's
own name in a new incarnation, from another switch, it queries the older one's switch::

    newer node --advertisement--> its switch --relay--> RIB --query--> older node's switch --the same--> older node
                                             <-IN_USE--     <--response--  (heard since: there; lost: gone)

The newer node repeats its advertisement until the older one is gone. If the older one is of another domain, only the
tier above knows of it. An advertisement that the tier above refused is forwarded to it again and again, and not
accepted here until it is accepted there.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import not_
from typing import Annotated, Final

from gdp.crypto.schema import FLAG, NAME, Body, Keyed, mapped, uint
from gdp.crypto.statements import StatementType
from gdp.intervals import REFUSED_S
from gdp.names import Name

NO_ANSWER_S: Final = 1.5  # above the time after which a switch gives up a silent neighbour
_BELIEVED_S: Final = 0.5  # an answer "is there" is valid for this time, before the switch is queried again
_CHECKS_MAX: Final = 1_024
_NOT: Final = mapped(FLAG, not_, not_)  # it travels as "is a query"


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence(Body):
    """A RIB's query about a node that is attached to a switch, or the switch's response.

    Args:
        node: the identity.
        incarnation: of the older node.
        other: the switch through which the newer node advertises.
        question: Unix milliseconds of the query; the response repeats them, so that an old one is recognised.
        is_answer: whether this is a response; then ``is_there`` holds the result.
    """

    TYPE = StatementType.PRESENCE
    node: Annotated[Name, Keyed("n", NAME)]
    incarnation: Annotated[int, Keyed("i", uint())]
    other: Annotated[Name, Keyed("w", NAME)]
    question: Annotated[int, Keyed("s", uint())]
    is_answer: Annotated[bool, Keyed("q", _NOT)] = False
    is_there: Annotated[bool, Keyed("y", FLAG)] = False


@dataclass(slots=True, kw_only=True)
class _Check:
    incarnation: int
    switch: Name
    question: int
    asked_s: float
    answer: bool | None = None
    answered_s: float = 0.0


class IdentityChecks:
    """A RIB's open presence queries, by identity; bounded.

    Attributes:
        clashes: how often a newer node was refused because the older one is there.
    """

    def __init__(self) -> None:
        self._checks: dict[Name, _Check] = {}
        self._refused_upstream: dict[Name, tuple[int, float]] = {}  # incarnation, and until when
        self.clashes = 0

    def is_free(self, node: Name, incarnation: int, switch: Name, now_s: float) -> bool:
        """Return whether the older node of this incarnation, at that switch, is gone; False while that is unknown."""
        check = self._checks.get(node)
        if check is None or (check.incarnation, check.switch) != (incarnation, switch):
            return False
        is_silent = check.answer is None and now_s >= check.asked_s + NO_ANSWER_S
        if check.answer is False or is_silent:
            del self._checks[node]
            return True
        self.clashes += check.answer is True
        return False

    def must_ask(self, node: Name, incarnation: int, switch: Name, question: int, now_s: float) -> bool:
        """Return whether the switch is to be queried now, and note the number of the query."""
        check = self._checks.get(node)
        is_same = check is not None and (check.incarnation, check.switch) == (incarnation, switch)
        if check is not None and is_same and (check.answer is None or now_s < check.answered_s + _BELIEVED_S):
            return False
        self._checks.pop(node, None)
        if len(self._checks) >= _CHECKS_MAX:
            del self._checks[next(iter(self._checks))]
        self._checks[node] = _Check(incarnation=incarnation, switch=switch, question=question, asked_s=now_s)
        return True

    def refused_above(self, node: Name, incarnation: int, now_s: float) -> None:
        """Note that the tier above knows of an older node with this identity."""
        self._refused_upstream.pop(node, None)
        if len(self._refused_upstream) >= _CHECKS_MAX:
            del self._refused_upstream[next(iter(self._refused_upstream))]
        self._refused_upstream[node] = incarnation, now_s + REFUSED_S  # it repeats its advertisement more often

    def taken_above(self, node: Name) -> None:
        """Note that the tier above accepts a node's advertisement."""
        self._refused_upstream.pop(node, None)

    def is_refused_above(self, node: Name, incarnation: int, now_s: float) -> bool:
        """Return whether a node must be accepted by the tier above first."""
        refused, until_s = self._refused_upstream.get(node, (incarnation, now_s))
        return refused == incarnation and now_s < until_s

    def answered(self, presence: Presence, switch: Name, now_s: float) -> None:
        """Process a verified response of a switch; one to no open query is ignored."""
        check = self._checks.get(presence.node)
        said = presence.incarnation, switch, presence.question
        if check is not None and (check.incarnation, check.switch, check.question) == said:
            check.answer, check.answered_s = presence.is_there, now_s
