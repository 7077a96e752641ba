"""Joins of a switch: sends those of its trees, renews them by number, and finds the branches that a number renews here.

Sans-I/O. Source of the refreshes: RFC 2961, section 5 (``gdp/control/join.py``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final, NamedTuple

from gdp.control.join import NUMBERS_MAX, Join, JoinRefresh, Route
from gdp.frame.codec import Kind
from gdp.intervals import JOIN
from gdp.names import ZERO, Name
from gdp.requests import Backoff
from gdp.sansio import OutgoingFrames
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.trees import Downstream, JoinTerms, SentJoin, Tree, TreeKey

_SPACED: Final = Backoff(0.008, 0.064)  # 0.2 Mbit/s is a full frame in 0.06 s


class _SpacedFrame(NamedTuple):
    """A frame of a join that waits, and how long the next one waits after it."""

    tree: TreeKey
    number: int
    frame: bytes
    pause_s: float


class JoinSender:
    """Sends the joins and leaves of a switch's trees.

    Refreshes are collected until ``handle_timer``. A reply about unknown numbers has an effect once for each refresh,
    and on numbers of that refresh only.

    A join has three frames, which leave together. Where the queue of the link holds fewer, it would never arrive.
    So the frames of a join that a neighbour did not know leave one by one, the next time with longer pauses.

    Args:
        sequence: of the last statement of an earlier incarnation, at least.
    """

    def __init__(self, state: ForwardingState, sequence: int) -> None:
        self._state = state
        self._sequence = sequence
        self._waiting: dict[tuple[Downstream, Name], dict[int, TreeKey]] = {}
        self._refreshed: dict[Downstream, dict[int, TreeKey]] = {}
        self._spaced: dict[Downstream, deque[_SpacedFrame]] = {}
        self._free_s: dict[Downstream, float] = {}  # the next spaced frame to a neighbour leaves no earlier

    def get_timer(self) -> float:
        """Return the monotonic second at which something is to be sent."""
        spaced_s = [self._free_s.get(at, 0.0) for at in self._spaced]
        return 0.0 if self._waiting else min(spaced_s, default=float("inf"))

    def handle_timer(self, now_s: float) -> None:
        """Send the refreshes, and the frames whose time has come."""
        self._send_refreshes()
        for at in list(self._spaced):
            self._send_spaced(at, now_s)

    def terms(
        self, tree: Tree, at: Downstream, name: Name, mtu: int, backup_for: Name = ZERO, route: Route = ()
    ) -> JoinTerms | None:
        """Return what a join to a neighbour would ask for, or None if that is not up."""
        sessions = self._state.neighbours.sessions_with(at[0], name)
        if sessions is None:
            return None
        return JoinTerms(sessions, tree.switch, tree.domain, tree.allowed, mtu, backup_for, route, tree.pace)

    def send_join(self, tree: Tree, at: Downstream, name: Name, terms: JoinTerms | None, evidence: bytes) -> None:
        """Send a whole join to a neighbour; none to one that is not up."""
        if terms is None:
            tree.sent.pop(at, None)  # it is gone, and so is its state of our joins
            return
        wire = self._wire(tree, terms, JOIN.lease_s, evidence)
        tree.sent[at] = SentJoin(self._sequence, name, terms)
        if not tree.unknown:
            self._state.outbox.say_at(*at, Kind.JOIN, wire)
            return
        pause_s = _SPACED.pause_s(tree.unknown)
        frames = self._state.outbox.frames_of(at[0], Kind.JOIN, wire)
        spaced = self._spaced.setdefault(at, deque())
        spaced.extend(_SpacedFrame(tree.identity, self._sequence, frame, pause_s) for frame in frames)

    def add_renewal(self, tree: Tree, at: Downstream, terms: JoinTerms | None) -> bool:
        """Put the number of a join into the next refresh, if the join has these terms; return whether it has."""
        sent = tree.sent.get(at)
        if sent is None or sent.terms != terms:
            return False
        if any(each.number == sent.number for each in self._spaced.get(at, ())):
            return True  # it has not left yet
        self._waiting.setdefault((at, sent.name), {})[sent.number] = tree.identity
        return True

    def send_leave(self, tree: Tree, at: Downstream, name: Name) -> None:
        """Send a leave to a neighbour."""
        tree.sent.pop(at, None)
        terms = self.terms(tree, at, name, 1)
        if terms is not None:
            self._state.outbox.say_at(*at, Kind.LEAVE, self._wire(tree, terms, 0.0, b""))

    def _send_refreshes(self) -> None:
        waiting, self._waiting = self._waiting, {}
        for (at, name), numbers in waiting.items():
            known = self._refreshed.get(at, {})
            kept = {number: key for number, key in known.items() if self._is_standing(key, at, number)}
            self._refreshed[at] = kept | numbers
            listed = tuple(numbers)
            for first in range(0, len(listed), NUMBERS_MAX):
                self._say_numbers(at, name, listed[first : first + NUMBERS_MAX], is_reply=False)

    def send_unknown(self, at: Downstream, name: Name, unknown: tuple[int, ...]) -> None:
        """Tell a neighbour which of its joins are unknown here."""
        self._say_numbers(at, name, unknown, is_reply=True)

    def find_unknown(self, at: Downstream, numbers: Iterable[int]) -> list[Tree]:
        """Return the trees of refreshed joins that a neighbour does not know."""
        refreshed, found = self._refreshed.get(at, {}), []
        for number in numbers:
            key = refreshed.pop(number, None)
            if key is not None and self._is_standing(key, at, number):
                tree = self._state.trees.get(*key)
                assert tree is not None
                found.append(tree)
        return found

    def neighbour_lost(self, at: Downstream) -> None:
        """Forget the refreshes to a neighbour, and what waits for it."""
        self._refreshed.pop(at, None)
        self._spaced.pop(at, None)
        self._free_s.pop(at, None)

    def _is_standing(self, key: TreeKey, at: Downstream, number: int) -> bool:
        tree = self._state.trees.peek(key)
        join = None if tree is None else tree.sent.get(at)
        return join is not None and join.number == number

    def _send_spaced(self, at: Downstream, now_s: float) -> None:
        spaced = self._spaced[at]
        while spaced and self._free_s.get(at, 0.0) <= now_s:
            each = spaced.popleft()
            if self._is_standing(each.tree, at, each.number):
                self._state.outbox.waiting.append(OutgoingFrames(*at, [each.frame]))
                self._free_s[at] = now_s + each.pause_s
        if not spaced:
            del self._spaced[at]

    def _wire(self, tree: Tree, terms: JoinTerms, lease_s: float, evidence: bytes) -> bytes:
        own_session, its_echo = terms.sessions
        self._sequence += 1
        join = Join(
            topic=tree.topic,
            publisher=tree.publisher,
            switch=terms.switch,
            domain=terms.domain,
            allowed=terms.allowed,
            mtu=terms.mtu,
            lease_s=lease_s,
            evidence=evidence,
            session=its_echo,
            sequence=self._sequence,
            version=tree.version,
            backup_for=terms.backup_for,
            sender_session=own_session,
            proof=tree.proof if lease_s else b"",
            path=tree.path,
            route=terms.route,
            pace=terms.pace,
        )
        return join.to_wire(self._state.me, self._state.identity.key)

    def _say_numbers(self, at: Downstream, name: Name, numbers: tuple[int, ...], *, is_reply: bool) -> None:
        sessions = self._state.neighbours.sessions_with(at[0], name)
        if sessions is None:
            return
        own_session, its_echo = sessions
        self._sequence += 1
        refresh = JoinRefresh(
            numbers=numbers,
            session=its_echo,
            sender_session=own_session,
            sequence=self._sequence,
            is_reply=is_reply,
        )
        wire = refresh.to_wire(self._state.me, self._state.identity.key)
        self._state.outbox.say_at(*at, Kind.JOIN_REFRESH, wire)


class ReceivedJoins:
    """Trees of the joins that neighbours have sent, by neighbour and number."""

    def __init__(self) -> None:
        self._trees: dict[Downstream, dict[int, TreeKey]] = {}

    def put(self, at: Downstream, number: int, tree: Tree) -> None:
        """Add a join."""
        self._trees.setdefault(at, {})[number] = tree.identity

    def remove(self, at: Downstream, number: int) -> None:
        """Remove a join, if it is there."""
        numbers = self._trees.get(at, {})
        numbers.pop(number, None)
        if not numbers:
            self._trees.pop(at, None)

    def get(self, at: Downstream, number: int) -> TreeKey | None:
        """Return the tree of a join, or None."""
        return self._trees.get(at, {}).get(number)
