"""Evaluation of the records of a run: silences, missing and duplicate messages, messages at a wrong reader.

Sans-I/O. Moments are monotonic nanoseconds, as the members recorded them.

One incarnation of a reader and one of a publisher make one account: numbers rise by one within it. From the first
message that arrived, each number must arrive once, or its loss must be reported. What a killed publisher had not
delivered cannot be reported.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple

from faults.plan import Oracle, Plan
from faults.records import Kind, Record
from gdp.message.loss import LossReason
from lab.faults import Broken

UNCONFIRMED_S: Final = 2.0  # the publisher may count a message as lost that came so shortly before a reader's death
_SECOND_NS: Final = 1_000_000_000


class Silence(NamedTuple):
    """Interval without a message at a reader, while it had to be reached."""

    channel: int
    reader: str
    begin_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """Return its length in seconds."""
        return (self.end_ns - self.begin_ns) / _SECOND_NS


@dataclass(slots=True)
class Account:
    """Messages of one incarnation of a publisher at one of a reader; ``first``: the number that came first."""

    numbers: set[int] = field(default_factory=set)
    first: int = 0
    last: int = 0
    doubled: int = 0

    def add(self, number: int) -> None:
        """Record a message."""
        self.first = self.first or number
        self.last = max(self.last, number)
        self.doubled += number in self.numbers
        self.numbers.add(number)

    def missing(self, until: int) -> int:
        """Return how many numbers did not arrive, from the first that did up to one."""
        came = sum(self.first <= number <= until for number in self.numbers)
        return max(until + 1 - self.first, 0) - came if self.first else 0


class Timeline:
    """Intervals in which something had to be connected: changes in the order of time."""

    def __init__(self) -> None:
        self._changes: list[tuple[int, bool]] = []

    def note(self, at_ns: int, *, connected: bool) -> None:
        """Record the state from now on."""
        if not self._changes or self._changes[-1][1] != connected:
            self._changes.append((at_ns, connected))

    def stretches(self, begin_ns: int, end_ns: int) -> Iterator[tuple[int, int]]:
        """Yield the parts of an interval in which it had to be connected throughout."""
        marks = [*self._changes, (end_ns, False)]
        for (from_ns, is_connected), (to_ns, _) in pairwise(marks):
            if is_connected and max(from_ns, begin_ns) < min(to_ns, end_ns):
                yield max(from_ns, begin_ns), min(to_ns, end_ns)


class Books:
    """Accounts of all readers, callers and publishers of a run. ``plan``: the network."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        # by channel, reader, the reader's incarnation, the publisher's incarnation
        self.accounts: defaultdict[tuple[int, str, int, int], Account] = defaultdict(Account)
        # by channel, reader, its incarnation; and the same, of before that incarnation
        self.reported_losses: defaultdict[tuple[int, str, int], int] = defaultdict(int)
        self.reported_between: defaultdict[tuple[int, str, int], int] = defaultdict(int)
        self.published: defaultdict[tuple[int, int], list[int]] = defaultdict(list)  # channel, incarnation -> moments
        self.arrivals_ns: defaultdict[tuple[int, str], list[int]] = defaultdict(list)
        self.wrong: list[str] = []
        # channel, client, incarnation, number -> [since, answers]
        self._calls: dict[tuple[int, str, int, int], list[int]] = {}
        self.answered: list[tuple[int, int]] = []  # time of the call, time of the answer
        self.failed: list[tuple[int, int]] = []

    def take(self, member: str, incarnation_id: int, records: Iterator[Record]) -> None:
        """Read the records of one incarnation of a member."""
        for each in records:
            if each.kind == Kind.DELIVERED:
                self.accounts[each.channel, member, incarnation_id, each.incarnation_id].add(each.number)
                self.arrivals_ns[each.channel, member].append(each.at_ns)
                if each.other != self._plan.members.index(self._plan.flows[each.channel].publisher):
                    self.wrong.append(f"{member} had a message of member {each.other} on channel {each.channel}")
            elif each.kind == Kind.PUBLISHED:
                self.published[each.channel, incarnation_id].append(each.at_ns)
            elif each.kind == Kind.LOST:
                is_between = each.other == LossReason.READER_RESTARTED
                reported_losses = self.reported_between if is_between else self.reported_losses
                reported_losses[each.channel, member, incarnation_id] += each.number
            elif each.kind == Kind.WRONG:
                self.wrong.append(f"{member} had, on channel {each.channel}, a message for channel {each.other}")
            elif each.kind in (Kind.CALLED, Kind.ANSWERED, Kind.FAILED):
                self._take_call(member, incarnation_id, each)

    def _take_call(self, member: str, incarnation_id: int, each: Record) -> None:
        key = each.channel, member, incarnation_id, each.number
        call = self._calls.setdefault(key, [each.at_ns, 0])
        if each.kind != Kind.CALLED:
            call[1] += 1
            (self.answered if each.kind == Kind.ANSWERED else self.failed).append((call[0], each.at_ns))

    def silences(
        self, channel: int, reader: str, begin_ns: int, end_ns: int, must: Timeline, above_s: float
    ) -> Iterator[Silence]:
        """Yield the longer silences of a reader while its publisher had to reach it."""
        arrivals = [at_ns for at_ns in self.arrivals_ns[channel, reader] if begin_ns < at_ns < end_ns]
        for from_ns, to_ns in pairwise((begin_ns, *arrivals, end_ns)):
            if to_ns - from_ns > above_s * _SECOND_NS:
                for part in must.stretches(from_ns, to_ns):
                    if part[1] - part[0] > above_s * _SECOND_NS:
                        yield Silence(channel, reader, *part)

    def incomplete(self, is_last_life: Callable[[str, int], bool], until_ns: int) -> list[str]:
        """Return unreported losses of reliable flows, in words, and duplicates of any flow.

        ``is_last_life``: whether an incarnation of a member continues to the end of the run. ``until_ns``: messages
        that were published later may still be in flight.
        """
        lives: defaultdict[tuple[int, str], defaultdict[int, dict[int, Account]]]
        lives = defaultdict(lambda: defaultdict(dict))
        for channel, reader, life in (*self.reported_losses, *self.reported_between):
            lives[channel, reader][life] = {}
        for (channel, reader, life, source), account in sorted(self.accounts.items()):
            lives[channel, reader][life][source] = account
        return [
            f"{self._plan.flows[channel].topic} at {reader} (life {life}): {what}"
            for (channel, reader), each in lives.items()
            for life, what in self._incomplete(channel, reader, each, is_last_life, until_ns)
        ]

    def _incomplete(
        self,
        channel: int,
        reader: str,
        lives: Mapping[int, Mapping[int, Account]],
        is_last_life: Callable[[str, int], bool],
        until_ns: int,
    ) -> Iterator[tuple[int, str]]:
        """Yield each incarnation of a reader, and what it lacks; ``lives``: its accounts by publisher's incarnation."""
        flow, between = self._plan.flows[channel], 0
        known = dict[int, int]()  # the last number that earlier incarnations of the reader had, by publisher's
        for life, accounts in sorted(lives.items()):
            reported = self.reported_losses[channel, reader, life]
            # one that got no message may have learnt of losses since the last one that did
            between = (between if known else 0) + self.reported_between[channel, reader, life]
            if not accounts:
                between += reported
                continue
            if doubled := sum(account.doubled for account in accounts.values()):
                yield life, f"{doubled} messages came twice"
            least = most = gap = 0
            for source, account in accounts.items():
                sent = sum(at_ns <= until_ns for at_ns in self.published[channel, source])
                is_last = is_last_life(flow.publisher, source) and is_last_life(reader, life)
                # losses of a later incarnation count from its start, also if only an earlier reader knew an older one
                is_later = any(other < source for other in (*accounts, *known))
                least += account.missing(sent if is_last else account.last)
                most += account.missing(max(sent, account.last)) + (account.first - 1 if is_later else 0)
                gap += max(account.first - 1 - known.get(source, account.first), 0)
            # what publishers sent after the reader had last received from them, and died
            gone = {source: last for source, last in known.items() if source < max(accounts) and source not in accounts}
            tail = sum(max(len(self.published[channel, source]) - last, 0) for source, last in gone.items())
            if flow.reliable and between and not gap <= between <= gap + tail + math.ceil(flow.hz * UNCONFIRMED_S):
                yield life, f"{gap} messages missing since its former life, {between} reported"
            if flow.reliable and not least <= reported <= most:
                lack = f"{least}" if least == most else f"{least} to {most}"
                yield life, f"{lack} messages missing, {reported} reported"
            known |= {source: max(known.get(source, 0), account.last) for source, account in accounts.items()}
            between = 0

    def miscalled(self, until_ns: int, is_last_life: Callable[[str, int], bool]) -> list[str]:
        """Return the calls without a result, or with more than one.

        ``until_ns``: calls that began later may still be in progress. ``is_last_life``: as in ``incomplete``; the calls
        of an earlier incarnation ended with it.
        """
        found = []
        for (channel, client, incarnation_id, number), (since_ns, ends) in self._calls.items():
            if ends > 1 or (not ends and since_ns < until_ns and is_last_life(client, incarnation_id)):
                found.append(f"call {number} of {client} on channel {channel}: {ends} answers")
        return found

    def calls(self) -> tuple[int, int, int]:
        """Return how many calls there were, how many were answered, how many failed."""
        return len(self._calls), len(self.answered), len(self.failed)

    def failed_since(self, at_ns: int) -> int:
        """Return how many calls that began after a moment failed."""
        return sum(since_ns >= at_ns for since_ns, _ in self.failed)


class Continuity:
    """Pairs of publisher and reader, with the times in which graph and policy connect them.

    ``plan``: the network. ``books``: with the arrivals at each reader.
    """

    def __init__(self, plan: Plan, books: Books) -> None:
        self._plan, self._books, self._oracle = plan, books, Oracle(plan)
        self._must = {pair: Timeline() for pair in self._oracle.pairs()}

    def note(self, at_ns: int, broken: Broken) -> None:
        """Record what must be connected from now on."""
        for (_, publisher, reader), timeline in self._must.items():
            timeline.note(at_ns, connected=self._oracle.must_talk(publisher, reader, broken))

    def unreached(self) -> list[str]:
        """Return the flows, in words, of which nothing has come."""
        return [
            f"{self._plan.flows[channel].topic} at {reader}"
            for channel, _, reader in self._must
            if not self._books.arrivals_ns[channel, reader]
        ]

    def silences(self, begin_ns: int, end_ns: int, above_s: float) -> list[Silence]:
        """Return the longer silences of connected readers in a time."""
        return [
            silence
            for (channel, _, reader), must in self._must.items()
            for silence in self._books.silences(channel, reader, begin_ns, end_ns, must, above_s)
        ]

    def broken_promises(self, begin_ns: int, last_ns: int, end_ns: int, limit_s: float, well_s: float) -> list[str]:
        """Return in words the silences that are too long.

        ``last_ns``: end of the last fault. ``limit_s``: longest silence before that. ``well_s``: longest silence after
        it.
        """
        kinds = ("after the last fault", last_ns, end_ns, well_s), ("black hole", begin_ns, last_ns, limit_s)
        return [
            f"{kind}: {self._words(silence, begin_ns)}"
            for kind, from_ns, to_ns, most_s in kinds
            for silence in self.silences(from_ns, to_ns, most_s)
        ]

    def _words(self, silence: Silence, begin_ns: int) -> str:
        topic, at_s = self._plan.flows[silence.channel].topic, (silence.begin_ns - begin_ns) / 1e9
        return f"{topic} at {silence.reader}: {silence.seconds:.2f} s of silence from {at_s:.2f} s on"
