"""Serving side of requests: which wait for their turn, which the local server has, which ended recently.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A client may send one request twice (by the tree, and again to a server that it takes for new). The second time the
response is repeated, or nothing happens while the first is under way. A client may also end a call. A waiting request
is then never passed to the local server. A request that the server has already keeps its slot until the server is done,
for the server works on it all the same.

Clients take turns, and one may use as much memory as it leaves free: half of it alone, and the next always finds some.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Sized
from dataclasses import dataclass
from typing import Final, Generic, NamedTuple, TypeVar

from gdp.due_queue import earliest
from gdp.errors import LocalError
from gdp.message.fair_queue import FairQueue
from gdp.names import Name
from gdp.service.calls import Calls
from gdp.service.server_window import ServerWindow

R = TypeVar("R", bound=Sized)

CALLS_MAX: Final = 65_536
WAITING_MAX_BYTES: Final = 128 << 20  # of requests that the local server has not received yet
ENDED_MAX: Final = 4_096  # ended calls that are remembered
ANSWER_KEPT_BYTES: Final = 4_096  # larger responses are not kept: the request is served again


class Asked(NamedTuple):
    """A call: its client, and the client's number for it."""

    client: Name
    part: int
    call: int


@dataclass(frozen=True, slots=True)
class Turn(Generic[R]):  # Python 3.10 has no generic named tuple
    """A request whose turn it is, with its local number."""

    number: int
    asked: Asked
    request: R


class Expired(NamedTuple):
    """A call that took too long, or whose client is gone.

    ``asked``: None where no client waited any more. ``is_given``: whether the local server has it.
    """

    number: int
    part: int
    asked: Asked | None
    is_given: bool


@dataclass(slots=True, eq=False)
class _Served(Generic[R]):
    asked: Asked
    request: R | None  # None: the local server has it
    size_bytes: int
    after: Asked | None
    is_wanted: bool = True


class Serving(Generic[R]):
    """The requests of one service here.

    Args:
        start: the first number of a call here, random in 64 bits.
        at_once: how many the local server has at one time; None: as many as ``window`` permits.
        window: of a local server whose queue is short; None: it gets all.
    """

    def __init__(
        self,
        start: int,
        at_once: int | None = None,
        limit: int = CALLS_MAX,
        waiting_max_bytes: int = WAITING_MAX_BYTES,
        window: ServerWindow | None = None,
    ) -> None:
        self._calls: Calls[_Served[R]] = Calls(limit, start)
        self._numbers: dict[Asked, int] = {}
        self._waiting = FairQueue[int]()  # owned by clients
        self._held_back: dict[Asked, dict[int, None]] = {}  # call -> requests that wait for its end
        self._ended: dict[Name, OrderedDict[Asked, bytes]] = {}  # by client
        self._ended_count = 0
        self._limit = limit
        self._shares: Counter[Name] = Counter()  # calls of each client
        self._waiting_max_bytes = waiting_max_bytes
        self._waiting_bytes: Counter[Name] = Counter()  # by client
        self._at_once = at_once
        self._window = window
        self._given = 0

    def __len__(self) -> int:
        return len(self._calls)

    def __contains__(self, asked: Asked) -> bool:
        return asked in self._numbers

    @property
    def has_slots(self) -> bool:
        """Return whether requests may wait for the local server to be done with others."""
        return self._at_once is not None or self._window is not None

    def answer_of(self, asked: Asked) -> bytes | None:
        """Return the response of a call that ended recently: empty where it was stopped. None: it did not end."""
        ended = self._ended.get(asked.client)
        return None if ended is None else ended.get(asked)

    def begin(
        self,
        now_s: float,
        patience_s: float | None,
        asked: Asked,
        request: R,
        after: Asked | None = None,
        *,
        is_held: bool = False,
    ) -> int:
        """Add a request; return its number.

        Args:
            patience_s: how long its client waits; None: no limit.
            after: a call to wait for, if that is under way.
            is_held: it waits for ``release``.

        Raises:
            LocalError: this client's calls or waiting bytes have reached its share.
        """
        client, size = asked.client, len(request)
        capacity, free_bytes = self._limit - len(self._calls), self._waiting_max_bytes - self._waiting_bytes.total()
        if self._shares[client] >= capacity or self._waiting_bytes[client] + size > free_bytes:
            raise LocalError(f"{self._shares[client]} requests of this client are under way: no more at once")
        after = after if after in self._numbers else None
        number = self._calls.add_call(now_s, patience_s, _Served(asked, request, size, after))
        self._numbers[asked] = number
        self._shares[client] += 1
        self._waiting_bytes[client] += size
        if after is not None:
            self._held_back.setdefault(after, {})[number] = None
        elif not is_held:
            self._waiting.put(client, number)
        return number

    def release(self, number: int) -> None:
        """Let a request that began held take its turn."""
        if (served := self._calls.get(number)) is not None:
            self._waiting.put(served.asked.client, number)

    def poll_turns(self, now_s: float) -> list[Turn[R]]:
        """Return, once, the requests whose turn it is."""
        turns: list[Turn[R]] = []
        if self._window is not None:
            self._window.handle_waiting(now_s, waits=bool(self._waiting))
        while self._waiting and self._has_free_slot():
            number = self._waiting.pop()
            served = self._calls.get(number)
            if served is not None and served.request is not None:
                turns.append(Turn(number, served.asked, served.request))
                _subtract(self._waiting_bytes, served.asked.client, served.size_bytes)
                served.request = None
                self._given += 1
                if self._window is not None:
                    self._window.give(number)
        if self._window is not None:
            self._window.handle_waiting(now_s, waits=bool(self._waiting))
        return turns

    def end(self, number: int) -> Asked | None:
        """Record that the local server is done with a call; return the call, None where no client waits any more."""
        if self._window is not None:
            self._window.answered(number)
        return self._end(number)

    def remember(self, asked: Asked, answer: bytes) -> None:
        """Keep a response for a while; empty: the call was stopped."""
        if len(answer) <= ANSWER_KEPT_BYTES:
            ended = self._ended.setdefault(asked.client, OrderedDict())
            self._ended_count += asked not in ended
            ended[asked] = answer
            if self._ended_count > ENDED_MAX:
                client, most = max(self._ended.items(), key=lambda each: len(each[1]))
                most.popitem(last=False)
                self._ended_count -= 1
                if not most:
                    del self._ended[client]

    def stop(self, asked: Asked) -> int | None:
        """Record that a client's call has ended, known here or on its way; return its number if the server has it."""
        number = self._numbers.pop(asked, None)
        if number is None:
            if self.answer_of(asked) is None:
                self.remember(asked, b"")
            return None
        self.remember(asked, b"")
        served = self._calls.get(number)
        if served is not None and served.request is None:
            served.is_wanted = False
            if not self.has_slots:
                self._end(number)
            return number
        self._end(number)
        return None

    @property
    def clients(self) -> list[Name]:
        """Return the clients with calls under way here, still wanted or not."""
        return list(self._shares)

    def remove_client(self, client: Name) -> list[Expired]:
        """Remove a client; end and return its wanted calls. A repeated request is served again.

        A request that the local server has keeps its slot as after ``stop``.
        """
        ended = []
        for asked in [each for each in self._numbers if each.client == client]:
            number = self._numbers.pop(asked)
            served = self._calls.get(number)
            if served is None:
                continue
            is_given = served.request is None
            served.is_wanted = False
            if not is_given or not self.has_slots:
                self._end(number)
            ended.append(Expired(number, asked.part, asked, is_given))
        return ended

    def expired(self, now_s: float) -> list[Expired]:
        """End and return the calls that took too long."""
        ended = []
        for number, served in self._calls.expired(now_s):
            self._forget(number, served)
            asked = served.asked if served.is_wanted else None
            ended.append(Expired(number, served.asked.part, asked, served.request is None))
        return ended

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timeout of a call, or of a stall, or None."""
        return earliest(self._calls.get_timer(), None if self._window is None else self._window.get_timer())

    def fail_all(self) -> list[Asked]:
        """End every call; return them."""
        ended = [served.asked for _, served in self._calls.fail_all() if served.is_wanted]
        self._numbers.clear()
        self._waiting.clear()
        self._held_back.clear()
        self._shares.clear()
        self._waiting_bytes.clear()
        self._given = 0
        if self._window is not None:
            self._window.clear()
        return ended

    def _has_free_slot(self) -> bool:
        if self._at_once is not None:
            return self._given < self._at_once
        return self._window is None or self._window.is_open

    def _end(self, number: int) -> Asked | None:
        """Forget a call; return it, None where no client waits any more."""
        served = self._calls.end(number)
        if served is None:
            return None
        self._forget(number, served)
        return served.asked if served.is_wanted else None

    def _forget(self, number: int, served: _Served[R]) -> None:
        if self._numbers.get(served.asked) == number:
            del self._numbers[served.asked]
        client = served.asked.client
        _subtract(self._shares, client, 1)
        if served.request is None:
            self._given -= 1
            if self._window is not None:
                self._window.drop(number)
        else:
            _subtract(self._waiting_bytes, client, served.size_bytes)
            self._waiting.discard(client, number)
            if served.after is not None:
                self._held_back.get(served.after, {}).pop(number, None)
        for each in self._held_back.pop(served.asked, ()):
            other = self._calls.get(each)
            if other is not None:
                self._waiting.put(other.asked.client, each)


def _subtract(counts: Counter[Name], client: Name, count: int) -> None:
    counts[client] -= count
    if not counts[client]:
        del counts[client]
