"""IPC between the proxy and its rospy process: frames with a short header on a non-blocking socket pair.

I/O; on a given socket. Both sides are the same program, so nothing here defends against the peer.

    0        4      5        13       21
    | length | kind | handle | number | payload, ``length`` bytes
    little-endian; handle: the endpoint's; number: a call, a ticket, a stamp, a question or a count, by kind.

A message is sent in one gathering write, uncopied, while the peer keeps up. The rest waits in a bounded queue: when the
budget is spent, the oldest waiting message of the same topic is dropped and counted.
"""

from __future__ import annotations

import itertools
import socket
import struct
import threading
from collections import defaultdict, deque
from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

_HEAD: Final = struct.Struct("<IBqq")
_CHUNK_BYTES: Final = 65_536
_BUDGET_BYTES: Final = 64 << 20
_TURN_BYTES: Final = 4 << 20  # received in one go, so that the caller's other work does not wait
_GATHER: Final = 64  # waiting frames in one write


class Kind(IntEnum):
    """Kind of a frame. Down: to rospy; up: from it."""

    # down: each creates the handle
    SUBSCRIBE = 1
    ADVERTISE = 2
    SERVE = 3
    DIAL = 4
    # down
    CLOSE = 5
    PUBLISH = 6
    ANSWER = 7
    REFUSE = 8
    CALL = 9
    DROP = 10
    ASK_CHANNEL = 11  # number: the question
    ASK_SERVICE = 12
    # up
    GRAPH = 32
    DESCRIBED = 33
    HEARD = 34  # number: the stamp
    ASKED = 35
    ANSWERED = 36
    FAILED = 37
    FAULTED = 38  # handle 0: all
    COUNTED = 39  # number: subscribers
    KNOWN = 40  # number: the question
    UNKNOWN = 41
    LOST = 42  # total of messages dropped because the queue was full
    ENDING = 43  # reason why the process ends


_MESSAGES: Final = frozenset({Kind.PUBLISH, Kind.HEARD})
_REQUESTS: Final = frozenset({Kind.CALL, Kind.ASKED})


class LinkEndedError(Exception):
    """The other process is gone."""


class Frame(NamedTuple):
    """One frame."""

    kind: Kind
    handle: int
    number: int
    payload: bytes


class _Waiting:
    """A frame that the socket has not accepted; of size 0 once it was sent or dropped. ``topic``: it may be dropped."""

    __slots__ = ("size", "topic", "views")

    def __init__(self, views: list[memoryview], topic: int | None) -> None:
        self.views = views
        self.size = sum(map(len, views))
        self.topic = topic


class IpcLink:
    """One side of the link. ``send`` may be called from any thread; the rest from one."""

    def __init__(self, sock: socket.socket, behind: Callable[[], None], *, budget_bytes: int = _BUDGET_BYTES) -> None:
        """Own a stream socket; ``behind`` is called, from any thread, when a frame begins to wait."""
        sock.setblocking(False)
        self.dropped = 0
        self._sock = sock
        self._behind = behind
        self._budget_bytes = budget_bytes
        self._lock = threading.Lock()
        self._queue: deque[_Waiting] = deque()
        self._topics: defaultdict[int, deque[_Waiting]] = defaultdict(deque)
        self._waiting_bytes = 0
        self._small = bytearray()
        self._large: tuple[tuple[int, int, int], bytearray] | None = None
        self._filled = 0

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._sock.fileno()

    @property
    def is_behind(self) -> bool:
        """Return whether frames wait: call ``flush`` when the socket is writable."""
        return bool(self._queue)

    def send(self, kind: Kind, handle: int = 0, number: int = 0, payload: bytes = b"") -> bool:
        """Send or queue a frame; return False if it was not accepted, which only happens to messages and requests.

        A frame for a process that is gone counts as sent: ``receive`` reports the end.
        """
        views = [memoryview(_HEAD.pack(len(payload), kind, handle, number)), memoryview(payload)]
        with self._lock:
            if not self._queue:
                views = self._write(views)
                if not views:
                    return True
            elif not self._free_space(kind, handle, len(payload)):
                return False
            is_whole = len(views) == 2 and len(views[0]) == _HEAD.size
            waiting = _Waiting(views, handle if is_whole and kind in _MESSAGES else None)
            if not self._queue:
                self._behind()
            self._queue.append(waiting)
            self._waiting_bytes += waiting.size
            if waiting.topic is not None:
                self._topics[waiting.topic].append(waiting)
            return True

    def flush(self) -> None:
        """Write waiting frames, as far as the socket accepts them."""
        with self._lock:
            while self._queue:
                batch = list(itertools.islice(self._queue, _GATHER))
                before = sum(waiting.size for waiting in batch)
                left = self._write([view for waiting in batch for view in waiting.views])
                sent = before - sum(map(len, left))
                self._waiting_bytes -= sent
                for waiting in batch:
                    if waiting.size > sent:
                        if sent:
                            self._begin(waiting, sent)
                        return
                    sent -= waiting.size
                    self._undroppable(waiting)
                    self._queue.popleft()

    def poll_frames(self) -> list[Frame]:
        """Return the received frames, up to some megabytes of them.

        Raises:
            LinkEndedError: the link has ended; frames read earlier were returned earlier.
        """
        frames: list[Frame] = []
        taken = 0
        while taken < _TURN_BYTES:
            try:
                count = self._read(frames)
            except BlockingIOError:
                break
            except ConnectionResetError:
                count = 0
            if not count:
                if frames:
                    break  # the next call reads the end again
                raise LinkEndedError
            taken += count
        return frames

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def _read(self, frames: list[Frame]) -> int:
        if self._large is not None:
            head, payload = self._large
            count = self._sock.recv_into(memoryview(payload)[self._filled :])
            self._filled += count
            if self._filled == len(payload):
                self._large = None
                frames.append(Frame(Kind(head[0]), head[1], head[2], bytes(payload)))
            return count
        chunk = self._sock.recv(_CHUNK_BYTES)
        small = self._small
        small += chunk
        at = 0
        while len(small) - at >= _HEAD.size:
            length, kind, handle, number = _HEAD.unpack_from(small, at)
            start = at + _HEAD.size
            if len(small) - start < length:
                if length > _CHUNK_BYTES:
                    payload = bytearray(length)
                    self._filled = len(small) - start
                    payload[: self._filled] = small[start:]
                    self._large = (kind, handle, number), payload
                    at = len(small)
                break
            frames.append(Frame(Kind(kind), handle, number, bytes(small[start : start + length])))
            at = start + length
        del small[:at]
        return len(chunk)

    def _write(self, views: list[memoryview]) -> list[memoryview]:
        """Return the part that the socket does not accept now."""
        views = [view for view in views if len(view)]
        while views:
            try:
                sent = self._sock.sendmsg(views)
            except BlockingIOError:
                return views
            except (BrokenPipeError, ConnectionResetError, OSError):
                return []
            while views and sent >= len(views[0]):
                sent -= len(views.pop(0))
            if sent:
                views[0] = views[0][sent:]
        return []

    def _free_space(self, kind: Kind, handle: int, size: int) -> bool:
        if self._waiting_bytes + size <= self._budget_bytes:
            return True
        if kind not in _MESSAGES:
            return kind not in _REQUESTS
        older = self._topics.get(handle)
        while older and self._waiting_bytes + size > self._budget_bytes:
            waiting = older.popleft()
            self._waiting_bytes -= waiting.size
            waiting.views = []
            waiting.size = 0
            waiting.topic = None
            self.dropped += 1
        if self._waiting_bytes + size <= self._budget_bytes:
            return True
        self.dropped += 1
        return False

    def _undroppable(self, waiting: _Waiting) -> None:
        """Protect the oldest frame of its topic from being dropped: frames of a topic are sent in order."""
        if waiting.topic is not None:
            older = self._topics[waiting.topic]
            older.popleft()
            if not older:
                del self._topics[waiting.topic]
            waiting.topic = None

    def _begin(self, waiting: _Waiting, sent: int) -> None:
        """Mark a frame whose first ``sent`` bytes are written, so that the rest must follow."""
        self._undroppable(waiting)
        left = []
        for view in waiting.views:
            if sent >= len(view):
                sent -= len(view)
            else:
                left.append(view[sent:])
                sent = 0
        waiting.views = left
        waiting.size = sum(map(len, left))
