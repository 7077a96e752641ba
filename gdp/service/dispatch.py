"""Dispatch of requests to several servers: which servers to ask, which response counts, which servers to stop.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds); ``poll_effects`` returns what to send. Source: FogROS2-FT: all
replicas are asked and the first response wins; hedging after "The Tail at Scale" (2013).

A call under way has sent its request to some servers, which owe it a response; others refused or declined. It ends
once::

    first valid response of a server that owes one  ->  answered;  after GATHER_S the servers still owing get a stop
    its timeout passes                              ->  failed (or answered with the best response that declined)
    no server owes one, and no server is left       ->  likewise

When a server that owes a response refuses, declines or goes, the next untried server is asked at once. With
``Mode.NEAREST`` also when it falls silent (``nearest.py``), and only while no other one owes a response.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, Generic, NamedTuple, TypeAlias, TypeVar

from gdp.due_queue import DueQueue, earliest
from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.budget import HedgeBudget
from gdp.service.calls import Calls
from gdp.service.latency import Latencies
from gdp.service.nearest import NearestServers, ServerPaths
from gdp.service.replication import ALL, Mode, Replication

A = TypeVar("A")

CALLS_MAX: Final = 65_536  # under way at once
# of their requests, kept for servers that are asked later; the last request may exceed it
HELD_MAX_BYTES: Final = 128 << 20
GATHER_S: Final = 0.004  # servers that respond so soon after the first need no stop
STOP_MAX: Final = 1_024  # calls in one stop message
HEDGE_PERCENTILE: Final = 0.95  # of recent response times, after which a second copy may be sent
# multiple of that wait, where a small budget is better spent on the slowest few
HEDGE_LATER_MAX: Final = 4.0
HEDGE_FIRST_S: Final = 0.05  # while there are too few response times
_HEDGE_MIN_S: Final = 0.0005


class Failure(Enum):
    """Why a call ended without a response."""

    TIMED_OUT = "timed out"
    NO_SERVER = "no server"
    REFUSED = "refused by all"


class Ask(NamedTuple):
    """Send a request to these servers; None: to all, by the tree."""

    call: int
    request: bytes
    servers: tuple[Name, ...] | None


class Probe(NamedTuple):
    """Have a server report: it owes a response."""

    server: Name


class Stop(NamedTuple):
    """Tell servers to stop ended calls; None: all servers, by the tree."""

    calls: tuple[int, ...]
    server: Name | None


class End(NamedTuple):
    """A call has ended: cancel what is still under way of its request."""

    call: int


Effect: TypeAlias = "Ask | Probe | Stop | End"


@dataclass(slots=True, eq=False, kw_only=True)
class _Call(Generic[A]):
    answered: Callable[[A], None]
    failed: Callable[[Failure, str], None]
    begun_s: float
    request: bytes = b""
    is_watched: bool = False  # the next server is asked when those that owe a response are silent
    owing: dict[Name, float] = field(default_factory=dict)  # and since when
    tried: set[Name] = field(default_factory=set)  # every server that was asked, still there or not
    refused: set[Name] = field(default_factory=set)
    declined: list[A] = field(default_factory=list)  # responses that decline, used if no server does better


class _Ended(NamedTuple):
    stop_at_s: float
    owing: dict[Name, float]


class Dispatch(Generic[A]):
    """The calls of one service from this client.

    Args:
        start: the first call's number, random in 64 bits.
        stops: whether servers that still owe a response receive a stop when a call has ended.
        unicasts: a request to all servers goes to a server by its own stream while it is the only one.
        paths: to the servers, with ``Mode.NEAREST``; None with the others.

    Attributes:
        late: responses that came for a call that had ended.
        unexpected: responses of servers that were not asked, or that refused or declined before.
        held_bytes: the bytes that the requests of calls under way use.
    """

    def __init__(
        self,
        replication: Replication = ALL,
        *,
        start: int,
        stops: bool = True,
        unicasts: bool = False,
        paths: ServerPaths | None = None,
        calls_max: int = CALLS_MAX,
        held_max_bytes: int = HELD_MAX_BYTES,
    ) -> None:
        self._replication = replication
        self._stops = stops
        self._unicasts = unicasts
        self._calls: Calls[_Call[A]] = Calls(calls_max, start)
        self._held_max_bytes = held_max_bytes
        self.held_bytes = 0
        self._servers: dict[Name, bool] = {}  # whether it is leaving
        self._latencies = Latencies()
        self._nearest = None if paths is None else NearestServers(paths)
        self._budget = HedgeBudget(replication.budget)
        self._hedges = DueQueue[int]()
        self._late: dict[int, None] = {}  # calls whose second copy waits for the budget, the oldest first
        self._ended: dict[int, _Ended] = {}  # in the order of their end
        self._effects: list[Effect] = []
        self.late = 0
        self.unexpected = 0
        self.hedged = 0

    def __len__(self) -> int:
        return len(self._calls)

    def __contains__(self, number: int) -> bool:
        return number in self._calls

    @property
    def servers(self) -> list[Name]:
        """Return the servers that are there, leaving ones included."""
        return list(self._servers)

    def ranking(self, now_s: float) -> list[tuple[Name, int, bool]]:
        """Return the servers with ``Mode.NEAREST``, the one that is asked first: cost, and whether it is silent."""
        if (nearest := self._nearest) is None:
            return []
        ranked = self._ranked(self._servers, now_s)
        return [(server, nearest.cost(server), nearest.is_silent(server)) for server in ranked]

    def begin(
        self,
        now_s: float,
        write: Callable[[int], bytes],
        timeout_s: float | None,
        answered: Callable[[A], None],
        failed: Callable[[Failure, str], None],
        first: Sequence[Name] = (),
    ) -> int:
        """Begin a call and return its number; one of the callbacks is called, once, and never from here.

        Args:
            write: returns the request under its number; not called where ``begin`` raises.
            timeout_s: how long it may take; None: no limit.
            answered: called with the first valid response.
            failed: called with the failure, and the last server's reason.
            first: servers to ask at first, instead of those that the replication selects.

        Raises:
            LocalError: there is no server, or too much is under way.
        """
        chosen = [server for server in first if server in self._servers]
        if not self._servers:
            raise LocalError("no server is there")
        if self.held_bytes >= self._held_max_bytes:
            raise LocalError(f"requests of {self.held_bytes} bytes are under way: no more at once")
        is_watched = self._nearest is not None and not chosen
        call = _Call(answered=answered, failed=failed, begun_s=now_s, is_watched=is_watched)
        number = self._calls.add_call(now_s, timeout_s, call)
        call.request = write(number)
        self.held_bytes += len(call.request)
        self._budget.earn()
        mode = self._replication.mode
        if mode is Mode.ALL and not chosen and not (self._unicasts and len(self._servers) == 1):
            call.owing = dict.fromkeys(self._servers, now_s)
            call.tried.update(self._servers)
            self._effects.append(Ask(number, call.request, None))
        else:
            copies = self._replication.copies if mode is Mode.SOME else 1
            self._ask(number, call, chosen or self._untried(call, now_s)[:copies], now_s)
        if mode is Mode.HEDGED and not chosen:
            self._hedges.put(number, now_s + self._hedge_after_s())
        self._hedge(now_s)
        return number

    def replica_joined(self, server: Name, now_s: float) -> None:
        """Add a server; where all are asked, it also receives the calls under way that it has not received yet."""
        if server in self._servers:
            self._servers[server] = False
            return
        self._servers[server] = False
        if self._replication.mode is Mode.ALL:
            for number, call in self._calls:
                if server not in call.tried:
                    self._ask(number, call, [server], now_s)

    def replica_leaving(self, server: Name) -> None:
        """Record that a server goes soon: it is asked only where no other is left, and its responses count."""
        if server in self._servers:
            self._servers[server] = True

    def replica_lost(self, server: Name, now_s: float, reason: str) -> None:
        """Remove a server that is gone, or no longer confirms."""
        if self._servers.pop(server, None) is None:
            return
        self._latencies.forget(server)
        if self._nearest is not None:
            self._nearest.forget(server)
        for ended in self._ended.values():
            ended.owing.pop(server, None)
        for number, call in self._calls:
            call.refused.discard(server)
            if call.owing.pop(server, None) is not None:
                self._go_on(number, call, Failure.NO_SERVER, reason, now_s)

    def answered(self, number: int, server: Name, answer: A, now_s: float) -> None:
        """Handle a valid response."""
        call = self._remove_owed(number, server, now_s)
        if call is None:
            return
        self._latencies.ended(now_s - call.begun_s)
        self._calls.end(number)
        self._release(number, call)
        if call.owing and self._stops:
            self._ended[number] = _Ended(now_s + GATHER_S, call.owing)
        call.answered(answer)

    def refused(self, number: int, server: Name, reason: str, now_s: float) -> None:
        """Handle a server's refusal: it has no response."""
        call = self._remove_owed(number, server, now_s, says_no=True)
        if call is not None:
            call.refused.add(server)
            self._go_on(number, call, Failure.REFUSED, reason, now_s)

    def declined(self, number: int, server: Name, answer: A, now_s: float) -> None:
        """Handle a response that declines: it counts if no server gives a better one."""
        call = self._remove_owed(number, server, now_s, says_no=True)
        if call is not None:
            call.refused.add(server)
            call.declined.append(answer)
            self._go_on(number, call, Failure.REFUSED, "", now_s)

    def handle_timer(self, now_s: float) -> None:
        """Run the timers that are due."""
        for number, call in self._calls.expired(now_s):
            self._fail(number, call, Failure.TIMED_OUT, "")
        self._late |= dict.fromkeys(self._hedges.poll_due(now_s))
        self._hedge(now_s)
        self._look_at_owing(now_s)
        self._tell_stops(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        stop_at_s = next(iter(self._ended.values())).stop_at_s if self._ended else None
        look_at_s = None if self._nearest is None else self._nearest.get_timer()
        return earliest(self._calls.get_timer(), self._hedges.next_due(), stop_at_s, look_at_s)

    def fail_all(self, reason: str) -> None:
        """End every call, because no server is asked any more."""
        for number, call in self._calls:
            if self._calls.end(number) is not None:
                self._fail(number, call, Failure.NO_SERVER, reason)
        self._hedges.clear()
        self._ended.clear()

    def poll_effects(self) -> list[Effect]:
        """Return, once, what to send, in order; no request of a call that has ended meanwhile."""
        effects, self._effects = self._effects, []
        return [each for each in effects if not isinstance(each, Ask) or each.call in self._calls]

    def _remove_owed(self, number: int, server: Name, now_s: float, *, says_no: bool = False) -> _Call[A] | None:
        """Return the call to which this server owed a response, and record that it owes none any more."""
        call = self._calls.get(number)
        if call is None:
            self.late += 1
            ended = self._ended.get(number)
            since_s = None if ended is None else ended.owing.pop(server, None)
            if ended is not None and not ended.owing:
                del self._ended[number]
        else:
            since_s = call.owing.pop(server, None)
            self.unexpected += since_s is None
        if since_s is None:
            return None
        if says_no:
            self._latencies.refused(server, now_s)
        else:
            self._latencies.answered(server, now_s - since_s, now_s)
        return call

    def _go_on(self, number: int, call: _Call[A], failure: Failure, reason: str, now_s: float) -> None:
        """Ask the next server instead of one without a response; fail where no server is left."""
        if number not in self._calls:
            return  # a callback ended it
        if self._is_silent(call):
            self._ask(number, call, self._untried(call, now_s)[:1], now_s)
        if not call.owing:
            self._calls.end(number)
            self._fail(number, call, failure, reason)

    def _untried(self, call: _Call[A], now_s: float) -> list[Name]:
        """Return the servers to ask next, the best first; leaving ones come last."""
        free = [server for server in self._servers if server not in call.owing and server not in call.refused]
        return self._ranked(free, now_s)

    def _ranked(self, servers: Iterable[Name], now_s: float) -> list[Name]:
        ranked, nearest = self._latencies.ranked(servers, now_s), self._nearest
        if nearest is None:
            return sorted(ranked, key=self._servers.__getitem__)
        return sorted(ranked, key=lambda each: (self._servers[each], nearest.is_silent(each), nearest.cost(each)))

    def _is_silent(self, call: _Call[A]) -> bool:
        """Return whether no server that owes a response is heard; servers that are not watched count as silent."""
        return self._nearest is None or all(map(self._nearest.is_silent, call.owing))

    def _look_at_owing(self, now_s: float) -> None:
        """Probe the servers that owe a response; where they are silent, ask the next one that is not."""
        if (nearest := self._nearest) is None:
            return
        for server in nearest.poll_due(now_s):
            owed = [(number, call) for number, call in self._calls if call.is_watched and server in call.owing]
            for number, call in owed:
                if self._is_silent(call):
                    others = [each for each in self._untried(call, now_s)[:1] if not nearest.is_silent(each)]
                    self.hedged += len(others)
                    self._ask(number, call, others, now_s)
            if owed:
                self._effects.append(Probe(server))
                nearest.probed(server, now_s)

    def _ask(self, number: int, call: _Call[A], servers: Sequence[Name], now_s: float) -> None:
        for server in servers:
            call.owing[server] = now_s
            call.tried.add(server)
            self._latencies.asked(server, now_s)
            if self._nearest is not None and call.is_watched:
                self._nearest.asked(server, now_s)
        if servers:
            self._effects.append(Ask(number, call.request, tuple(servers)))

    def _hedge(self, now_s: float) -> None:
        """Send second copies of late calls within the budget; later requests earn what is missing."""
        while self._late:
            number = next(iter(self._late))
            call = self._calls.get(number)
            others = self._untried(call, now_s)[:1] if call is not None else []
            if call is not None and others:
                if not self._budget.spend():
                    return
                self.hedged += 1
                self._ask(number, call, others, now_s)
            del self._late[number]

    def _hedge_after_s(self) -> float:
        """Return the time that a first copy has, in seconds."""
        soon_s = self._latencies.percentile(HEDGE_PERCENTILE)
        late_s = self._latencies.percentile(max(HEDGE_PERCENTILE, 1 - 0.75 * self._replication.budget))
        if soon_s is None or late_s is None:
            return HEDGE_FIRST_S
        return max(min(late_s, HEDGE_LATER_MAX * soon_s), _HEDGE_MIN_S)

    def _release(self, number: int, call: _Call[A]) -> None:
        self.held_bytes -= len(call.request)
        if self._stops:
            self._effects.append(End(number))
        self._late.pop(number, None)
        self._hedges.discard(number)

    def _fail(self, number: int, call: _Call[A], failure: Failure, reason: str) -> None:
        self._release(number, call)
        if call.declined:
            call.answered(call.declined[0])
        else:
            call.failed(failure, reason)

    def _tell_stops(self, now_s: float) -> None:
        due: list[tuple[int, dict[Name, float]]] = []
        for number, ended in self._ended.items():
            if ended.stop_at_s > now_s:
                break
            due.append((number, ended.owing))
        stops: dict[Name | None, list[int]] = {}
        for number, owing in due:
            del self._ended[number]
            for server, since_s in owing.items():
                self._latencies.stopped(server, now_s - since_s, now_s)
            by_tree = self._replication.mode is Mode.ALL and bool(owing)
            for each in [None] if by_tree else owing:
                stops.setdefault(each, []).append(number)
        for whom, calls in stops.items():
            for at in range(0, len(calls), STOP_MAX):
                self._effects.append(Stop(tuple(calls[at : at + STOP_MAX]), whom))
