"""Parity against loss: how many parity frames a publisher sends for the blocks of its large messages, and when.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/loss.md. ``gdp/message/parity.py``
has the blocks, ``gdp/message/frame_recovery.py`` is the reader's side.

The count follows the measured loss: the least with which at most ``_TARGET`` of the messages need a repair, if frames
are lost independently. If losses come in bursts, readers request messages that have parity. Each such message adds one
frame to a margin, and each other one takes a fiftieth off. This is a leaky form of the outer loop of link adaptation in
LTE.

The first ``_AT_ONCE`` parity frames of a span leave at once, since the message waits for them. They delay what follows.
"""

from __future__ import annotations

import struct
from collections import OrderedDict, deque
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final

from gdp.burst.cipher import TAG_BYTES
from gdp.client.key_epochs import KeyEpochs
from gdp.client.redundancy import CopyBudget
from gdp.crypto.envelope import SIGNATURE_BYTES, fragment_capacity
from gdp.frame.codec import FLAGS_AT, HEADER_BYTES, NUMBER_AT, PACE_AT, PARTS_MASK, Flag
from gdp.limits import REPAIRS_ABOVE_PARTS
from gdp.message import erasure
from gdp.message.parity import OVERHEAD_BYTES, SHARD_OVERHEAD_BYTES, Parity, blocks_of, shard_of, span_of

PARITY_BYTES: Final = OVERHEAD_BYTES + TAG_BYTES  # so much smaller are the frames of a message with parity
LOSS_MIN, LOSS_MAX = 0.001, 0.2  # less needs no parity, and more is no loss that parity can fill
RTT_MIN_S: Final = 0.010  # below it, detection of a gap takes as long as its repair
_DEADLINE_TRIPS: Final = 8  # a repair is in time where the deadline allows for so many round trips
_TARGET: Final = 0.01  # of the messages: how many may need a repair
_SHARE: Final = 4  # one parity frame for so many frames of a block, at most
_DECAY: Final = 1 / 50  # of the margin, for a message that no reader requested
_AT_ONCE: Final = 8  # frames; an initial window is not larger (RFC 6928)
_MARGIN_MAX: Final = 16.0
_REMEMBERED: Final = 64  # messages whose requests are awaited
_LOSS_STEPS: Final = 1_000  # loss is rounded up to a thousandth
_NUMBER: Final = slice(NUMBER_AT, NUMBER_AT + 8)
_NUMBER_PART_PARTS: Final = struct.Struct("!QII")
_PARITY: Final = int(Flag.PARITY)


def is_protected(size: int, mtu: int) -> bool:
    """Return whether a message of ``size`` bytes has more fragments than those that are repeated as copies."""
    return size + SIGNATURE_BYTES > REPAIRS_ABOVE_PARTS * fragment_capacity(mtu)


def is_useful(loss: float | None, rtt_s: float | None, deadline_s: float | None) -> bool:
    """Return whether parity saves time.

    Args:
        loss: measured share of lost frames; None: unknown.
        rtt_s: measured round trip; None: unknown.
        deadline_s: of the topic's messages; None: none.
    """
    if loss is None or rtt_s is None or not LOSS_MIN <= loss <= LOSS_MAX or rtt_s < RTT_MIN_S:
        return False
    return deadline_s is None or _DEADLINE_TRIPS * rtt_s > deadline_s


def parity_for(k: int, loss: float, target: float, margin: float = 0.0) -> int:
    """Return how many parity frames a block of ``k`` frames gets: at most a quarter of them, and at least one.

    Args:
        loss: share of lost frames, in (0, 1).
        target: largest chance that more frames of the block are lost than it has parity.
        margin: frames in addition.
    """
    most = max(k // _SHARE, 1)
    return min(_least(k, min(-(-loss * _LOSS_STEPS // 1) / _LOSS_STEPS, LOSS_MAX), target, most) + int(margin), most)


@lru_cache(maxsize=4_096)
def _least(k: int, loss: float, target: float, most: int) -> int:
    for count in range(1, most):
        chance = share = (1 - loss) ** (k + count)
        for lost in range(1, count + 1):
            share *= (k + count - lost + 1) / lost * loss / (1 - loss)
            chance += share
        if chance >= 1 - target:
            return count
    return most


class ParitySender:
    """Parity frames of one publisher.

    Args:
        keys: seals them.
        budget: of all publishers of the participant.
        is_enabled: the rule allows redundancy, and frames take one path.

    Attributes:
        is_enabled: as set.
        sent: parity frames that left.
        margin: parity frames of a block beyond those that independent losses need.
        waiting: parity frames that have not left.
    """

    def __init__(self, *, keys: KeyEpochs, budget: CopyBudget, is_enabled: bool) -> None:
        self._keys = keys
        self._budget = budget
        self.is_enabled = is_enabled
        self.sent = 0
        self.margin = 0.0
        self._least_pace = 0
        self._number, self._part = -1, 0  # the message under way, and the part that is sent next
        self._frames: list[bytes] = []  # of its present span
        self._made = 0  # parity frames of this message
        self.waiting = deque[bytes]()
        self._at_once = 0  # of them leave whatever the limit
        self._requested: OrderedDict[int, bool] = OrderedDict()  # messages with parity: whether a reader lacks some

    @property
    def is_available(self) -> bool:
        """Return whether parity can be computed: NumPy is installed."""
        return erasure.is_available()

    def is_wanted(self, loss: float | None, rtt_s: float | None, deadline_s: float | None) -> bool:
        """Return whether messages that are sealed now get parity."""
        return self.is_enabled and is_useful(loss, rtt_s, deadline_s) and self.is_available

    def handle_sent(
        self, frames: Sequence[bytes], loss: float | None, path_bytes_s: float | None, now_s: float, pace: int = 0
    ) -> None:
        """Note DATA frames that leave now, and queue the parity of the spans that they complete.

        Args:
            loss: measured share of lost frames, 0 to 1; None: unknown.
            path_bytes_s: what the path carries; None: unknown.
            pace: the lowest of the readers that lose frames; others need no parity.
        """
        self._least_pace = pace
        if not self.is_enabled or loss is None:
            return
        for frame in frames:
            if not frame[FLAGS_AT] & _PARITY:
                continue
            number, part, parts = _NUMBER_PART_PARTS.unpack_from(frame, NUMBER_AT)
            parts &= PARTS_MASK
            if part == 0 and number > self._number:
                self._number, self._part, self._frames, self._made = number, 0, [], 0
            if number != self._number or part != self._part:
                continue  # sent again
            self._frames.append(frame)
            self._part += 1
            span = span_of(part, parts)
            if self._part == span.stop:
                self._add(span, parts, loss, path_bytes_s, now_s)
                self._frames = []

    def handle_report(self, numbers: Iterable[int]) -> None:
        """Note the messages of which a reader requests something."""
        for number in numbers:
            if self._requested.get(number) is False:
                self._requested[number] = True
                self.margin = min(self.margin + 1.0, _MARGIN_MAX)

    def poll_frames(self, limit: int) -> list[bytes]:
        """Remove and return at most ``limit`` parity frames, and those that leave at once."""
        if not self.waiting:
            return []
        frames = [self.waiting.popleft() for _ in range(min(max(limit, self._at_once), len(self.waiting)))]
        self.sent += len(frames)
        self._at_once = max(self._at_once - len(frames), 0)
        return frames

    def cancel(self, number: int) -> None:
        """Drop the parity frames of a message that is cancelled."""
        cancelled = number.to_bytes(8, "big")
        self.waiting = deque(each for each in self.waiting if each[_NUMBER] != cancelled)

    def clear(self) -> None:
        """Drop the parity frames that wait: there is no reader any more."""
        self.waiting.clear()

    def _add(self, span: range, parts: int, loss: float, path_bytes_s: float | None, now_s: float) -> None:
        """Queue the parity of a span, as far as the budget allows."""
        if not LOSS_MIN <= loss <= LOSS_MAX:
            return
        blocks, frames = blocks_of(span), self._frames
        target = _TARGET / -(-parts * len(blocks) // len(span))
        counts = [parity_for(block.size, loss, target, self.margin) for block in blocks]
        size = max(map(len, frames)) - HEADER_BYTES + SHARD_OVERHEAD_BYTES
        cost = size + HEADER_BYTES + PARITY_BYTES - SHARD_OVERHEAD_BYTES
        while (most := max(counts)) and not self._budget.spend(now_s, sum(counts) * cost, path_bytes_s):
            counts = [min(count, most - 1) for count in counts]
        if not most:
            return
        shards = [
            erasure.encode([shard_of(frames[part - span.start], size) for part in block.parts], count)
            for block, count in zip(blocks, counts, strict=True)
        ]
        flags, pace, seal = frames[0][FLAGS_AT], max(frames[0][PACE_AT], self._least_pace), self._keys.parity.seal
        for index in range(most):
            for block, count, of_block in zip(blocks, counts, shards, strict=True):
                if index < count:
                    body = Parity(block.first, index, count, of_block[index]).to_wire()
                    self.waiting.append(seal(self._number, self._made, parts, flags, body, pace))
                    self._made += 1
        self._at_once = min(self._at_once + len(self.waiting), _AT_ONCE)
        self._remember(self._number)

    def _remember(self, number: int) -> None:
        """Await requests for a message; one that got none for long makes the margin smaller."""
        self._requested.setdefault(number, False)
        if len(self._requested) > _REMEMBERED and not self._requested.popitem(last=False)[1]:
            self.margin -= self.margin * _DECAY
