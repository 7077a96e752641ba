"""Keepalives: short frames between neighbours that are up, authenticated by a key of their two sessions.

Sans-I/O. Source: RFC 5880 (BFD): intervals and detection time, section 6.8; poll and final, section 6.5; keyed digest
with a meticulously rising sequence number, section 6.7.4. Two points differ. Sessions begin with signed hellos
(``hello.py``). A poll is sent when silence begins, so that a few lost frames do not end a session.

The payload of a frame of kind KEEPALIVE, whose message number is the sequence number::

    0 flags (1)   1 detect multiplier (1)  2 digest of link states (8)
   10 count (8)  18 echoed count (8)  26 held, microseconds (4)  30 loss, in 255ths (1)  31 tag (16)

The tag is HMAC-SHA256 over header and payload up to the tag, cut to 16 bytes. An overloaded node requests a larger
multiplier (``Slowness``), so that its neighbours wait longer for it while its machine is busy. The second line measures
the link (``link_quality.py``).
"""

from __future__ import annotations

import hmac
import math
import struct
from dataclasses import dataclass, field
from typing import Final

from gdp.control.hello import DIGEST_BYTES, MULTIPLIER_MAX, Timing
from gdp.control.link_probe import LinkProbe
from gdp.control.link_quality import LinkQuality, LinkReport
from gdp.crypto.exchange import ExchangeKey
from gdp.errors import DropReason, FrameError
from gdp.frame.codec import HEADER_BYTES, Flag, Header, KeepaliveFlag, Kind, encode
from gdp.intervals import NEVER_S
from gdp.limits import HOPS_MAX
from gdp.names import ZERO
from gdp.sansio import KeepaliveRun

TAG_BYTES: Final = 16
_DIGEST_AT: Final = HEADER_BYTES + 2
REPORT: Final = struct.Struct(">QQIB")  # LinkReport
REPORT_AT: Final = _DIGEST_AT + DIGEST_BYTES
TAGGED_BYTES: Final = REPORT_AT + REPORT.size
_FRAME_BYTES: Final = TAGGED_BYTES + TAG_BYTES
PAYLOAD_BYTES: Final = _FRAME_BYTES - HEADER_BYTES
REPORT_BYTES: Final = REPORT.size
HEAD_BYTES: Final = 2 + DIGEST_BYTES  # flags, detect multiplier, digest: the payload before the report
_NO_REPORT: Final = LinkReport()
_DIGEST: Final = "sha256"
_PURPOSE: Final = b"gdp-keepalive-1"
_SAME_MIN: Final = 2
SUSPECT_AFTER: Final = 1.25  # intervals without a frame, after which the neighbour is polled
TOGETHER: Final = 0.125  # of an interval: keepalives due within it leave at once
EARLY: Final = 0.25  # of an interval, by which one may leave early; RFC 5880, section 6.8.7
_POLLS_PER_INTERVAL: Final = 4
QUEUED_S: Final = 3.0  # longest time in which a neighbour whose other frames come may be silent
_FORGET_S: Final = 10.0
JITTER: Final = 0.1 / 255  # of an interval, for each value of a byte; up to ``EARLY``


_POLL, _FINAL, _HEARD = (int(each) for each in (KeepaliveFlag.POLL, KeepaliveFlag.FINAL, KeepaliveFlag.HEARD))


def keepalive_header(name: bytes, incarnation: int, sequence: int) -> Header:
    """Return the header of a keepalive of a node."""
    return Header(Kind.KEEPALIVE, Flag.LAST, HOPS_MAX, 0, PAYLOAD_BYTES, sequence, 0, 1, incarnation, ZERO, name)


def seal_keepalive(
    key: bytes, header: Header, flags: int, multiplier: int, digest: bytes, report: LinkReport = _NO_REPORT
) -> bytes:
    """Return a keepalive frame; the header's length counts ``PAYLOAD_BYTES``."""
    tagged = encode(header) + bytes((flags, multiplier)) + digest + REPORT.pack(*report)
    return tagged + hmac.digest(key, tagged, _DIGEST)[:TAG_BYTES]


def open_keepalive(key: bytes, frame: bytes) -> tuple[int, int, bytes, LinkReport]:
    """Return flags, detect multiplier, digest and link report of a frame, which may end in padding.

    Raises:
        FrameError: BAD_TAG, it was not sealed by this key, or TRUNCATED.
    """
    if len(frame) < _FRAME_BYTES:
        raise FrameError(DropReason.TRUNCATED, "keepalive")
    tag = hmac.digest(key, frame[:TAGGED_BYTES], _DIGEST)[:TAG_BYTES]
    if not hmac.compare_digest(tag, frame[TAGGED_BYTES:_FRAME_BYTES]):
        raise FrameError(DropReason.BAD_TAG, "keepalive")
    report = LinkReport(*REPORT.unpack_from(frame, REPORT_AT))
    return frame[HEADER_BYTES], frame[HEADER_BYTES + 1], frame[_DIGEST_AT:REPORT_AT], report


class Slowness:
    """Recent lateness of a node's timers; it decays by half every ten seconds."""

    def __init__(self) -> None:
        self._late_s = 0.0
        self._at_s = float("-inf")

    def late(self, late_s: float, now_s: float) -> None:
        """Note that a timer fired this late."""
        if late_s >= self._now(now_s):
            self._late_s, self._at_s = late_s, now_s

    def multiplier(self, timing: Timing, most_s: float, now_s: float) -> int:
        """Return the detect multiplier that this node requests of its neighbours.

        Args:
            most_s: longest detection time; a node that is late by more is declared down.
        """
        late_ms = 1_000 * self._now(now_s)
        if not timing.transmit_ms or late_ms < timing.transmit_ms / 2:
            return timing.multiplier
        most = max(int(1_000 * most_s / timing.transmit_ms), timing.multiplier)
        return min(timing.multiplier + math.ceil(2 * late_ms / timing.transmit_ms), most, MULTIPLIER_MAX)

    def _now(self, now_s: float) -> float:
        return self._late_s * math.pow(2.0, (self._at_s - now_s) / _FORGET_S)


@dataclass(slots=True, kw_only=True)
class KeepaliveSession:
    """Keepalive session with one neighbour, valid while both ends' sessions last.

    Attributes:
        out_interval_s: between those that are sent.
        in_interval_s: between those that the neighbour sends.
        detect_s: the neighbour is down after this time of silence.
        latest_s: when an interval ends after the last one that was sent.
        received: highest sequence number that came.
        is_alive: one has come.
        hears_us: the neighbour reports that it receives ours.
        is_poll_due: an answer is wanted although the neighbour is not silent.
        probe: of the link, while the neighbour does not answer.
        arrivals: frames that had come from the port when last counted; None: not since the last keepalive.
        arrived_s: when last counted, and there were more than the time before.
        quality: measurements of the link.
        has_new_cost: the keepalive opened last changed the cost that follows from them.
        head: flags, 0 and digest of the neighbour's last one.
        same: how many in a row requested nothing and had this head.
        is_offloaded: a data plane runs the session (``KeepaliveOffer``).
    """

    out_key: bytes
    in_key: bytes
    out_interval_s: float
    in_interval_s: float
    detect_s: float
    received: int
    send_at_s: float
    latest_s: float = 0.0
    poll_at_s: float = 0.0
    is_final_due: bool = False
    is_alive: bool = False
    hears_us: bool = False
    is_poll_due: bool = False
    probe: LinkProbe | None = None
    arrivals: int | None = None
    arrived_s: float = float("-inf")
    quality: LinkQuality = field(default_factory=LinkQuality)
    has_new_cost: bool = False
    head: bytes = b""
    same: int = 0
    is_offloaded: bool = False

    @property
    def is_steady(self) -> bool:
        """Return whether keepalives pass both ways, and bring no news."""
        is_quiet = self.probe is None and not self.is_final_due and not self.is_poll_due
        return is_quiet and self.same >= _SAME_MIN

    @classmethod
    def begin(
        cls,
        key: ExchangeKey,
        far_key: bytes,
        ends: tuple[bytes, bytes],
        timings: tuple[Timing, Timing],
        received: int,
        quality: LinkQuality,
        now_s: float,
    ) -> KeepaliveSession | None:
        """Return a session, or None if one of the ends wants none.

        Args:
            ends: nonce and name, ours and the neighbour's.
            timings: ours and the neighbour's.
            received: the sequence number above which its keepalives are new.
            quality: measurements of the link, those of earlier sessions too.

        Raises:
            StatementError: MALFORMED, the neighbour's key is invalid.
        """
        own, far = timings
        out_interval_s, in_interval_s = own.interval_s(far), far.interval_s(own)
        if not out_interval_s or not in_interval_s:
            return None
        out_key, in_key = key.agree(far_key, _PURPOSE + ends[0] + ends[1], _PURPOSE + ends[1] + ends[0])
        detect_s = in_interval_s * far.multiplier
        quality.begin_session()
        return cls(
            out_key=out_key,
            in_key=in_key,
            out_interval_s=out_interval_s,
            in_interval_s=in_interval_s,
            detect_s=detect_s,
            received=received,
            send_at_s=now_s,
            quality=quality,
        )

    def seal(
        self,
        source: tuple[bytes, int],
        sequence: int,
        multiplier: int,
        digest: bytes,
        now_s: float,
        *,
        poll: bool,
    ) -> bytes:
        """Return the next keepalive, and schedule the one after it; ``source``: our name and incarnation."""
        flags = _POLL * poll | _FINAL * self.is_final_due | _HEARD * self.is_alive
        self.is_final_due = self.is_poll_due = False
        name, incarnation = source
        header = keepalive_header(name, incarnation, sequence)
        frame = seal_keepalive(self.out_key, header, flags, multiplier, digest, self.quality.report_to_send(now_s))
        self.send_at_s = now_s + self.out_interval_s * (1 - frame[-1] * JITTER)
        self.latest_s = now_s + self.out_interval_s
        is_queued = self.arrivals is not None and now_s - self.arrived_s < self.detect_s
        self.poll_at_s = now_s + self.in_interval_s / (1 if is_queued else _POLLS_PER_INTERVAL)
        return frame

    def open(self, header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> bytes:
        """Process a keepalive of the neighbour; return the digest that it carries.

        Args:
            waited_s: since its arrival.

        Raises:
            FrameError: REPLAYED, it or a later one came before; or as ``open_keepalive``.
        """
        if header.number <= self.received:
            raise FrameError(DropReason.REPLAYED, "keepalive")
        flags, multiplier, digest, report = open_keepalive(self.in_key, frame)
        self.has_new_cost = self.quality.receive(report, now_s - waited_s)
        self.detect_s = self.in_interval_s * max(multiplier, 1)
        self.received, self.is_alive, self.arrivals = header.number, True, None
        self.hears_us = bool(flags & _HEARD)
        head = bytes((flags, 0)) + digest
        self.same = self.same + 1 if flags == _HEARD and head == self.head else 0
        self.head = head
        if self.probe is not None and self.probe.is_answered(self.quality.confirmed_s):
            self.probe = None
        if flags & _POLL:
            self.is_final_due, self.send_at_s = True, now_s
        return digest

    def take_run(self, run: KeepaliveRun) -> None:
        """Note what a data plane did in this session."""
        self.quality.note_sent(run.sent_s)
        self.received = max(self.received, run.received)
        self.has_new_cost = bool(run.taken) and self.quality.receive(LinkReport(*run.report), run.heard_s, run.taken)
        if run.multiplier:
            self.detect_s = self.in_interval_s * run.multiplier
        self.is_offloaded = not run.is_over
        if run.is_over:
            self.same, self.send_at_s, self.poll_at_s = 0, run.send_at_s, run.heard_s

    def begin_probe(self, now_s: float, *, is_restarted: bool) -> None:
        """Probe the link, because this node's address has changed.

        Args:
            is_restarted: polls that were sent before do not count.
        """
        if self.probe is None or is_restarted:
            self.probe = LinkProbe(since_s=now_s)
        self.probe.is_moved, self.poll_at_s = True, now_s

    def note_poll(self, now_s: float) -> None:
        """Note that a silent neighbour, or one that is probed, is polled now."""
        if self.probe is None:
            self.probe = LinkProbe(since_s=now_s)
        self.probe.polls += 1

    def note_arrivals(self, frames: int, now_s: float) -> None:
        """Note how many frames have come from the port of a silent neighbour, which is its only one."""
        if self.arrivals is not None and frames != self.arrivals:
            self.arrived_s = now_s
        self.arrivals = frames

    def silent_at_s(self, heard_s: float) -> float:
        """Return when a neighbour last heard at ``heard_s`` is lost.

        While other frames come, its keepalives wait in a full queue or are dropped there: it has ``QUEUED_S`` more.
        """
        if self.is_offloaded:
            return NEVER_S
        return max(heard_s, min(self.arrived_s, heard_s + QUEUED_S)) + self.detect_s

    def is_silent(self, heard_s: float, now_s: float) -> bool:
        """Return whether a neighbour last heard at ``heard_s`` has left out a keepalive."""
        return now_s >= heard_s + SUSPECT_AFTER * self.in_interval_s

    def suspect_at_s(self, heard_s: float) -> float:
        """Return when a neighbour last heard at ``heard_s`` is polled next; never before its first keepalive."""
        if not self.is_alive or self.is_offloaded:
            return NEVER_S
        if self.probe is not None:
            return self.poll_at_s
        return max(heard_s + SUSPECT_AFTER * self.in_interval_s, self.poll_at_s)
