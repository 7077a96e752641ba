"""Keepalive sessions that the kernel runs: arming, the tick that sends, and what happened since.

I/O. Needs TCX links (Linux 6.6): these end with the process, so a killed node is silent at once. Only this process
sends, so a frozen one is silent, too. One tick sends the keepalives of all sessions that are due, and learns who is
silent. It costs some microseconds for each, and calls nothing of the node.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from heapq import heappop, heappush
from typing import Any, Final

from gdp.control.keepalive import EARLY, JITTER, REPORT
from gdp.errors import LocalError
from gdp.frame.codec import ethernet
from gdp.intervals import NEVER_S, SCHEDULED_S
from gdp.ports.kernel.keepalive_program import (
    END_BYTES,
    FRAME_BYTES,
    SESSION_BYTES,
    KeepaliveMaps,
    SessionAt,
    StateAt,
    receiver,
    sender,
)
from gdp.ports.kernel.maps import KernelMap, MapKind
from gdp.ports.kernel.program import LICENCE
from gdp.ports.kernel.sha256 import BLOCK_BYTES
from gdp.ports.kernel.syscall import TCX_INGRESS, PreparedRun, create_link, load_program
from gdp.ports.plane import Port
from gdp.sansio import KeepaliveOffer, KeepaliveRun

log = logging.getLogger(__name__)

_SESSIONS_MAX: Final = 64
_AGAIN: Final = 0.25  # of an interval, after which keepalives that were not sent are sent
_STATE: Final = struct.Struct(f"=7Q{REPORT.size}sB2x")
_NUMBER: Final = struct.Struct("=I")
_WORDS: Final = _STATE.size // 8
_COUNT_AT, _HEARD_AT, _UP_AT = (each // 8 for each in (StateAt.COUNT, StateAt.HEARD, StateAt.UP))
_INNER, _OUTER = bytes(each ^ 0x36 for each in range(256)), bytes(each ^ 0x5C for each in range(256))


def _keys(key: bytes) -> bytes:
    """Return the two blocks of HMAC (RFC 2104) for a key."""
    block = key.ljust(BLOCK_BYTES, b"\0")
    return block.translate(_INNER) + block.translate(_OUTER)


def _changing(offer: KeepaliveOffer) -> dict[str, Any]:
    """Return what may change while a session runs."""
    return {"head": offer.head, "expected": offer.expected, "loss": offer.loss}


@dataclass(slots=True)
class _Session:
    offer: KeepaliveOffer
    slot: int
    end: bytes
    send_at_s: float
    sent: int
    taken: int = 0
    replays: int = 0
    sent_s: list[float] = field(default_factory=list)


class KeepaliveSessions:
    """Sessions that the kernel runs on the ports of a plane.

    Attributes:
        due_s: monotonic second of the next tick; infinity: there are no sessions.
        has_news: a session may have come to its end.

    Raises:
        LocalError: the process lacks the right, or the kernel is too old.
    """

    def __init__(self) -> None:
        self._programs: list[int] = []
        self._maps: list[KernelMap] = []
        self._ifnames: dict[int, str] = {}  # of ports that have no link yet
        self._links: dict[int, tuple[int, int]] = {}  # link and ifindex, by port
        self._sessions: dict[tuple[int, bytes], _Session] = {}
        self._free = list(range(_SESSIONS_MAX))  # slots; the first ones are used first
        self._listed: list[int] = []  # slots that were sent for last
        self._late_s = 0.0
        self._send_at_s, self._interval_s = NEVER_S, 0.0
        self.due_s = NEVER_S
        self.has_news = False
        try:
            self._configured = self._make(MapKind.ARRAY, 4, SESSION_BYTES, "gdp_sessions")
            self._states = KernelMap(MapKind.ARRAY, 4, _STATE.size, _SESSIONS_MAX, "gdp_states", is_mapped=True)
            self._maps.append(self._states)
            self._words = self._states.words
            self._ends = self._make(MapKind.HASH, END_BYTES, 4, "gdp_ends")
            self._slots = self._make(MapKind.ARRAY, 4, 4, "gdp_slots")
            maps = KeepaliveMaps(
                sessions=self._configured.fd, states=self._states.fd, ends=self._ends.fd, slots=self._slots.fd
            )
            for code in receiver(maps), sender(maps):
                self._programs.append(load_program(code, "gdp_keepalive", LICENCE))
            self._run = PreparedRun(self._programs[1], bytes(FRAME_BYTES))
        except LocalError:
            self.close()
            raise

    def _make(self, kind: MapKind, key_bytes: int, value_bytes: int, name: str) -> KernelMap:
        made = KernelMap(kind, key_bytes, value_bytes, _SESSIONS_MAX, name)
        self._maps.append(made)
        return made

    def close(self) -> None:
        """Detach the program and close everything."""
        for opened in (*self._programs, *(link for link, _ in self._links.values())):
            os.close(opened)
        for each in self._maps:
            each.close()
        self._programs, self._maps, self._links = [], [], {}

    def attach(self, port: int, ifname: str) -> None:
        """Allow sessions at a device. The first one attaches the program, which takes the kernel some 15 ms."""
        self._ifnames[port] = ifname

    def _receives(self, port: int) -> bool:
        """Return whether keepalives are received at a port; not at a device that is gone, or where it is refused."""
        ifname = self._ifnames.pop(port, None)
        if ifname is not None:
            try:
                ifindex = socket.if_nametoindex(ifname)
                self._links[port] = create_link(self._programs[0], ifindex, TCX_INGRESS), ifindex
            except (OSError, LocalError) as refused:
                log.debug("keepalives not in the kernel port=%s reason=%s", ifname, refused)
        return port in self._links

    def detach(self, port: int) -> list[Callable[[], object]]:
        """Receive no keepalives at a port; its sessions end with the next report. Return what closes its link."""
        self._ifnames.pop(port, None)
        link = self._links.pop(port, None)
        self.has_news = self.has_news or any(each[0] == port for each in self._sessions)
        return [] if link is None else [partial(os.close, link[0])]

    # sessions

    def follow(self, offers: Sequence[KeepaliveOffer], ports: Mapping[int, Port]) -> list[KeepaliveRun]:
        """Run the sessions of these offers and no others; return the begin and the end of each where that is new."""
        runs = []
        wanted = {(each.port, each.name): each for each in offers}
        for key, session in list(self._sessions.items()):
            offer = wanted.get(key)
            ran = session.offer
            if offer is None or offer.port not in self._links or (offer.in_key, offer.mac) != (ran.in_key, ran.mac):
                runs.append(self._end(key))
            elif _changing(offer) != _changing(ran):
                session.offer = ran._replace(**_changing(offer))
                self._configure(session, ports[offer.port].mac)
        for key, offer in wanted.items():
            if key not in self._sessions and self._free and self._receives(offer.port):
                runs.append(self._begin(key, offer, ports[offer.port].mac))
        return runs

    def _begin(self, key: tuple[int, bytes], offer: KeepaliveOffer, mac: bytes) -> KeepaliveRun:
        slot, ifindex = heappop(self._free), self._links[offer.port][1]
        end = offer.name + _NUMBER.pack(ifindex)
        session = _Session(offer, slot, end, offer.send_at_s, offer.sent)
        report = REPORT.pack(offer.echo, 0, 0, 0)
        heard_ns = int(offer.heard_s * 1e9)
        state = _STATE.pack(offer.sequence, offer.sent, offer.received, heard_ns, 0, 0, 0, report, 0)
        self._states.put(_NUMBER.pack(slot), state)
        self._configure(session, mac)
        self._ends.put(end, _NUMBER.pack(slot))
        self._sessions[key] = session
        self._arrange()
        return KeepaliveRun(offer.port, offer.name, offer.nonce, received=offer.received, heard_s=offer.heard_s)

    def _configure(self, session: _Session, mac: bytes) -> None:
        offer = session.offer
        report = REPORT.pack(0, 0, 0, offer.loss)
        frame = ethernet(offer.mac, mac) + offer.header + offer.head + report
        value = _keys(offer.in_key) + _keys(offer.out_key) + frame.ljust(SessionAt.EXPECTED - SessionAt.FRAME, b"\0")
        value += offer.expected.ljust(SessionAt.IFINDEX - SessionAt.EXPECTED, b"\0")
        self._configured.put(_NUMBER.pack(session.slot), value + struct.pack("=II", self._links[offer.port][1], 0))

    def _end(self, key: tuple[int, bytes]) -> KeepaliveRun:
        session = self._sessions[key]
        self._ends.remove(session.end)
        run = self._report(session)._replace(is_over=True)
        del self._sessions[key]
        heappush(self._free, session.slot)
        self._arrange()
        return run

    def _report(self, session: _Session) -> KeepaliveRun:
        state = _STATE.unpack_from(self._words, session.slot * _STATE.size)
        sequence, _, received, heard_ns, taken, _, replays, report, multiplier = state
        offer = session.offer
        sent_s, session.sent_s = tuple(session.sent_s), []
        came, session.taken = taken - session.taken, taken
        refused, session.replays = replays - session.replays, replays
        return KeepaliveRun(
            offer.port, offer.name, offer.nonce, sent_s, sequence, came, received, heard_ns * 1e-9,
            REPORT.unpack(report), multiplier, refused, session.send_at_s,
        )  # fmt: skip

    # the tick

    def tick(self, now_s: float) -> None:
        """Send the keepalives that are due, and look who is silent; the node must be called if there is news."""
        if self.due_s < now_s - SCHEDULED_S:
            self._late_s = max(self._late_s, now_s - self.due_s)
            self.has_news = True
        if self._send_at_s <= now_s + self._interval_s * EARLY:
            until_s = now_s + self._interval_s / 2
            self._send([each for each in self._sessions.values() if each.send_at_s <= until_s], now_s)
        self._plan(now_s)

    def _send(self, sessions: list[_Session], now_s: float) -> None:
        slots, words = [each.slot for each in sessions], self._words
        jitter = JITTER * (int(now_s * 1e6) & 255)  # of the moment of a wake-up, as good as random for this
        if slots != self._listed:
            self._listed = slots
            self._slots.put_many([_NUMBER.pack(at) for at in range(len(slots))], [*map(_NUMBER.pack, slots)])
        try:
            self._run(len(slots))
        except LocalError as refused:  # without memory, or by a signal; some may have left
            log.debug("keepalives not sent reason=%s", refused)
            jitter = 1 - _AGAIN
        for session in sessions:
            session.send_at_s = now_s + session.offer.out_interval_s * (1 - jitter)
            sent = words[session.slot * _WORDS + _COUNT_AT]
            if sent != session.sent:
                session.sent_s.append(now_s)
                session.sent = sent

    def _arrange(self) -> None:
        """Set the shortest interval after sessions have come or gone, and plan."""
        self._interval_s = min([each.offer.out_interval_s for each in self._sessions.values()], default=0.0)
        self._plan(time.monotonic())

    def _plan(self, now_s: float) -> None:
        """Set when the next tick is due: silence is looked at when keepalives leave, half an interval late at most."""
        words, sessions = self._words, self._sessions.values()
        heard = [words[each.slot * _WORDS + _HEARD_AT] * 1e-9 + each.offer.suspect_s for each in sessions]
        silent_at_s = min(heard, default=NEVER_S)
        send_at_s = min([each.send_at_s for each in sessions], default=NEVER_S)
        if silent_at_s <= now_s:
            self.has_news = True
        self._send_at_s = send_at_s
        self.due_s = min(send_at_s, silent_at_s + self._interval_s / 2)

    def poll(self, now_s: float, *, reports: bool = False) -> tuple[list[KeepaliveRun], float]:
        """Return what happened in sessions that end, and how late a tick was; with ``reports`` also in the others."""
        self.has_news, late_s, self._late_s = False, self._late_s, 0.0
        runs = list[KeepaliveRun]()
        for key, session in list(self._sessions.items()):
            at = session.slot * _WORDS
            has_come = self._words[at + _UP_AT] or session.offer.port not in self._links
            if has_come or self._words[at + _HEARD_AT] * 1e-9 + session.offer.suspect_s <= now_s:
                runs.append(self._end(key))
            elif reports:
                runs.append(self._report(session))
        return runs, late_s


def open_sessions() -> KeepaliveSessions | None:
    """Return sessions that the kernel runs; None: it refuses, and the node runs them itself."""
    try:
        return KeepaliveSessions()
    except LocalError as refused:
        log.info("keepalives not in the kernel reason=%s", str(refused).partition("\n")[0])
        return None
