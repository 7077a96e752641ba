"""Identity conflicts: two nodes with one identity (copied keys, a cloned disk), as a neighbour of both sees them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A node states in its hellos when its incarnation began. Of two
live incarnations of one identity, the older one stays; hellos of the newer one are refused. Both are notified: for
``_CLASH_S`` after the last refusal, hellos name both sessions (``Hello.rivals``). A node that finds its own
session there, but not in ``Hello.heard``, is the refused one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeVar

from gdp.control.hello import echo_of
from gdp.names import Name

_CLASH_S: Final = 3.0  # another node must have our identity for this time, and is reported for as long
_CLASH_PAUSE_S: Final = 10.0  # above the time between two idle hellos
_K = TypeVar("_K")
_V = TypeVar("_V")
_CONFLICTS_MAX: Final = 64  # sessions, and identities; the one named first is evicted


@dataclass(slots=True)
class _Session:
    name: Name
    until_s: float


@dataclass(slots=True)
class _Refused:
    incarnation_id: bytes
    until_s: float


class IdentityConflicts:
    """Sessions at this node's ports whose identity another node has, too.

    Attributes:
        refusals: hellos that were refused because an older node has their identity.
        changes: how often an identity became refused, or was cleared because the same node was accepted.
        clashes: how often we received notice of another node with our own identity.
        clash_reporter: the node that reported it last.
    """

    def __init__(self) -> None:
        self._sessions: dict[tuple[int, bytes], _Session] = {}
        self._refused: dict[Name, _Refused] = {}
        self.refusals = 0
        self.changes = 0
        self.clashes = 0
        self.clash_reporter: Name | None = None
        self._clash_since_s = self._clash_s = float("-inf")

    def record_refusal(self, name: Name, incarnation_id: bytes, now_s: float) -> None:
        """Note that a hello was refused."""
        self.refusals += 1
        known = self._refused.get(name)
        self.changes += known is None or known.until_s <= now_s
        _put(self._refused, name, _Refused(incarnation_id, now_s + _CLASH_S))

    def accept(self, name: Name, incarnation_id: bytes) -> None:
        """Note that a hello was accepted.

        If it was refused before, the older incarnation was already dead, but that was not known yet.
        """
        known = self._refused.get(name)
        if known is not None and known.incarnation_id == incarnation_id:
            del self._refused[name]
            self.changes += 1

    def schedule_notice(self, port: int, nonce: bytes, name: Name, now_s: float) -> bool:
        """Schedule the notice of a conflict for a session; return whether it is new for the session."""
        known = self._sessions.get((port, nonce))
        _put(self._sessions, (port, nonce), _Session(name, now_s + _CLASH_S))
        return known is None or known.until_s <= now_s

    def on(self, port: int, now_s: float) -> tuple[bytes, ...]:
        """Return the echoes of the sessions at a port that have rivals."""
        if not self._sessions:
            return ()
        self._sessions = {key: each for key, each in self._sessions.items() if each.until_s > now_s}
        return tuple(echo_of(nonce, each.name) for (its, nonce), each in self._sessions.items() if its == port)

    def refused(self, now_s: float) -> list[Name]:
        """Return the identities of which a hello was refused lately."""
        if not self._refused:
            return []
        self._refused = {name: each for name, each in self._refused.items() if each.until_s > now_s}
        return sorted(self._refused)

    def record_clash(self, reporter: Name, now_s: float, *, is_proven: bool = False) -> None:
        """Note that another node has our own identity.

        Args:
            is_proven: it counts at once; else when it lasts, because an earlier incarnation of ours may linger.
        """
        if now_s > self._clash_s + _CLASH_PAUSE_S:
            self._clash_since_s = now_s
        self._clash_s = now_s
        if is_proven or now_s >= self._clash_since_s + _CLASH_S:
            self.clashes += 1
            self.clash_reporter = reporter

    def next_expiry(self) -> float | None:
        """Return the monotonic second at which ``refused`` changes by itself, or None."""
        return min((each.until_s for each in self._refused.values()), default=None)


def _put(held: dict[_K, _V], key: _K, value: _V) -> None:
    held.pop(key, None)
    if len(held) >= _CONFLICTS_MAX:
        del held[next(iter(held))]
    held[key] = value
