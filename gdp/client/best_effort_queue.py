"""Best-effort queue: messages of a best-effort topic that have not been sent yet.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A message leaves whole or not at all: before its first frame is taken, it may be dropped because it would come too late.
Its frames are sealed when they are taken, so a dropped message costs no sealing. Source: DDS 1.4, section 2.2.3.16
(LIFESPAN).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from gdp.crypto.envelope import Sealed
from gdp.limits import SEQUENCE_BYTES, WINDOW_BYTES

FRESH_S: Final = 0.05  # without a deadline: after this time a message gives way to a newer one


class Carried(NamedTuple):
    """Content of one message number: the count of messages, and the sequence number of the first.

    ``added_s`` is when the newest of them was published; None until frames are polled, if the publisher did not say.
    """

    number: int
    sequence: int
    messages: int
    added_s: float | None = None


class BestEffortQueue:
    """Queue of sealed messages, each with its content; when it is full, the oldest are dropped.

    Attributes:
        deadline_s: a message that cannot leave whole within this time is too late. None: it is too late after
            ``FRESH_S``, if a newer one waits.
        waiting: frames and content of each message, the oldest first.
    """

    def __init__(self, deadline_s: float | None = None) -> None:
        self.deadline_s = deadline_s
        self.waiting = deque[tuple[Sealed, Carried]]()
        self._held_bytes = 0
        self._part = 0  # of the oldest: the first that has not been sent

    @property
    def oldest(self) -> Carried | None:
        """Return the content that is sent next, or None."""
        return self.waiting[0][1] if self.waiting else None

    def add(self, frames: Sealed, carried: Carried) -> list[Carried]:
        """Queue a message, or a bundle; return what was dropped for it."""
        self.waiting.append((frames, carried))
        self._held_bytes += frames.size_bytes
        gone = []
        while self._held_bytes > WINDOW_BYTES and len(self.waiting) > 1:
            gone.append(self._let_oldest_go())
        return gone

    def drop_expired(self, now_s: float, bytes_s: float | None, *, is_followed: bool = False) -> list[Carried]:
        """Drop messages that would come too late, oldest first; return their contents.

        A message of which a frame was taken is never dropped.

        Args:
            bytes_s: bytes of frames per second that may leave; None or 0: unknown, so only the time of waiting counts.
            is_followed: newer messages wait outside this queue.
        """
        self._set_times(now_s)
        unstarted, gone = 1 if self._part else 0, list[Carried]()
        while len(self.waiting) > unstarted:
            frames, carried = self.waiting[unstarted]
            added_s = now_s if carried.added_s is None else carried.added_s
            has_newer = is_followed or len(self.waiting) > unstarted + 1
            if not is_expired(now_s - added_s, frames.size_bytes, self.deadline_s, bytes_s, has_newer=has_newer):
                break
            del self.waiting[unstarted]
            self._held_bytes -= frames.size_bytes
            gone.append(carried)
        return gone

    def drop_all(self) -> list[Carried]:
        """Drop all messages; return their contents, without one of which a frame was taken."""
        gone = [carried for _, carried in self.waiting][1 if self._part else 0 :]
        self.waiting.clear()
        self._held_bytes = self._part = 0
        return gone

    def poll_frames(self, limit: int, pace_of: Callable[[int], int] = lambda _size: 0) -> list[bytes]:
        """Return at most ``limit`` frames, in order, sealed as they are taken.

        Args:
            pace_of: returns the pace of a message of so many bytes.
        """
        frames: list[bytes] = []
        while self.waiting and limit > 0:
            oldest, first = self.waiting[0][0], self._part
            if not first and (pace := pace_of(oldest.size_bytes)):
                oldest.set_pace(pace)
            taken = oldest[first : first + limit]
            frames += taken
            count = len(taken)
            limit -= count
            self._part += count
            if self._part == oldest.parts:
                self._let_oldest_go()
        return frames

    def requeue(self, mtu: int) -> list[tuple[bytes, Carried]]:
        """Return everything, to be sealed again, if something is too large for its path; else nothing."""
        if all(frames.largest <= mtu for frames, _ in self.waiting):
            return []
        taken = [(frames.message()[SEQUENCE_BYTES:], carried) for frames, carried in self.waiting]
        self.waiting.clear()
        self._held_bytes = self._part = 0
        return taken

    def _set_times(self, now_s: float) -> None:
        """Let messages without a time wait from now on; they are the newest ones."""
        for at in range(len(self.waiting) - 1, -1, -1):
            frames, carried = self.waiting[at]
            if carried.added_s is not None:
                return
            self.waiting[at] = frames, carried._replace(added_s=now_s)

    def _let_oldest_go(self) -> Carried:
        frames, carried = self.waiting.popleft()
        self._held_bytes -= frames.size_bytes
        self._part = 0
        return carried


def is_expired(
    waited_s: float, size_bytes: int, deadline_s: float | None, bytes_s: float | None, *, has_newer: bool
) -> bool:
    """Return whether a message that starts now would come too late.

    Args:
        size_bytes: of its frames.
        deadline_s: as in ``SendOptions``.
        bytes_s: bytes of frames per second that may leave; None or 0: unknown.
        has_newer: a newer message waits.
    """
    if deadline_s is None:
        return has_newer and waited_s > FRESH_S
    return waited_s + (size_bytes / bytes_s if bytes_s else 0.0) > deadline_s
