"""Path pairs: the two disjoint paths that this switch uses to each other switch, kept stable while links change.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``disjoint.py`` computes the best pair. This module decides
when to follow it: a path that works is left only for a clearly better pair, and never together with the other one. So
at any time at least one copy takes a path that has not changed for ``SETTLE_S``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.control.join import ROUTE_MAX, Route, RouteLink
from gdp.names import Name
from gdp.switch.disjoint import DirectedPath
from gdp.switch.paths import Paths

SETTLE_S: Final = 2.0  # between two changes of one pair, in which the trees settle
_WORTHWHILE: Final = 0.75  # of the present cost: a dearer pair is no reason to move a path that works
_TARGETS_MAX: Final = 1_024


class PathPair(NamedTuple):
    """The routes to a switch: of the first and of the second copies."""

    first: Route
    second: Route

    @property
    def is_shared(self) -> bool:
        """Return whether both use a link, because every path needs it."""
        return bool(set(self.first) & set(self.second))


@dataclass(slots=True)
class _Held:
    """The present paths to one target: none, one (there is no other), or two."""

    paths: tuple[DirectedPath, ...] = ()
    pair: PathPair | None = None
    version: int = -1  # of the link states that it was checked with
    moved_s: float = float("-inf")
    due_s: float | None = None  # when a better pair may be followed


class PathPairs:
    """The path pairs of one switch; ``me``: this switch."""

    def __init__(self, me: Name, paths: Paths) -> None:
        self._me = me
        self._paths = paths
        self._held: dict[tuple[Name, Name], _Held] = {}

    def to(self, switch: Name, domain: Name, now_s: float) -> PathPair | None:
        """Return the pair to a switch of a domain; None: there is one path at most, or the switch is this one."""
        if switch == self._me:
            return None
        key = switch, domain
        held = self._held.get(key)
        if held is None:
            if len(self._held) >= _TARGETS_MAX:
                del self._held[next(iter(self._held))]
            held = self._held[key] = _Held()
        if held.version != self._paths.link_states.version or (held.due_s is not None and held.due_s <= now_s):
            held.version, held.due_s = self._paths.link_states.version, None
            self._renew(held, self._paths.disjoint(switch, domain), now_s)
        return held.pair

    def present(self, switch: Name, domain: Name) -> PathPair | None:
        """Return the pair that ``to`` last returned for a target, or None."""
        held = self._held.get((switch, domain))
        return None if held is None else held.pair

    def handle_timer(self, now_s: float) -> None:
        """Follow the better pairs that are due."""
        for (switch, domain), held in list(self._held.items()):
            if held.due_s is not None and held.due_s <= now_s:
                self.to(switch, domain, now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second at which a pair may change although no link has, or None."""
        return min((held.due_s for held in self._held.values() if held.due_s is not None), default=None)

    def _renew(self, held: _Held, best: tuple[DirectedPath, ...], now_s: float) -> None:
        paths = best
        if len(best) == 2 and held.paths:
            paths = self._next(held, best, now_s)
        if paths != held.paths:
            held.paths, held.moved_s = paths, now_s
            fits = len(paths) == 2 and all(len(path) <= ROUTE_MAX for path in paths)
            held.pair = PathPair(_route(paths[0]), _route(paths[1])) if fits else None

    def _next(self, held: _Held, best: tuple[DirectedPath, ...], now_s: float) -> tuple[DirectedPath, ...]:
        """Return the pair to use now: the best one, or one that shares a path with the present pair."""
        present = held.paths if len(held.paths) == 2 else (held.paths[0], ())
        works = [bool(path) and self._paths.cost_of(path) is not None for path in present]
        if not any(works):
            return best
        if all(works):
            if not self._is_better(best, present):
                return present
            if now_s < held.moved_s + SETTLE_S:
                held.due_s = held.moved_s + SETTLE_S
                return present
            kept = next((n for n in (0, 1) if present[n] in best), 0)
        else:
            kept = works.index(True)
        other = min(best, key=lambda path: (path == present[kept], len(set(path) & set(present[kept]))))
        found = (present[0], other) if kept == 0 else (other, present[1])
        if set(found) != set(best):
            held.due_s = now_s + SETTLE_S
        return found

    def _is_better(self, best: tuple[DirectedPath, ...], present: tuple[DirectedPath, ...]) -> bool:
        shared, shared_now = len(set(best[0]) & set(best[1])), len(set(present[0]) & set(present[1]))
        if shared != shared_now:
            return shared < shared_now
        cost, cost_now = (sum(self._paths.cost_of(path) or 0 for path in pair) for pair in (best, present))
        return cost < _WORTHWHILE * cost_now


def _route(path: DirectedPath) -> Route:
    return tuple(RouteLink(link.end, link.key) for link in path)
