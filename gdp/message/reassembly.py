"""Reassembly of the fragments of one source's messages, in any order of arrival.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: IPv4 reassembly (RFC 815).

A fragment is opened before it is kept, so injected or altered bytes cost no memory. A ``ReassemblyQuota`` bounds the
memory, and a timeout releases it. The running hash follows the fragments in order. A fragment that came early keeps its
ciphertext until the hash has reached it.

A holder of the topic's secret can make fragments that open, though never a message that verifies. So the effect of such
a fragment is never permanent. A message whose signature is bad is forgotten, not finished. Of two counts of fragments,
or two salts, the later one is valid. When there are too many unfinished messages, the one that is needed last is
evicted. Without signatures, under a session secret, only the writer can make fragments that open.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from gdp import burst
from gdp.burst.cipher import BODY_AT, TAG_BYTES, Plaintext
from gdp.crypto.envelope import SEAL_BYTES, SHARED_FLAGS, Opened, Opener, digest_of, salt_of
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import DESTINATION_AT, HEADER_BYTES, HOPS_MASK, NUMBER_AT, PACE_AT, PART_AT, Flag, Header
from gdp.limits import HOPS_MAX, JOIN_MESSAGES_MAX, JOIN_PATIENCE_S, REPLAY_WINDOW_MESSAGES
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.message.replay import ReplayWindow
from gdp.message.second_copies import REPEATED_PARTS_MAX, RepeatedFrames, SecondCopies
from gdp.message.striping import StripedPaths
from gdp.sansio import ReceivedFrame, new_tuple

ALL_PARTS = 0xFFFF_FFFF
_URGENT = int(Flag.URGENT)  # a plain number: an IntFlag's operators cost a microsecond each
_PREPAID_BYTES = 32 << 10  # memory is reserved ahead for this many bytes of a message whose fragments come in order
_PART_OVERHEAD_BYTES = 128  # overhead of a kept fragment, in addition to its bytes
SCAN_PARTS = 4_096  # examined at once for what is missing: more than an honest publisher has under way


class VerifiesDigest(Protocol):
    """A writer's public key, by which a message's digest is verified."""

    def verify_digest(self, signature: bytes, digest: bytes) -> None:
        """Verify a signature; raise a ``RemoteError`` if it is invalid."""


class ReassembledMessage(NamedTuple):
    """A complete message, opened and verified; a tuple because it is on the hot path."""

    number: int
    flags: int
    message: bytes
    parts: int
    hops: int  # switches passed by the fragment with the longest path
    head: bytes = b""  # the first bytes under the seal, before the message: ``head_bytes`` of its reassembler


@dataclass(slots=True, kw_only=True)
class _PartialMessage:
    parts: int
    salt: bytes
    opener: Opener
    running: hashlib._Hash | None  # None: the message has no signature
    touched_s: float
    head: bytes = b""  # header and salt of the newest fragment that came in order
    length: int = 0  # its payload bytes
    before: bytes = b""  # of the plaintext, what comes before the message
    plain: Plaintext = field(init=False)  # from the first fragment on
    early: dict[int, tuple[bytes, bytes]] = field(default_factory=dict)  # plaintext and ciphertext ahead of these
    hashed: int = 0  # fragments in ``plain``, which the hash has taken
    top: int = -1  # highest fragment held
    signature: bytes = b""
    held_bytes: int = 0
    prepaid_bytes: int = 0  # of ``held_bytes``, not yet used
    hops: int = 0

    def append(self, plain: bytes, sealed: bytes) -> None:
        """Append the next fragment."""
        self.plain.append(plain)
        self.hashed += 1
        if self.running is not None:
            self.running.update(sealed)


class Reassembler:
    """Reassembler of the messages of one source's incarnation to one destination.

    Args:
        source: name whose quota is charged.
        opener_of: returns the opener of a key epoch, or raises ``EnvelopeError`` (UNKNOWN_EPOCH).
        writer: the key that must have signed; None: the openers are of a session secret, whose seals prove the writer.
        budget: shared by all reassemblers of the node.
        patience_s: an unfinished message is dropped this long after its last new fragment.

    Attributes:
        head_bytes: how many bytes come before each message; fewer than any first fragment has.
        copies: delay of the second copies, of a source that sends each frame over two paths; None: it does not.
        repeats: copies of urgent frames over one path.
        unfinished_bytes: memory that unfinished messages hold.
        full_parts: fragments that came of messages of several, without the last ones, which are shorter.
    """

    def __init__(
        self,
        source: bytes,
        opener_of: Callable[[int], Opener],
        writer: VerifiesDigest | None,
        budget: ReassemblyQuota,
        *,
        patience_s: float = JOIN_PATIENCE_S,
    ) -> None:
        self.head_bytes = 0
        self._source = source
        self._opener_of = opener_of
        self._writer = writer
        self._budget = budget
        self._patience_s = patience_s
        self._unfinished: dict[int, _PartialMessage] = {}
        self.unfinished_bytes = 0
        budget.register(self, source)
        self.window = ReplayWindow()
        self.drops: Counter[DropReason] = Counter()
        self.highest = -1  # highest message number of which an authentic fragment came
        self.new_parts = 0
        self.full_parts = 0
        self.copies: SecondCopies | StripedPaths | None = None
        self.repeats = RepeatedFrames()
        self._under_way = -1  # number of the message whose next fragments are expected

    def add_batch(self, arrivals: Sequence[ReceivedFrame], at: int, now_s: float) -> int:
        """Add frames of ``arrivals[at:]`` that continue the message under way with inner fragments in order.

        They follow all that came, or the newest fragment behind a gap. Almost every fragment of a large message takes
        this short path. The frame that ends the run is for ``add``.

        Returns:
            how many were added.
        """
        message = self._unfinished.get(self._under_way)
        if message is None:
            return 0
        frame, head, first = arrivals[at].frame, message.head, message.top + 1
        if (
            frame[NUMBER_AT:PACE_AT] != head[NUMBER_AT:PART_AT] + first.to_bytes(4, "big")
            or frame[DESTINATION_AT:BODY_AT] != head[DESTINATION_AT:]
        ):
            return 0  # a frame of another message
        wanted = min(len(arrivals) - at, message.parts - 1 - first)
        if wanted <= 0:
            return 0
        taken = (self._add_early if message.early else self._add_next)(message, wanted, arrivals, at)
        if taken:
            message.top += taken
            message.touched_s = now_s
            self.new_parts += taken
            self.full_parts += taken
        return taken

    def _add_early(self, message: _PartialMessage, wanted: int, arrivals: Sequence[ReceivedFrame], at: int) -> int:
        size, length, first = message.length - SEAL_BYTES, message.length, message.top + 1
        cost = 2 * size + TAG_BYTES + _PART_OVERHEAD_BYTES
        if self.copies is not None or not self._reserve_memory(wanted * cost):
            return 0
        cipher, plain = message.opener.cipher_of(message.salt), burst.PLAINTEXT(wanted * size)
        taken = cipher.open_run(message.head, length, first, wanted, arrivals, at, None, plain)
        self._release_memory((wanted - taken) * cost)
        message.held_bytes += taken * cost
        opened = plain.collect()
        for each, arrival in enumerate(arrivals[at : at + taken]):
            sealed = arrival.frame[BODY_AT : HEADER_BYTES + length]
            message.early[first + each] = opened[each * size : (each + 1) * size], sealed
        return taken

    def _add_next(self, message: _PartialMessage, wanted: int, arrivals: Sequence[ReceivedFrame], at: int) -> int:
        cost = message.length + _PART_OVERHEAD_BYTES
        if message.prepaid_bytes < wanted * cost:
            if not self._reserve_memory(_PREPAID_BYTES + wanted * cost):
                return 0
            message.held_bytes += _PREPAID_BYTES + wanted * cost
            message.prepaid_bytes += _PREPAID_BYTES + wanted * cost
        cipher, span = message.opener.cipher_of(message.salt), (message.length, message.hashed, wanted)
        taken = cipher.open_run(message.head, *span, arrivals, at, message.running, message.plain)
        message.hashed += taken
        message.prepaid_bytes -= taken * cost
        return taken

    def add(self, header: Header, frame: bytes, now_s: float) -> ReassembledMessage | None:
        """Add one fragment; return the message that it completes, if any. Errors are counted in ``drops``."""
        number = header.number
        if self.window.is_finished(number):
            self.drop_copy(header, DropReason.LATE, now_s)
            return None
        message = self._unfinished.get(number)
        is_same = message is not None and message.parts == header.parts and message.salt == salt_of(frame)
        if is_same and message is not None and (header.part < message.hashed or header.part in message.early):
            self.drop_copy(header, DropReason.DUPLICATE, now_s)
            return None
        try:
            opener = self._opener_of(header.epoch)
            opened = opener.open(header, frame)
        except EnvelopeError as error:
            self.drops[error.reason] += 1
            return None
        if header.parts == 1:
            return self._take_whole(header, frame, opened, now_s)
        if message is None and not self._free_space(number):
            self.drops[DropReason.MEMORY_FULL] += 1
            return None
        if message is None or not is_same:
            message = self._start(header, frame, opener, now_s)
        return self._keep(message, header, frame, opened, now_s)

    def drop_copy(self, header: Header, reason: DropReason, now_s: float) -> None:
        """Count a fragment that was here before: for ``reason``, or as a second copy where each may have one."""
        if self.copies is None:
            is_repeat = header.flags & _URGENT and self.repeats.handle_copy(header.number, header.part, now_s)
            self.drops[DropReason.SECOND_COPY if is_repeat else reason] += 1
            return
        self.drops[DropReason.SECOND_COPY] += 1
        self.copies.handle_copy(header.number, header.part, now_s)

    def _take_whole(self, header: Header, frame: bytes, opened: Opened, now_s: float) -> ReassembledMessage | None:
        number, (plain, sealed, signature) = header.number, opened
        if self._writer is not None:
            running = digest_of(frame)
            running.update(sealed)
            if not self._is_signed(signature, running):
                return None
        if number in self._unfinished:  # another sender stated a larger number of fragments
            self._drop(number)
            self.drops[DropReason.BAD_PARTS] += 1
        self.highest = number if number > self.highest else self.highest
        self.new_parts += 1
        self.window.finish(number)
        if self.copies is not None:
            self.copies.handle_first(number, 0, now_s)
        elif header.flags & _URGENT:
            self.repeats.handle_first(number, 0, now_s)
        head, message = plain[: self.head_bytes], plain[self.head_bytes :]
        hops = HOPS_MAX - (header.hops_left & HOPS_MASK)
        hops = hops if hops > 0 else 0  # it states more than a source may
        return new_tuple(ReassembledMessage, (number, header.flags & SHARED_FLAGS, message, 1, hops, head))

    def _start(self, header: Header, frame: bytes, opener: Opener, now_s: float) -> _PartialMessage:
        """Return a new partial message; it replaces one with another number of fragments, or another salt."""
        if header.number in self._unfinished:
            self.drops[DropReason.BAD_PARTS] += 1
            self._drop(header.number)
        return _PartialMessage(
            parts=header.parts,
            salt=salt_of(frame),
            opener=opener,
            running=None if self._writer is None else digest_of(frame),
            touched_s=now_s,
        )

    def _keep(
        self, message: _PartialMessage, header: Header, frame: bytes, opened: Opened, now_s: float
    ) -> ReassembledMessage | None:
        number, (plain, sealed, signature) = header.number, opened
        in_order = header.part == message.hashed
        cost = len(plain) + _PART_OVERHEAD_BYTES + (0 if in_order else len(sealed))
        if not self._reserve(number, cost):
            self.drops[DropReason.MEMORY_FULL] += 1
            return None
        self._unfinished[number] = message
        self.highest = max(self.highest, number)
        self.new_parts += 1
        self.full_parts += header.part < header.parts - 1
        message.held_bytes += cost
        message.touched_s = now_s
        message.top = max(message.top, header.part)
        message.hops = max(message.hops, HOPS_MAX - (header.hops_left & HOPS_MASK))
        if self.copies is not None:
            self.copies.handle_first(number, header.part, now_s)
        elif header.flags & _URGENT and header.parts <= REPEATED_PARTS_MAX:
            self.repeats.handle_first(number, header.part, now_s)
        if signature:
            message.signature = signature
        if in_order or header.part < header.parts - 1:
            message.head, message.length = frame[:BODY_AT], header.length
            self._under_way = number
        if in_order:
            if not header.part:
                message.plain = burst.PLAINTEXT(header.parts * len(plain))
                message.before, plain = plain[: self.head_bytes], plain[self.head_bytes :]
            message.append(plain, sealed)
            while message.early and (early := message.early.pop(message.hashed, None)) is not None:
                message.append(*early)
                message.held_bytes -= len(early[1])
                self._release_memory(len(early[1]))
        else:
            message.early[header.part] = plain, sealed
        return self._finish(header, message) if message.hashed == message.parts else None

    def _finish(self, header: Header, message: _PartialMessage) -> ReassembledMessage | None:
        number = header.number
        self._drop(number)
        if message.running is not None and not self._is_signed(message.signature, message.running):
            return None  # not finished: the writer's own fragments may still come
        self.window.finish(number)
        return ReassembledMessage(
            number=number,
            flags=header.flags & SHARED_FLAGS,
            message=message.plain.collect(),
            parts=message.parts,
            hops=message.hops,
            head=message.before,
        )

    def _is_signed(self, signature: bytes, running: hashlib._Hash) -> bool:
        assert self._writer is not None  # else nothing is hashed
        try:
            self._writer.verify_digest(signature, running.digest())
        except RemoteError as error:
            self.drops[error.reason] += 1
            return False
        return True

    def _drop(self, number: int) -> None:
        self._release_memory(self._unfinished.pop(number).held_bytes)

    @property
    def frames(self) -> int:
        """Return how many frames came that were new, or a copy against loss."""
        return self.new_parts + self.repeats.copies

    def give_way(self) -> None:
        """Drop the message that is needed last, because a stream that holds less needs the memory."""
        if self._unfinished:
            self._drop(max(self._unfinished))
            self.drops[DropReason.ABANDONED] += 1

    def _reserve_memory(self, size: int) -> bool:
        is_taken = self._budget.reserve(self._source, size, self)
        self.unfinished_bytes += size if is_taken else 0
        return is_taken

    def _release_memory(self, size: int) -> None:
        self.unfinished_bytes -= size
        self._budget.release(self._source, size)

    def _free_space(self, number: int) -> bool:
        """Return whether one more message may begin; the highest number is evicted for a lower one."""
        if len(self._unfinished) < JOIN_MESSAGES_MAX:
            return True
        highest = max(self._unfinished)
        if number > highest:
            return False
        self._drop(highest)
        self.drops[DropReason.ABANDONED] += 1
        return True

    def _reserve(self, number: int, cost: int) -> bool:
        """Reserve memory for a fragment of a message, if need be from messages with higher numbers."""
        while not self._reserve_memory(cost):
            highest = max(self._unfinished, default=-1)
            if number >= highest:
                return False
            self._drop(highest)
            self.drops[DropReason.ABANDONED] += 1
        return True

    def start_at(self, first: int, finished: Collection[int]) -> None:
        """Set the first number that counts; forget all earlier state, except for these finished messages.

        Unfinished messages from ``first`` on stay as far as the replay window reaches.
        """
        for number in [n for n in self._unfinished if not 0 <= n - first < REPLAY_WINDOW_MESSAGES]:
            self._drop(number)
        self.window = ReplayWindow()
        for number in finished:
            self.window.finish(number)
        self.highest = max([first - 1, *finished, *self._unfinished])

    def skip(self, number: int) -> None:
        """Mark a message as finished: it is here under another number."""
        if number in self._unfinished:
            self._drop(number)
        self.window.finish(number)

    def give_up(self, number: int) -> None:
        """Give up one message; its late fragments are dropped."""
        if number in self._unfinished:
            self._drop(number)
            self.drops[DropReason.ABANDONED] += 1
        self.window.finish(number)

    def forget(self, below: int) -> int:
        """Give up every message numbered under ``below``; return how many unfinished ones that ended."""
        ended = 0
        for number in [number for number in self._unfinished if number < below]:
            self._drop(number)
            self.window.finish(number)
            self.drops[DropReason.ABANDONED] += 1
            ended += 1
        return ended

    def drop_expired(self, now_s: float, *, for_good: bool = True) -> int:
        """Drop messages that waited longer than the timeout; return how many.

        Args:
            for_good: their late fragments are dropped; otherwise they may begin again, and be requested.
        """
        late = [n for n, message in self._unfinished.items() if now_s - message.touched_s >= self._patience_s]
        for number in late:
            self._drop(number)
            self.drops[DropReason.ABANDONED] += 1
            if for_good:
                self.window.finish(number)
        if late and not for_good:
            self.highest = max([self.window.top, *self._unfinished])  # an expired message may never have existed
        return len(late)

    def next_expiry(self) -> float | None:
        """Return the monotonic second at which ``drop_expired`` has something to do, or None."""
        if not self._unfinished:
            return None
        return min(message.touched_s for message in self._unfinished.values()) + self._patience_s

    def is_finished(self, number: int) -> bool:
        """Return whether a message is complete or given up."""
        return self.window.is_finished(number)

    def missing(self, number: int, limit: int, *, to_end: bool = False) -> list[tuple[int, int]]:
        """Return the missing fragments of a message as inclusive ranges; of one never seen, ``(0, 2**32 - 1)``.

        Of the newest message only gaps count, unless ``to_end``: fragments beyond the highest one may be under way. No
        more than ``SCAN_PARTS`` fragments are examined; further gaps show when these are filled.
        """
        if self.window.is_finished(number):
            return []
        message = self._unfinished.get(number)
        if message is None:
            return [(0, ALL_PARTS)] if to_end or number < self.highest else []
        ranges: list[tuple[int, int]] = []
        lacking_from = message.hashed
        seen_to = min(message.top + 1, message.hashed + SCAN_PARTS)
        for part in range(message.hashed, seen_to):
            if part in message.early:
                if lacking_from < part:
                    ranges.append((lacking_from, part - 1))
                lacking_from = part + 1
        if seen_to <= message.top:
            if not ranges:
                ranges.append((lacking_from, seen_to - 1))
        elif lacking_from < message.parts and (to_end or number != self.highest):
            ranges.append((lacking_from, message.parts - 1))
        return ranges[:limit]

    def progress(self, number: int) -> int:
        """Return the first missing fragment of a message (0 for one never seen)."""
        message = self._unfinished.get(number)
        return 0 if message is None else message.hashed

    def extent(self, number: int) -> tuple[int, int, float] | None:
        """Return the count of fragments of an unfinished message, the highest one held, and when the last new one came.

        None: the message is finished, or nothing of it is held.
        """
        message = self._unfinished.get(number)
        return None if message is None else (message.parts, message.top, message.touched_s)

    def close(self) -> None:
        """Release all memory."""
        for number in list(self._unfinished):
            self._drop(number)
