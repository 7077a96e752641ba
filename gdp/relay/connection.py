"""Protocol of one relay connection: handshake, authentication, opening, frames, keepalives and its end.

Sans-I/O. Its user passes ciphertext, frames and the time in, and takes ciphertext and frames out::

    HANDSHAKE -> OPENING -> OPEN -> CLOSED       a failure leads from each state to CLOSED

    client  OPENING: has sent "open" with its MTU, waits for "accepted" or "refused"
    server  OPENING: has verified the client, waits for "open"

No byte of a frame passes before OPEN. A connection without a received byte for ``dead_s`` is dead, because each end
sends a keepalive after ``keepalive_s`` without other data.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final

from gdp.crypto.certificates import Membership
from gdp.errors import FrameError
from gdp.frame.codec import ETHER_BYTES
from gdp.intervals import CONNECT_S
from gdp.relay.admission import RelayRefusedError
from gdp.relay.frame_queue import FrameQueue
from gdp.relay.framing import KEEPALIVE, PREFIX, ControlMessage, ControlType, Deframer, is_gdp_frame, mtu_of
from gdp.relay.tls_channel import RECORD_BYTES, TlsChannel, TlsError
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBucket

_BATCH_RECORDS: Final = 4  # of one call of ``data_to_send``
_WAITING_MAX_BYTES: Final = 2 * _BATCH_RECORDS * RECORD_BYTES  # frames leave in batches of half of it
_BURST_S: Final = 0.25
_BURST_MIN_BYTES: Final = 2 * RECORD_BYTES

Limits = tuple[TokenBucket, TokenBucket]
Authenticate = Callable[[bytes, Timestamps], Membership]  # certificate, DER; raises RelayRefusedError


class ConnectionState(Enum):
    """State of a connection."""

    HANDSHAKE = "handshake"
    OPENING = "opening"
    OPEN = "open"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionSettings:
    """Settings of a connection.

    Args:
        mtu: largest frame without its Ethernet header; the smaller one of both ends applies.
        keepalive_s: seconds without data after which an end sends a keepalive.
        dead_s: seconds without a received byte after which the connection is dead.
        queue_bytes: bytes of frames that wait at most.
        rate: bytes of frames a second in each direction; None: without a limit.
    """

    mtu: int
    keepalive_s: float
    dead_s: float
    queue_bytes: int
    rate: float | None = None


@dataclass(slots=True)
class ConnectionCounters:
    """Counters of one connection, or the sum of several; bytes are those of frames.

    Args:
        foreign: frames of another EtherType, or shorter than a header.
        too_big: frames above the MTU.
        full: frames that found the queue full.
        refused: frames that the device did not take.
    """

    frames_in: int = 0
    frames_out: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    foreign: int = 0
    too_big: int = 0
    full: int = 0
    refused: int = 0

    def add(self, other: ConnectionCounters) -> None:
        """Add the counts of an ended connection."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))


class RelayConnection:
    """One end of a connection.

    Args:
        authenticate: verifies the other end's certificate and decides on it.

    Attributes:
        peer: the authenticated other end; None before.
        mtu: of the open connection.
        reason: why the connection is closed.
        was_refused: whether one of the ends refused the other, so that a new attempt is of little use soon.
        limits: what the rate allows now in both directions: in, out; None: all. The connections of one client share it.
    """

    def __init__(
        self,
        *,
        context: ssl.SSLContext,
        is_server: bool,
        host: str = "",
        settings: ConnectionSettings,
        authenticate: Authenticate,
        now_s: float,
    ) -> None:
        self._tls = TlsChannel(context, is_server=is_server, host=host)
        self._is_server = is_server
        self._settings = settings
        self._authenticate = authenticate
        self._deframer = Deframer()
        self._queue = FrameQueue(settings.queue_bytes)
        self._begun_s = self._heard_s = self._sent_s = now_s
        self.limits = _limits(settings.rate)
        self._counters = ConnectionCounters()
        self.state = ConnectionState.HANDSHAKE
        self.peer: Membership | None = None
        self.mtu = settings.mtu
        self.reason = ""
        self.was_refused = False
        if not is_server:
            self._tls.shake_hands()

    @property
    def counters(self) -> ConnectionCounters:
        """Return the counters; those of the queue are up to date."""
        self._counters.full = self._queue.dropped
        return self._counters

    @property
    def queued_bytes(self) -> int:
        """Return the bytes that wait in the queue."""
        return self._queue.held_bytes

    @property
    def receive_size(self) -> int:
        """Return how many bytes to read at once: less under a rate, which would otherwise be exceeded in bursts."""
        return RECORD_BYTES if self.limits is not None else _BATCH_RECORDS * RECORD_BYTES

    def receive_bytes(self, data: bytes, now: Timestamps) -> list[memoryview]:
        """Take in ciphertext, empty at the end of the stream; return the frames in it."""
        if self.state is ConnectionState.CLOSED:
            return []
        if not data:
            self._close("the other end closed the connection")
            return []
        self._heard_s = now.mono_s
        frames: list[memoryview] = []
        try:
            for plain in self._tls.receive_bytes(data):
                if self.state is ConnectionState.HANDSHAKE:
                    self._established(now)
                frames += self._received(plain)
            if self.state is ConnectionState.HANDSHAKE and self._tls.is_established:
                self._established(now)
        except RelayRefusedError as refusal:
            self.refuse(str(refusal))
        except (TlsError, FrameError) as error:
            self._close(str(error))
        if self._tls.waiting_bytes > _WAITING_MAX_BYTES:  # each request for new keys is answered (RFC 8446, 4.6.3)
            self._close("the other end requests more than it reads")
        size = sum(map(len, frames))
        self._counters.frames_in += len(frames)
        self._counters.bytes_in += size
        if self.limits is not None:
            self.limits[0].charge(now.mono_s, size)
        return frames

    def queue_frame(self, frame: bytes) -> None:
        """Queue a frame from the device; one that may not pass is dropped and counted."""
        if not is_gdp_frame(frame):
            self._counters.foreign += 1
        elif len(frame) > self.mtu + ETHER_BYTES:
            self._counters.too_big += 1
        else:
            self._queue.put(frame)

    def data_to_send(self, now_s: float) -> bytes:
        """Return the next ciphertext, at most some records; empty if there is none, or if the rate does not allow it.

        The user sends all of it before the next call, and closes a CLOSED connection after it.
        """
        if self.state is ConnectionState.OPEN:
            self._encrypt_frames(now_s)
        data = self._tls.data_to_send()
        if data:
            self._sent_s = now_s
        return data

    def pause_until_s(self, now_s: float) -> float:
        """Return the monotonic second until which the rate allows no reading; in the past: it does."""
        return now_s if self.limits is None else now_s + self._owed_s(self.limits[0], now_s)

    def get_timer(self, now_s: float) -> float:
        """Return the monotonic second of the next call of ``handle_timer``."""
        if self.state is not ConnectionState.OPEN:
            return self._begun_s + CONNECT_S
        times = [self._heard_s + self._settings.dead_s, self._sent_s + self._settings.keepalive_s]
        if self.limits is not None and len(self._queue):
            times.append(now_s + self._owed_s(self.limits[1], now_s))
        return min(times)

    def handle_timer(self, now_s: float) -> None:
        """Send a keepalive or end a dead connection, where it is due."""
        if self.state in (ConnectionState.HANDSHAKE, ConnectionState.OPENING):
            if now_s >= self._begun_s + CONNECT_S:
                self._close(f"the handshake took longer than {CONNECT_S:g} s")
        elif self.state is ConnectionState.OPEN:
            if now_s >= self._heard_s + self._settings.dead_s:
                self._close(f"no sign of life for {self._settings.dead_s:g} s")
            elif now_s >= self._sent_s + self._settings.keepalive_s:
                self._sent_s = now_s
                if not self._tls.waiting_bytes:  # else these bytes are a sign of life, too
                    self._tls.write(KEEPALIVE)

    def refuse(self, sentence: str) -> None:
        """Close the connection with a sentence for the other end."""
        if self._tls.is_established and self.state is not ConnectionState.CLOSED:
            self._tls.write(ControlMessage.refusal(sentence).to_wire())
        self._close(sentence)
        self.was_refused = True

    def close(self, reason: str) -> None:
        """Close the connection, such as for a newer one."""
        self._close(reason)

    def _established(self, now: Timestamps) -> None:
        """Authenticate the other end; a client then asks to open."""
        self.peer = self._authenticate(self._tls.certificate, now)
        self.state = ConnectionState.OPENING
        if not self._is_server:
            self._tls.write(ControlMessage.with_mtu(ControlType.OPEN, self._settings.mtu).to_wire())

    def _received(self, plain: bytes) -> list[memoryview]:
        """Return the frames that may pass, and handle control messages."""
        frames, controls = self._deframer.receive_bytes(plain)
        was_open = self.state is ConnectionState.OPEN
        for message in controls:
            self._control(message)
        if not frames or not was_open:  # a peer sends frames only after "accepted", so they never share a read with it
            self._counters.foreign += len(frames)
            return []
        good = [frame for frame in frames if is_gdp_frame(frame)]
        self._counters.foreign += len(frames) - len(good)
        return good

    def _control(self, message: ControlMessage) -> None:
        match message.type, self.state, self._is_server:
            case ControlType.KEEPALIVE, _, _:
                pass
            case ControlType.OPEN, ConnectionState.OPENING, True:
                self._open(mtu_of(message))
                self._tls.write(ControlMessage.with_mtu(ControlType.ACCEPTED, self.mtu).to_wire())
            case ControlType.ACCEPTED, ConnectionState.OPENING, False:
                self._open(mtu_of(message))
            case ControlType.REFUSED, _, _:
                self._close(_printable(message.body))
                self.was_refused = True
            case _:
                self._close(f"an unexpected {message.type.name.lower()} message")

    def _open(self, mtu: int) -> None:
        self.mtu = min(mtu, self._settings.mtu)
        self.state = ConnectionState.OPEN

    def _encrypt_frames(self, now_s: float) -> None:
        bucket = None if self.limits is None else self.limits[1]
        for _ in range(_BATCH_RECORDS):
            if not len(self._queue) or (bucket is not None and bucket.left(now_s) < 0):
                return
            frames = self._queue.take(RECORD_BYTES)
            pack = PREFIX.pack
            parts: list[bytes] = []
            for frame in frames:
                parts += (pack(len(frame)), frame)
            self._tls.write(plain := b"".join(parts))
            size = len(plain) - PREFIX.size * len(frames)
            self._counters.frames_out += len(frames)
            self._counters.bytes_out += size
            if bucket is not None:
                bucket.charge(now_s, size)

    def _owed_s(self, bucket: TokenBucket, now_s: float) -> float:
        """Return the seconds until a bucket owes nothing."""
        rate = self._settings.rate
        return 0.0 if rate is None else max(-bucket.left(now_s) / rate, 0.0)

    def _close(self, reason: str) -> None:
        if self.state is not ConnectionState.CLOSED:
            self.state = ConnectionState.CLOSED
            self.reason = reason
            self._queue.clear()


def _limits(rate: float | None) -> Limits | None:
    """Return the buckets of both directions: in, out."""
    if rate is None:
        return None
    burst = max(rate * _BURST_S, _BURST_MIN_BYTES)
    return TokenBucket(rate, burst), TokenBucket(rate, burst)


def _printable(text: bytes) -> str:
    """Return a sentence of the other end, without what a terminal would act on."""
    return "".join(each if each.isprintable() else "?" for each in text.decode(errors="replace"))
