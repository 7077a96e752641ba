"""Joining the parts of one source's messages, in whatever order they come.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A part is opened before it is kept, so that nothing injected or altered costs memory. What is kept is bounded by a
``Budget`` and given back after a patience. The running hash follows the parts in order; a part that came early keeps its
ciphertext until the hash has reached it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from gdp.crypto.envelope import digest_of
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import Header
from gdp.frame.kinds import Flag
from gdp.limits import HOPS_MAX, JOIN_MESSAGES_MAX, JOIN_PATIENCE_S
from gdp.message.memory import Budget
from gdp.message.replay import ReplayWindow

__all__ = ["ALL_PARTS", "Joined", "Joiner", "OpensParts", "VerifiesDigest"]

ALL_PARTS = 0xFFFF_FFFF
_PART_OVERHEAD_BYTES = 128  # what a kept part costs beside its bytes


class OpensParts(Protocol):
    """An ``Opener`` of the envelope, or a stand-in."""

    def open(self, header: Header, frame: bytes) -> tuple[bytes, bytes, bytes]:
        """Return plaintext, signed payload, signature; or raise ``EnvelopeError``."""


class VerifiesDigest(Protocol):
    """A writer's public key."""

    def verify_digest(self, signature: bytes, digest: bytes) -> None:
        """Return, or raise a ``RemoteError``."""


@dataclass(frozen=True, slots=True)
class Joined:
    """A whole message, opened and verified."""

    number: int
    flags: int
    message: bytes
    parts: int
    hops: int  # switches passed by the part that took the longest way


class _Hash(Protocol):
    def update(self, data: bytes, /) -> None: ...
    def digest(self) -> bytes: ...


@dataclass(slots=True)
class _Unfinished:
    parts: int
    running: _Hash
    touched_s: float
    plain: dict[int, bytes] = field(default_factory=dict)
    early: dict[int, bytes] = field(default_factory=dict)  # ciphertext ahead of the hash
    hashed: int = 0  # parts the hash has taken
    top: int = -1  # highest part held
    signature: bytes = b""
    held_bytes: int = 0
    hops: int = 0


class Joiner:
    """Joins the messages of one source's incarnation towards one destination.

    Args:
        source: whose budget is charged.
        opener_of: gives the opener for a key epoch, or raises ``EnvelopeError`` (UNKNOWN_EPOCH).
        writer: the key that must have signed.
        budget: shared by all joiners of the node.
        patience_s: an unfinished message is given back this long after its last new part; None: only ``forget`` ends it.
    """

    def __init__(
        self,
        source: bytes,
        opener_of: Callable[[int], OpensParts],
        writer: VerifiesDigest,
        budget: Budget,
        *,
        patience_s: float | None = JOIN_PATIENCE_S,
    ) -> None:
        self._source = source
        self._opener_of = opener_of
        self._writer = writer
        self._budget = budget
        self._patience_s = patience_s
        self._unfinished: dict[int, _Unfinished] = {}
        self.window = ReplayWindow()
        self.drops: Counter[DropReason] = Counter()
        self.highest = -1  # highest message number of which an authentic part came
        self.new_parts = 0

    def add(self, header: Header, frame: bytes, now_s: float) -> Joined | None:
        """Take one part; return the message it completes, if any. What is wrong with it is counted in ``drops``."""
        number = header.number
        if self.window.is_finished(number):
            self.drops[DropReason.LATE] += 1
            return None
        message = self._unfinished.get(number)
        if message is not None and header.part in message.plain:
            self.drops[DropReason.DUPLICATE] += 1
            return None
        if message is None and len(self._unfinished) >= JOIN_MESSAGES_MAX:
            self.drops[DropReason.MEMORY_FULL] += 1
            return None
        try:
            plain, sealed, signature = self._opener_of(header.epoch).open(header, frame)
        except EnvelopeError as error:
            self.drops[error.reason] += 1
            return None
        return self._keep(header, plain, sealed, signature, now_s)

    def _keep(self, header: Header, plain: bytes, sealed: bytes, signature: bytes, now_s: float) -> Joined | None:
        number = header.number
        message = self._unfinished.get(number)
        if message is None:
            message = _Unfinished(header.parts, digest_of(header), now_s)
        elif message.parts != header.parts:
            self.drops[DropReason.BAD_PARTS] += 1
            return None
        in_order = header.part == message.hashed
        cost = len(plain) + _PART_OVERHEAD_BYTES + (0 if in_order else len(sealed))
        if not self._budget.reserve(self._source, cost):
            self.drops[DropReason.MEMORY_FULL] += 1
            return None
        self._unfinished[number] = message
        self.highest = max(self.highest, number)
        self.new_parts += 1
        message.held_bytes += cost
        message.touched_s = now_s
        message.plain[header.part] = plain
        message.top = max(message.top, header.part)
        message.hops = max(message.hops, HOPS_MAX - header.hops_left)
        if signature:
            message.signature = signature
        if in_order:
            self._hash(message, sealed)
        else:
            message.early[header.part] = sealed
        return self._finish(header, message) if message.hashed == message.parts else None

    def _hash(self, message: _Unfinished, sealed: bytes) -> None:
        message.running.update(sealed)
        message.hashed += 1
        while message.early and (early := message.early.pop(message.hashed, None)) is not None:
            message.running.update(early)
            message.hashed += 1
            message.held_bytes -= len(early)
            self._budget.release(self._source, len(early))

    def _finish(self, header: Header, message: _Unfinished) -> Joined | None:
        number = header.number
        self._drop(number)
        try:
            self._writer.verify_digest(message.signature, message.running.digest())
        except RemoteError as error:  # not finished: the writer's own parts may still come
            self.drops[error.reason] += 1
            return None
        self.window.finish(number)
        plain = message.plain
        whole = plain[0] if message.parts == 1 else b"".join([plain[part] for part in range(message.parts)])
        return Joined(number, header.flags & ~Flag.LAST, whole, message.parts, message.hops)

    def _drop(self, number: int) -> bool:
        message = self._unfinished.pop(number, None)
        if message is None:
            return False
        self._budget.release(self._source, message.held_bytes)
        return True

    def forget(self, below: int) -> int:
        """Give up every message numbered under ``below``; return how many unfinished ones that ended."""
        ended = 0
        for number in [number for number in self._unfinished if number < below]:
            self._drop(number)
            self.window.finish(number)
            self.drops[DropReason.ABANDONED] += 1
            ended += 1
        return ended

    def expire(self, now_s: float) -> int:
        """Give back what waited longer than the patience; return how many messages that ended."""
        if self._patience_s is None:
            return 0
        late = [n for n, message in self._unfinished.items() if now_s - message.touched_s >= self._patience_s]
        for number in late:
            self._drop(number)
            self.window.finish(number)
            self.drops[DropReason.ABANDONED] += 1
        return len(late)

    def next_expiry(self) -> float | None:
        """Return the monotonic second at which ``expire`` has something to do, or None."""
        if self._patience_s is None or not self._unfinished:
            return None
        return min(message.touched_s for message in self._unfinished.values()) + self._patience_s

    def is_finished(self, number: int) -> bool:
        """Return whether a message is complete or given up."""
        return self.window.is_finished(number)

    def missing(self, number: int, limit: int, *, to_end: bool = False) -> list[tuple[int, int]]:
        """Return the lacking parts of a message as inclusive ranges; of one never seen, ``(0, 2**32 - 1)``.

        Of the newest message only gaps count, unless ``to_end``: what lies beyond its highest part may be on its way.
        """
        if self.window.is_finished(number):
            return []
        message = self._unfinished.get(number)
        if message is None:
            return [(0, ALL_PARTS)] if to_end or number < self.highest else []
        end = message.top if number == self.highest and not to_end else message.parts
        ranges: list[tuple[int, int]] = []
        start = -1
        for part in range(message.hashed, end + 1):
            lacking = part < message.parts and part not in message.plain
            if lacking and start < 0:
                start = part
            elif not lacking and start >= 0:
                ranges.append((start, part - 1))
                start = -1
                if len(ranges) == limit:
                    break
        return ranges

    def progress(self, number: int) -> int:
        """Return the first part of a message that is lacking (0 for one never seen)."""
        message = self._unfinished.get(number)
        return 0 if message is None else message.hashed

    def close(self) -> None:
        """Give back everything."""
        for number in list(self._unfinished):
            self._drop(number)
