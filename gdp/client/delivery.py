"""Delivery in order of one writer's messages: where it begins, what waits behind a gap, and what is given up.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A reliable stream waits for every message that its writer
still has. A best-effort one waits as long as a late repair, parity or the slower path may bring what is missing.

Sequence numbers under the seal show what is lost between two messages. Heartbeats show what is lost behind the last,
and why.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from gdp.errors import DropReason, RemoteError
from gdp.frame.codec import Flag
from gdp.intervals import NEVER_S
from gdp.limits import NUMBER_MAX, REPLAY_WINDOW_MESSAGES, SEQUENCE_BYTES
from gdp.message.bundle import unpack
from gdp.message.frame_recovery import FrameRecovery
from gdp.message.heartbeat import Heartbeat, StreamStart
from gdp.message.late_repairs import LateRepairs
from gdp.message.loss import Losses, LossReason, LostRange, explain
from gdp.message.reassembly import ReassembledMessage, Reassembler
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.message.renumbering import Renumbering
from gdp.names import Name
from gdp.sansio import new_tuple

_BUNDLE: Final = int(Flag.BUNDLE)
_OVERHEAD_BYTES: Final = 256  # what a waiting message costs in addition to its bytes


class Delivered(NamedTuple):
    """One message, opened, verified and in order."""

    publisher: bytes
    incarnation: int  # of the publisher, within which numbers rise
    number: int
    message: bytes
    parts: int
    hops: int
    place: int = 0  # index among the messages of one number: a bundle has several
    # which message of its publisher's incarnation this is, from 1; a skipped number is a lost message
    sequence: int = 0
    head: bytes = b""  # of the message, where its reader asked for it apart; bundled messages have none


class Ended(NamedTuple):
    """Where a writer proxy ended, for a later one of the same publisher: earlier frames are not opened again.

    Args:
        number: of the next message.
        status: number of the newest Heartbeat seen.
        sequence: of the next message.
        known: the first sequence number of unknown fate: messages between the two were published, and did not arrive.
        resumes: the writer proxy ended without its reader's will: what it misses meanwhile is lost, and requested
            again.
        is_restarted: it read another incarnation of the publisher: what was published in this one is lost.
    """

    number: int = 0
    status: int = 0
    sequence: int = 0
    known: int = 0
    resumes: bool = False
    is_restarted: bool = False


NOT_BEGUN: Final = Ended()


class Delivery:
    """Delivery of the messages of one incarnation of a writer to the application.

    Args:
        budget: memory of all writer proxies; messages that wait are reserved there.
        data: reassembles the messages.
        recovery: keeps frames for parity.
        late: requests what best-effort messages lack.
        lag_s: returns how long a copy may take to bring what is missing; 0: none comes.

    Attributes:
        is_live: it has begun.
        is_thinned: not every message is for this reader; of those it gets some frame.
        is_reliable: messages between two delivered ones were given up by the writer; else they are gaps. None: the
            writer has not said so far.
        expected: number of the message that is delivered next.
        sequence: its sequence number.
        known: lowest sequence number of unknown fate.
        losses: messages that were lost.
        delivered: messages that were delivered.
        delivered_bytes: size of what was to be delivered.
        ready: messages for the application, in order.
        gap_until_s: best effort, two paths: until then the slower one may bring what is missing; infinity: no gap.
        held: Heartbeats, and when what they say of missing messages counts.
    """

    def __init__(
        self,
        publisher: Name,
        incarnation: int,
        budget: ReassemblyQuota,
        *,
        data: Reassembler,
        recovery: FrameRecovery,
        late: LateRepairs,
        lag_s: Callable[[], float],
    ) -> None:
        self._data = data
        self._recovery = recovery
        self._late = late
        self._lag_s = lag_s
        self.is_live = self.is_thinned = False
        self._abandoned = 0  # messages of which some frames came, and that count as lost
        self.is_reliable: bool | None = None
        self.expected = self.sequence = self.known = 0
        self.losses = Losses()
        self.delivered = self.delivered_bytes = 0
        self._publisher = publisher
        self._incarnation = incarnation
        self._budget = budget
        self.ready: list[Delivered] = []
        self._gone: tuple[LostRange, ...] = ()  # that the writer reports as lost for every reader
        self._skipped: LossReason | None = None  # why the next gap is skipped; None: unknown
        self._waiting: dict[int, ReassembledMessage] = {}  # behind a gap, by number
        self.gap_until_s = NEVER_S
        self._gap_at = 0  # number that is missing
        self.held: deque[tuple[float, Heartbeat]] = deque()

    def begin_stream(self, status: Heartbeat, start: StreamStart, before: Ended, *, is_latched: bool) -> None:
        """Begin at the publisher's start, and count what came between that and the last message read before."""
        expected = start.number
        if before.resumes or not is_latched:
            expected = max(start.number, before.number)
        begun, why = start.confirmed, LossReason.READER_RESTARTED
        if before.resumes and before.sequence:
            begun, why = before.sequence, LossReason.DETACHED
        elif before.is_restarted:
            begun, why = 1, LossReason.PUBLISHER_RESTARTED
        self._gone = status.gone if why is LossReason.DETACHED else ()
        self.sequence = begun or start.sequence
        self._lose_until(start.sequence, why)
        self._gone = status.gone
        self.begin_at(expected, max(start.sequence, before.sequence) if expected > start.number else start.sequence)

    def begin_at(self, number: int, sequence: int) -> None:
        """Begin at a message."""
        self.is_live = True
        self.sequence = sequence
        self.expected = number
        for each in [each for each in self._waiting if not 0 <= each - number < REPLAY_WINDOW_MESSAGES]:
            self._pop(each)
        self._data.start_at(number, self._numbers)

    def add(self, reassembled: ReassembledMessage, now_s: float) -> None:
        """Order a complete message, and deliver the consecutive ones."""
        number = reassembled.number
        is_next = number == self.expected or (
            not self.is_reliable and self._lag_s() <= 0 and number < self._late.hold((), now_s)
        )
        if self.is_live and is_next:
            if number > self.expected:
                self._skip_to(number)
            self._unpack(reassembled)
            self.expected, self._late.hold_s = number + 1, NEVER_S
            if self._waiting:
                self._deliver(now_s)
            else:
                self.gap_until_s = NEVER_S
        elif self._put(reassembled):
            self.known = max(self.known, min(int.from_bytes(reassembled.head[:SEQUENCE_BYTES], "big"), NUMBER_MAX) + 1)
            if not self.is_reliable:
                self._deliver(now_s)
        elif self.is_live:
            self._give_up_until(number)
            self._unpack(reassembled)
            self.expected += 1
            self._deliver(now_s)
        else:
            self._data.drops[DropReason.MEMORY_FULL] += 1

    def skip_gap(self, now_s: float) -> None:
        """Go on without the messages before those that wait: the memory behind the gap is exhausted."""
        if self.is_live and self._waiting:
            self._give_up_until(min(self._waiting))
            self._deliver(now_s)

    def handle_heartbeat(self, status: Heartbeat, now_s: float, *, is_newest: bool) -> None:
        """Apply what a Heartbeat says of messages that are renumbered or gone, once a copy can bring them no more."""
        if is_newest:
            self._gone = status.gone
        for move in status.moves:
            if move.is_before(self.expected):
                self._renumber(move)
        lag_s = max(self._lag_s(), self._late.wait_s(status.oldest, now_s))
        if self.is_reliable or lag_s <= 0:
            self._apply_progress(status, now_s)
        else:
            self.held.append((now_s + lag_s, status))

    def handle_timer(self, now_s: float) -> None:
        """Go on without what neither path nor a repair brought in time."""
        while self.held and self.held[0][0] <= now_s:
            self._apply_progress(self.held.popleft()[1], now_s)
        late = self._late
        is_released = (late.incomplete or late.hold_s <= now_s) and late.give_up(now_s)
        if self.gap_until_s <= now_s:
            numbers = self._numbers
            if numbers and numbers[0] < self._late.hold(numbers, now_s):
                self._skip_to(numbers[0])
            self._deliver(now_s)
        elif is_released:
            self._deliver(now_s)

    def finish(self) -> None:
        """Deliver what is complete, and count what is known to be missing: this incarnation publishes no more."""
        if self.is_live:
            self._skipped = LossReason.PUBLISHER_RESTARTED
            for number in self._numbers:
                self._unpack(self._pop(number))
            self._lose_until(self.known, LossReason.PUBLISHER_RESTARTED)

    def close(self) -> None:
        """Release all memory."""
        for number in self._numbers:
            self._pop(number)
        self.gap_until_s = NEVER_S
        self.held.clear()

    def poll(self) -> list[Delivered]:
        """Remove and return the messages that are ready, in order."""
        ready, self.ready = self.ready, []
        return ready

    def _deliver(self, now_s: float) -> None:
        """Deliver the consecutive messages, and without a reliable writer those behind a gap that nothing fills."""
        waiting = self._waiting
        gap_until_s, self.gap_until_s = self.gap_until_s, NEVER_S
        if not self.is_live or not waiting:
            return
        while self.expected in waiting:
            self._unpack(self._pop(self.expected))
            self.expected += 1
        if not waiting or self.is_reliable:
            return
        lag_s, free_to = self._lag_s(), self._late.hold(self._numbers, now_s)
        if lag_s > 0:
            is_same = self._gap_at == self.expected and now_s < gap_until_s < NEVER_S
            self._gap_at, self.gap_until_s = self.expected, gap_until_s if is_same else now_s + lag_s
        elif free := [number for number in self._numbers if number < free_to]:
            self._skip_to(free[-1] + 1)

    def _skip_to(self, number: int) -> None:
        """Accept that missing messages before ``number`` will not come."""
        self.expected = number
        for each in self._numbers:
            if each < number:
                self._unpack(self._pop(each))
        self._data.forget(number)
        self._late.forget(number)
        self._recovery.forget_below(number)

    def _give_up_until(self, number: int) -> None:
        self._skipped = LossReason.READER_MEMORY
        self._skip_to(number)

    def _apply_progress(self, status: Heartbeat, now_s: float) -> None:
        """Go on where a Heartbeat says that nothing before will come, and count that as lost."""
        otherwise = self._gap_reason
        if status.oldest > self.expected:
            self._skip_to(status.oldest)
            self._lose_until(status.oldest_sequence, otherwise)
        self._deliver(now_s)
        if self.expected == status.sent_number:
            self._lose_until(status.sent_sequence, otherwise)
        self.known = max(self.known, status.sent_sequence)

    def _renumber(self, move: Renumbering) -> None:
        """Apply a renumbering, also to the messages that wait."""
        if self.expected < move.first:
            self._skip_to(move.first)
        self.expected = move.new_number(self.expected)
        early = [self._pop(number) for number in list(self._waiting) if move.is_before(number)]
        for number in [number for number in self._waiting if number < self.expected]:
            self._pop(number)  # it was delivered under its old number
        self._data.forget(self.expected)
        for each in early:
            number = move.new_number(each.number)
            if number not in self._waiting and self._put(each._replace(number=number)):
                self._data.skip(number)

    @property
    def _numbers(self) -> list[int]:
        """Return the numbers that wait, lowest first."""
        return sorted(self._waiting)

    def _put(self, reassembled: ReassembledMessage) -> bool:
        """Let a message wait; return False if the budget is exhausted."""
        if not self._budget.reserve(self._publisher, len(reassembled.message) + _OVERHEAD_BYTES):
            return False
        self._waiting[reassembled.number] = reassembled
        return True

    def _pop(self, number: int) -> ReassembledMessage:
        reassembled = self._waiting.pop(number)
        self._budget.release(self._publisher, len(reassembled.message) + _OVERHEAD_BYTES)
        return reassembled

    def _unpack(self, reassembled: ReassembledMessage) -> None:
        """Queue the messages of a number, and count what lies before them as lost; a malformed one is dropped."""
        number, flags, body, parts, hops, head = reassembled
        sequence, messages, count = int.from_bytes(head[:SEQUENCE_BYTES], "big"), [body], 1
        begin, begin_bytes = head[SEQUENCE_BYTES:], len(head) - SEQUENCE_BYTES
        if begin_bytes < 0 or sequence > NUMBER_MAX:
            self._data.drops[DropReason.MALFORMED] += 1
            return
        self.delivered_bytes += begin_bytes + len(body)
        if flags & _BUNDLE:
            try:
                begin, messages = b"", unpack(begin + body)
            except RemoteError as error:
                self._data.drops[error.reason] += 1
                return
            count = len(messages)
        if self.sequence < sequence:
            self._lose_until(sequence, self._skipped or self._gap_reason)
        self._skipped = None
        end = sequence + count
        self.sequence = end if end > self.sequence else self.sequence
        self.delivered += count
        publisher, incarnation = self._publisher, self._incarnation
        for place, message in enumerate(messages):
            delivered = publisher, incarnation, number, message, parts, hops, place, sequence + place, begin
            self.ready.append(new_tuple(Delivered, delivered))

    @property
    def _gap_reason(self) -> LossReason:
        """Return the reason of losses for which no other reason is known."""
        return LossReason.GIVEN_UP if self.is_reliable else LossReason.GAP

    def _lose_until(self, sequence: int, otherwise: LossReason) -> None:
        """Count what lies before a sequence number as lost, with reason ``otherwise`` if the writer gives none."""
        if self.sequence < sequence:
            for lost in explain(self.sequence, sequence - 1, self._gone, otherwise):
                for each in self._thinned(lost) if self.is_thinned else (lost,):
                    self.losses.add(each)
            self.sequence = sequence

    def _thinned(self, lost: LostRange) -> list[LostRange]:
        """Return a range as its parts that were thinned, of which nothing came, and that have a gap."""
        if lost.reason is not LossReason.GAP:
            return [lost]
        abandoned = min(self._data.drops[DropReason.ABANDONED] - self._abandoned, lost.messages)
        self._abandoned += abandoned
        middle = lost.last - abandoned
        parts = LostRange(lost.first, middle, LossReason.THINNED), LostRange(middle + 1, lost.last, lost.reason)
        return [part for part in parts if part.messages]
