"""Late repairs: what a reader of a best-effort topic requests again, and how long later messages wait for it.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``gdp/client/best_effort_cache.py`` is the writer's side.

A large message loses a fragment on most thin links: of images of 600 fragments, 1 % loss leaves none. So a reader
requests the missing fragments of messages of more than ``REPAIRS_ABOVE_PARTS`` fragments. Missing are the gaps below
the newest fragment, and the tail once a later message has begun or nothing came for ``REPORT_DELAY_S``. A message of
which nothing came is not requested, as it may be a small one.

A request is repeated when its repair should have come. That time is estimated after RFC 6298, section 2, from requests
and their repairs, so it contains the queues on the way. Before the first repair it doubles from ``REPORT_DELAY_S`` on.

A later complete message waits for an incomplete one, because ROS readers expect the order of publication, and because
the alternative is worse: when a repair takes longer than a period of the topic, dropping the older message at every
later one would drop almost all. The wait ends with the first of these:

- the message is complete;
- ``REPAIR_S`` after its newest fragment was sent for the first time: its publisher no longer has it;
- ``HOLD_S`` after a later message was complete, so that waiting adds no more than this to its age;
- several requests brought nothing.

A writer that never repairs, or not in time, is found out after two messages. From then on nothing waits, and each
incomplete message is requested once, until a repair comes.

A fragment is known here only after it was opened, and only until its message is given up. So injected or replayed
frames start nothing. The bounds are one report in ``REPORT_GAP_S``, ``NACKS_PER_REPORT`` ranges in each, and a count of
messages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from gdp.frame.codec import Header
from gdp.intervals import NEVER_S
from gdp.limits import NACKS_PER_REPORT, REPAIR_S, REPAIRS_ABOVE_PARTS, REPORT_DELAY_S, REPORT_GAP_S
from gdp.message.acknack import MissingRange
from gdp.message.flow_control import RoundTripEstimator
from gdp.message.reassembly import SCAN_PARTS, Reassembler
from gdp.requests import Backoff

HOLD_S: Final = 0.3  # for which a complete message waits for an older one
_TRIES: Final = 6  # requests for the same fragments, if nothing comes
_REPEATS: Final = Backoff(REPORT_DELAY_S, 32 * REPORT_DELAY_S)  # until a repair was measured
_UNANSWERED: Final = 2  # messages in a row that were requested, and got nothing: this writer does not repair
_MESSAGES_MAX: Final = 64  # incomplete messages that are repaired; of more, the one that is needed last is not
_REQUESTS_MAX: Final = 32  # of one message that wait for their repairs
_GAPS_MAX: Final = 1_024  # of one message that are examined at once
_FASTEST: Final = 0.8  # of the usual time: an earlier repair was caused by an earlier request
_MARGIN_S: Final = 0.01
_EPSILON_S: Final = 1e-6
_NONE: Final = 1 << 64  # above all numbers of messages
_ALL: Final = 1 << 32  # above all fragments of a message
_Range = tuple[int, int]  # fragments, both included


@dataclass(slots=True, kw_only=True)
class _Request:
    """Fragments ``first`` to ``end``, without ``end``; those of them that were missing then were requested."""

    first: int
    end: int
    first_s: float
    last_s: float
    tries: int = 1
    is_answered: bool = False


@dataclass(slots=True, kw_only=True)
class _Incomplete:
    """An incomplete message; a fragment below ``requested_end`` is here, or was requested."""

    until_s: float  # it is repaired until then
    quiet_s: float  # when the tail counts as missing, unless a fragment has come
    hold_until_s: float = NEVER_S  # later messages wait until then
    next_part: int = 0  # behind the newest fragment
    requested_end: int = 0
    gap_s: float = NEVER_S  # when a gap behind that was found
    gap_end: int = 0
    requests: list[_Request] = field(default_factory=list)
    is_answered: bool = False

    @property
    def wait_until_s(self) -> float:
        """Return until when later messages wait."""
        return min(self.until_s, self.hold_until_s)


class LateRepairs:
    """Requests of one reader for fragments of one writer's best-effort messages.

    Args:
        data: reassembles the writer's messages.
        lag_s: returns how long the slower of two paths may take to bring what the faster one has lost.
        awaited_s: returns until when parity may fill the gaps of a message, in monotonic seconds; 0: none is awaited.

    Attributes:
        due_s: monotonic second at which something may be requested; infinity: nothing is.
        hold_s: until when complete messages wait; infinity: none does.
        incomplete: messages that may be repaired, by number.
    """

    def __init__(
        self,
        data: Reassembler,
        lag_s: Callable[[], float],
        awaited_s: Callable[[int, float], float] = lambda _number, _now_s: 0.0,
    ) -> None:
        self._data = data
        self._lag_s = lag_s
        self._awaited_s = awaited_s
        self.incomplete: dict[int, _Incomplete] = {}
        self.due_s = self.hold_s = NEVER_S
        self._highest = -1  # number of the latest message that has begun
        self._unanswered = 0  # messages in a row
        self._repair = RoundTripEstimator()  # from a request to its repair

    def is_due(self, now_s: float) -> bool:
        """Return whether ``poll_missing`` may return something."""
        return self.due_s <= now_s + _EPSILON_S

    def handle_part(self, header: Header, now_s: float, count: int = 1) -> None:
        """Process a new fragment, and those that followed it at once; they did not complete their message."""
        number, part = header.number, header.part
        entry = self.incomplete.get(number)
        if entry is None:
            self._handle_begun(number, now_s)
            if header.parts <= REPAIRS_ABOVE_PARTS:
                return
            entry = self._begin(number, now_s)
        if part < entry.requested_end:
            self._handle_answer(entry, part, now_s)
        known_end = max(entry.next_part, self._data.progress(number))
        if part > known_end and entry.gap_s == NEVER_S:
            entry.gap_s, entry.gap_end = now_s, part
            self.due_s = min(self.due_s, now_s + self._delay_s())
        if part >= known_end:
            entry.next_part = part + count
            entry.until_s = now_s + REPAIR_S

    def handle_complete(self, number: int, part: int, now_s: float) -> None:
        """Process a message that a fragment completed; those before it delay it for at most ``HOLD_S``."""
        if not self.incomplete:
            self._highest = number if number > self._highest else self._highest
            return
        entry = self.incomplete.pop(number, None)
        if entry is not None and part < entry.requested_end:
            self._handle_answer(entry, part, now_s)
        self._handle_begun(number, now_s)
        for before, each in self.incomplete.items():
            if before < number:
                each.hold_until_s = min(each.hold_until_s, now_s + HOLD_S)
        if not self.incomplete:
            self.due_s = NEVER_S

    def forget(self, below: int) -> None:
        """Give up the messages numbered under ``below``."""
        for number in [number for number in self.incomplete if number < below]:
            self._remove(number)
        if not self.incomplete:
            self.due_s = NEVER_S

    def close(self) -> None:
        """Forget everything."""
        self.incomplete.clear()
        self.due_s = self.hold_s = NEVER_S

    def wait_s(self, below: int, now_s: float) -> float:
        """Return for how long messages numbered under ``below`` may still be repaired; 0: none is."""
        times = [self.incomplete[number].wait_until_s for number in self._awaited(now_s) if number < below]
        return max(times, default=now_s) - now_s

    def hold(self, numbers: Sequence[int], now_s: float) -> int:
        """Return the number below which complete messages may be delivered; the others of ``numbers`` wait.

        Args:
            numbers: of all complete messages that were not delivered, lowest first.
        """
        first = min(self._awaited(now_s), default=_NONE) if self.incomplete else _NONE
        is_waiting = bool(numbers) and numbers[-1] > first
        self.hold_s = self.incomplete[first].wait_until_s if is_waiting else NEVER_S
        return first

    def give_up(self, now_s: float) -> bool:
        """Give up messages that cannot be in time; return whether complete messages may wait no longer.

        Their memory is released, unless they may be under way still.
        """
        has_ended = self.hold_s <= now_s
        for number, entry in list(self.incomplete.items()):
            if now_s < entry.until_s and self._is_exhausted(number, entry, now_s):
                entry.until_s, has_ended = now_s, True
            if entry.until_s <= now_s and number < self._highest:
                self._remove(number)
                self._data.give_up(number)
        if has_ended:
            self.hold_s = NEVER_S  # until ``hold`` is called
        return has_ended

    def poll_missing(self, now_s: float) -> tuple[MissingRange, ...]:
        """Return the fragments that are to be requested now, once."""
        missing: list[MissingRange] = []
        self.due_s = NEVER_S
        for number, entry in self.incomplete.items():
            if len(missing) >= NACKS_PER_REPORT:
                self.due_s = now_s
                break
            extent = self._data.extent(number) if now_s < entry.until_s else None
            if extent is not None and (awaited_s := self._awaited_s(number, now_s)) > now_s:
                self.due_s = min(self.due_s, max(awaited_s, self._next_s(entry)))
                continue
            if extent is not None:
                ranges = self._poll_ranges(number, entry, extent, NACKS_PER_REPORT - len(missing), now_s)
                missing += [MissingRange(number, *each) for each in ranges]
                self.due_s = min(self.due_s, self._next_s(entry))
        self.due_s = max(self.due_s, now_s + REPORT_GAP_S)
        return tuple(missing)

    def _remove(self, number: int) -> None:
        entry = self.incomplete.pop(number)
        if entry.requests and not entry.is_answered:
            self._unanswered += 1

    @property
    def _is_hopeful(self) -> bool:
        return self._unanswered < _UNANSWERED

    def _awaited(self, now_s: float) -> list[int]:
        """Return the numbers of the messages that may still be repaired."""
        if not self._is_hopeful:
            return []
        entries = self.incomplete.items()
        return [n for n, each in entries if now_s < each.wait_until_s and self._data.extent(n) is not None]

    def _begin(self, number: int, now_s: float) -> _Incomplete:
        if len(self.incomplete) >= _MESSAGES_MAX:
            over = [each for each, entry in self.incomplete.items() if entry.until_s <= now_s]
            self._remove(over[0] if over else max(self.incomplete))
        entry = self.incomplete[number] = _Incomplete(until_s=now_s + REPAIR_S, quiet_s=now_s + REPORT_DELAY_S)
        if number < self._highest:
            entry.gap_s, entry.gap_end = now_s, _ALL
        self.due_s = min(self.due_s, self._next_s(entry))
        return entry

    def _handle_begun(self, number: int, now_s: float) -> None:
        """Note that a message has begun: of those before it, the tail is missing, too."""
        if number <= self._highest:
            return
        self._highest = number
        for before, each in self.incomplete.items():
            if before < number:
                if each.requested_end < _ALL:
                    each.gap_s, each.gap_end = min(each.gap_s, now_s), _ALL
                self.due_s = min(self.due_s, now_s + self._delay_s())

    def _handle_answer(self, entry: _Incomplete, part: int, now_s: float) -> None:
        """Learn from a fragment that was requested how long a repair takes.

        Of several requests, the last one that can have caused it counts.
        """
        self._unanswered, entry.is_answered = 0, True
        for request in entry.requests:
            if request.first <= part < request.end and not request.is_answered:
                request.is_answered = True
                before_s = self._repair.rtt_s
                is_last = request.tries == 1 or (before_s is not None and now_s - request.last_s > _FASTEST * before_s)
                self._repair.add(now_s - (request.last_s if is_last else request.first_s))

    def _poll_ranges(
        self, number: int, entry: _Incomplete, extent: tuple[int, int, float], limit: int, now_s: float
    ) -> list[_Range]:
        """Return at most ``limit`` ranges of one message that are due, and note that they were requested."""
        parts, newest, touched_s = extent
        if now_s >= touched_s + REPORT_DELAY_S - _EPSILON_S and entry.requested_end < _ALL:
            entry.gap_s, entry.gap_end = now_s - self._delay_s(), _ALL
        gaps = self._data.missing(number, _GAPS_MAX, to_end=_ALL in (entry.gap_end, entry.requested_end))
        if not gaps:
            entry.until_s = touched_s + REPAIR_S
        examined_end = self._data.progress(number) + SCAN_PARTS
        if len(gaps) == _GAPS_MAX:
            examined_end = min(examined_end, gaps[-1][1] + 1)
        elif examined_end > newest:
            examined_end = _ALL
        due: list[_Range] = []
        for request in list(entry.requests):
            lacking = _within(gaps, request.first, request.end)
            if not lacking and request.end <= examined_end:
                entry.requests.remove(request)
                continue
            if touched_s > request.last_s:
                request.tries = min(request.tries, _TRIES - 1)
            if lacking and self._is_repeated(request, now_s) and len(due) < limit:
                due += self._repeat(entry, request, lacking, limit - len(due), now_s)
        if entry.gap_s + self._delay_s() <= now_s + _EPSILON_S and len(due) < limit:
            end = newest + 1 if self._lag_s() <= 0 and entry.gap_end < _ALL else entry.gap_end
            seen_end = min(end, examined_end)
            lacking = _within(gaps, entry.requested_end, seen_end)
            due += self._request(entry, lacking, seen_end, limit - len(due), now_s)
            if entry.requested_end >= end:
                is_more = bool(_within(gaps, end, newest + 1))
                entry.gap_s, entry.gap_end = now_s if is_more else NEVER_S, newest + 1
            elif entry.requested_end >= seen_end:
                entry.gap_s = now_s + REPORT_DELAY_S  # more is examined when the first gaps are filled
        entry.quiet_s = touched_s + REPORT_DELAY_S if entry.requested_end < parts else NEVER_S
        return due

    def _request(self, entry: _Incomplete, lacking: list[_Range], end: int, limit: int, now_s: float) -> list[_Range]:
        """Request what is missing before ``end`` for the first time; return what fits."""
        taken = lacking[:limit]
        if len(taken) < len(lacking):
            end = taken[-1][1] + 1
        first, entry.requested_end = entry.requested_end, max(entry.requested_end, end)
        if not taken:
            return []
        if entry.requests and not self._is_hopeful:
            entry.requests[-1].end = end
            return []
        if len(entry.requests) < _REQUESTS_MAX:
            entry.requests.append(_Request(first=first, end=end, first_s=now_s, last_s=now_s))
        else:
            entry.requests[-1].end, entry.requests[-1].last_s = end, now_s
        return taken

    def _repeat(
        self, entry: _Incomplete, request: _Request, lacking: list[_Range], limit: int, now_s: float
    ) -> list[_Range]:
        """Request again what still lacks; return what fits."""
        taken = lacking[:limit]
        if len(taken) < len(lacking) and len(entry.requests) < _REQUESTS_MAX:
            end = taken[-1][1] + 1
            entry.requests.append(replace(request, first=end))
            request.end = end
        request.tries += 1
        request.last_s = now_s
        return taken

    def _is_repeated(self, request: _Request, now_s: float) -> bool:
        """Return whether a request is to be repeated now."""
        return self._is_hopeful and request.tries < _TRIES and self._repeated_s(request) <= now_s + _EPSILON_S

    def _is_exhausted(self, number: int, entry: _Incomplete, now_s: float) -> bool:
        """Return whether some fragments were requested often enough, and nothing came since."""
        extent = self._data.extent(number)
        return extent is not None and any(
            each.tries >= _TRIES and extent[2] <= each.last_s and self._repeated_s(each) <= now_s + _EPSILON_S
            for each in entry.requests
        )

    def _repeated_s(self, request: _Request) -> float:
        """Return when a request is repeated."""
        repair = self._repair
        if repair.rtt_s is None:
            return request.last_s + _REPEATS.pause_s(request.tries)
        return request.last_s + max(repair.rtt_s + max(4 * repair.deviation_s, _MARGIN_S), REPORT_DELAY_S)

    def _next_s(self, entry: _Incomplete) -> float:
        """Return when something of a message may be requested next."""
        times = [entry.gap_s + self._delay_s(), entry.quiet_s]
        if self._is_hopeful:
            times += map(self._repeated_s, entry.requests)
        return min(*times, entry.until_s)

    def _delay_s(self) -> float:
        """Return how long a gap may still be filled without a request."""
        return max(REPORT_GAP_S, self._lag_s())


def _within(ranges: list[_Range], first: int, end: int) -> list[_Range]:
    """Return the parts of inclusive ranges from ``first`` on, below ``end``."""
    return [(max(a, first), min(b, end - 1)) for a, b in ranges if a < end and b >= first]
