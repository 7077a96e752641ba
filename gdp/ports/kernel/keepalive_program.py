"""Keepalives as two eBPF programs: one receives those of neighbours that are up, the other makes and sends ours.

Sans-I/O; map descriptors in, instructions out. ``gdp.control.keepalive`` has the format, from which the programs must
never differ; tests compare them. Source: RFC 5880 (BFD), whose sessions devices run in the same way once they are up.

The receiver stands behind the forwarder at the ingress of a port. It *takes* a keepalive that a session expects: a
number above all before, a valid tag, and the flags and the digest of the one before. So it wakes no process.
Any other frame goes *up*. From the first authentic one that is different, all of that session go up, until the session
is armed again::

    a session's? -> new number? -> tag valid? -> as expected?
        no: up        no: drop       no: up         no: up, and all after it

The sender runs by ``BPF_PROG_TEST_RUN``, once for each session whose slot is in the list. Each run sends one keepalive;
``cb[0]`` of the frame, which all runs of a call share, counts them.

Numbers are in host byte order, but those of a frame::

    session  keys of the neighbour's tags (128)  keys of ours (128)  frame to send (160)  expected (16)  ifindex (4)
             unused (4)
    state    number sent (8)  count sent (8)  number received (8)  heard, nanoseconds (8)  frames taken (8)
             frames up (8)  replays (8)  of the last one taken: link report (21), multiplier (1), unused (2)
    end      name of the neighbour (32)  ifindex (4) -> slot (4)
    list     number (4) -> slot (4)

Keys of tags are two blocks of HMAC: the key with the inner and with the outer padding.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gdp.control.keepalive import HEAD_BYTES, REPORT_AT, REPORT_BYTES, TAG_BYTES, TAGGED_BYTES
from gdp.frame.codec import ETHER_BYTES, ETHERTYPE, HEADER_BYTES, KIND_AT, NUMBER_AT, SOURCE_AT, VERSION, Kind
from gdp.names import NAME_BYTES
from gdp.ports.kernel.assembler import Assembler, Reg
from gdp.ports.kernel.sha256 import BLOCK_BYTES, FIRST_STATE, STATE_BYTES, add_compress

FRAME_BYTES: Final = ETHER_BYTES + TAGGED_BYTES + TAG_BYTES
_FRAME_SPACE: Final = 160


class SessionAt(IntEnum):
    """Offsets in a session."""

    IN_KEYS = 0
    OUT_KEYS = 2 * BLOCK_BYTES
    FRAME = 4 * BLOCK_BYTES
    EXPECTED = FRAME + _FRAME_SPACE
    IFINDEX = EXPECTED + 16


class StateAt(IntEnum):
    """Offsets in the state of a session."""

    SENT = 0
    COUNT = 8
    RECEIVED = 16
    HEARD = 24
    TAKEN = 32
    UP = 40
    REPLAYS = 48
    REPORT = 56


SESSION_BYTES: Final = SessionAt.IFINDEX + 8
END_BYTES: Final = NAME_BYTES + 4

_SKB, _SESSION, _STATE, _NOW = Reg.R6, Reg.R7, Reg.R8, Reg.R9
_UP, _DROP = -1, 2  # TCX_NEXT, TCX_DROP

# struct __sk_buff
_PKT_TYPE, _PROTOCOL, _VLAN_PRESENT, _PRIORITY, _IFINDEX, _CB = 4, 16, 20, 32, 40, 48
# enum bpf_func_id
_LOOKUP, _KTIME_NS, _STORE_BYTES, _CLONE_REDIRECT, _LOAD_BYTES = 1, 5, 9, 13, 26
_URGENT_PRIORITY: Final = 6  # TC_PRIO_INTERACTIVE, as the socket of control frames has it

# The stack, from R10 down: what a tag is computed from and in, then what is loaded from a frame or stored into it.
_LAST: Final = -BLOCK_BYTES  # last block of a digest
_TAGGED: Final = _LAST - 2 * BLOCK_BYTES  # tagged bytes of a frame, and the bit behind them
_DIGEST: Final = _TAGGED - STATE_BYTES  # the tag, at the end
_TAG: Final = _DIGEST - TAG_BYTES
_REPORT: Final = _TAG - 24
_NUMBER: Final = _REPORT - 8
_INDEX: Final = _NUMBER - 8
_END: Final = _INDEX - END_BYTES - 4
assert TAGGED_BYTES + 1 == 2 * BLOCK_BYTES


@dataclass(frozen=True, slots=True, kw_only=True)
class KeepaliveMaps:
    """File descriptors of the maps that the programs use."""

    sessions: int
    states: int
    ends: int
    slots: int


class _Keepalives(Assembler):
    """What both programs have in common."""

    def __init__(self, maps: KeepaliveMaps) -> None:
        super().__init__()
        self._maps = maps

    def _find_session(self) -> None:
        """Set the registers of the session and its state, whose slot was looked up; or end."""
        self.jump_if(Reg.R0, "==", 0, "up")
        self.load(Reg.R2, Reg.R0, 0, 4)
        self.store(Reg.R10, _INDEX, Reg.R2, 4)
        for descriptor, to in (self._maps.sessions, _SESSION), (self._maps.states, _STATE):
            self._look_up(descriptor, _INDEX)
            self.jump_if(Reg.R0, "==", 0, "up")
            self.move(to, Reg.R0)

    def _look_up(self, descriptor: int, key: int) -> None:
        self.load_map(Reg.R1, descriptor)
        self.move(Reg.R2, Reg.R10)
        self.add(Reg.R2, key)
        self.call(_LOOKUP)

    def _load_bytes(self, at: int, into: int, count: int) -> None:
        """Copy bytes of the frame to the stack; R0 is not 0 if it is shorter."""
        self.move(Reg.R1, _SKB)
        self.move(Reg.R2, at)
        self.move(Reg.R3, Reg.R10)
        self.add(Reg.R3, into)
        self.move(Reg.R4, count)
        self.call(_LOAD_BYTES)

    def _store_bytes(self, at: int, base: Reg, offset: int, count: int) -> None:
        self.move(Reg.R1, _SKB)
        self.move(Reg.R2, at)
        self.move(Reg.R3, base)
        self.add(Reg.R3, offset)
        self.move(Reg.R4, count)
        self.move(Reg.R5, 0)
        self.call(_STORE_BYTES)

    def _compute_tag(self, keys: int) -> None:
        """Compute the tag of the tagged bytes on the stack."""
        self.move(Reg.R1, Reg.R10)
        self.add(Reg.R1, _DIGEST)
        self.move(Reg.R2, _SESSION)
        self.add(Reg.R2, keys)
        self.call_label("tag")

    def _add_subprograms(self) -> None:
        """Add HMAC-SHA256 (RFC 2104): R1 points to the digest, the tagged bytes and the last block, R2 to the keys."""
        digest, keys, last = Reg.R6, Reg.R7, _LAST - _DIGEST
        self.label("tag")
        self.move(digest, Reg.R1)
        self.move(keys, Reg.R2)
        self.store(digest, _TAGGED - _DIGEST + TAGGED_BYTES, 0x80, 1)
        self._begin_last(last, 0, BLOCK_BYTES + TAGGED_BYTES)
        self._digest_blocks((keys, 0), (digest, _TAGGED - _DIGEST), (digest, _TAGGED - _DIGEST + BLOCK_BYTES))
        self._digest_block(digest, last)
        self._begin_last(last, STATE_BYTES, BLOCK_BYTES + STATE_BYTES)
        self._write_digest(last)
        self.store(digest, last + STATE_BYTES, 0x80, 1)
        self._digest_blocks((keys, BLOCK_BYTES), (digest, last))
        self._write_digest(0)
        self.leave(0)
        add_compress(self, "compress")

    def _begin_last(self, last: int, begin: int, count: int) -> None:
        """Write zeros and the number of digested bits into the last block."""
        for at in range(begin, BLOCK_BYTES - 8, 8):
            self.store(Reg.R6, last + at, 0, 8)
        self.move(Reg.R1, 8 * count)
        self.from_big_endian(Reg.R1, 64)
        self.store(Reg.R6, last + BLOCK_BYTES - 8, Reg.R1, 8)

    def _digest_blocks(self, *blocks: tuple[Reg, int]) -> None:
        for word, value in enumerate(FIRST_STATE):
            self.move_word(Reg.R1, value - (1 << 32) if value >> 31 else value)
            self.store(Reg.R6, 4 * word, Reg.R1, 4)
        for base, offset in blocks:
            self._digest_block(base, offset)

    def _digest_block(self, base: Reg, offset: int) -> None:
        self.move(Reg.R1, Reg.R6)
        self.move(Reg.R2, base)
        self.add(Reg.R2, offset)
        self.call_label("compress")

    def _write_digest(self, offset: int) -> None:
        """Write the digest as bytes."""
        for word in range(STATE_BYTES // 4):
            self.load(Reg.R1, Reg.R6, 4 * word, 4)
            self.from_big_endian(Reg.R1, 32)
            self.store(Reg.R6, offset + 4 * word, Reg.R1, 4)


class _Receiver(_Keepalives):
    def build(self) -> bytes:
        """Return the instructions of the program; call it once."""
        self._only_keepalives()
        self._only_armed()
        self._only_new()
        self._only_authentic()
        self._only_expected()
        self._take()
        self.label("replay")
        self._count(StateAt.REPLAYS)
        self.leave(_DROP)
        self.label("other")
        self._count(StateAt.UP)
        self.label("up")
        self.leave(_UP)
        self._add_subprograms()
        return self.assemble()

    def _only_keepalives(self) -> None:
        """Accept keepalives to this station that are in no VLAN, and copy what their tag covers."""
        self.move(_SKB, Reg.R1)
        for at, value in (
            (_PROTOCOL, socket.htons(ETHERTYPE)),
            (_PKT_TYPE, socket.PACKET_HOST),
            (_VLAN_PRESENT, 0),
        ):
            self.load(Reg.R2, _SKB, at, 4)
            self.jump_if(Reg.R2, "!=", value, "up")
        self._load_bytes(ETHER_BYTES, _TAGGED, TAGGED_BYTES)
        self.jump_if(Reg.R0, "!=", 0, "up")
        for at, value in (0, VERSION), (KIND_AT, Kind.KEEPALIVE):
            self.load(Reg.R2, Reg.R10, _TAGGED + at, 1)
            self.jump_if(Reg.R2, "!=", value, "up")

    def _only_armed(self) -> None:
        for at in range(0, NAME_BYTES, 8):
            self.load(Reg.R2, Reg.R10, _TAGGED + SOURCE_AT + at, 8)
            self.store(Reg.R10, _END + at, Reg.R2, 8)
        self.load(Reg.R2, _SKB, _IFINDEX, 4)
        self.store(Reg.R10, _END + NAME_BYTES, Reg.R2, 4)
        self._look_up(self._maps.ends, _END)
        self._find_session()
        self.load(Reg.R2, _STATE, StateAt.UP, 8)
        self.jump_if(Reg.R2, "!=", 0, "up")

    def _only_new(self) -> None:
        self.load(Reg.R2, Reg.R10, _TAGGED + NUMBER_AT, 8)
        self.from_big_endian(Reg.R2, 64)
        self.load(Reg.R3, _STATE, StateAt.RECEIVED, 8)
        self.jump_if(Reg.R2, "<=", Reg.R3, "replay")

    def _only_authentic(self) -> None:
        self._load_bytes(ETHER_BYTES + TAGGED_BYTES, _TAG, TAG_BYTES)
        self.jump_if(Reg.R0, "!=", 0, "up")
        self._compute_tag(SessionAt.IN_KEYS)
        for at, into in (0, Reg.R2), (8, Reg.R3):
            self.load(into, Reg.R10, _TAG + at, 8)
            self.load(Reg.R4, Reg.R10, _DIGEST + at, 8)
            self.exclusive_or(into, Reg.R4)
        self.include(Reg.R2, Reg.R3)  # no comparison ends before the other
        self.jump_if(Reg.R2, "!=", 0, "up")

    def _only_expected(self) -> None:
        """Compare flags and digest; the multiplier may change, and is kept."""
        for at in range(0, 24, 8):
            self.store(Reg.R10, _REPORT + at, 0, 8)
        multiplier = _TAGGED + HEADER_BYTES + 1
        self.load(Reg.R2, Reg.R10, multiplier, 1)
        self.store(Reg.R10, _REPORT + REPORT_BYTES, Reg.R2, 1)
        self.store(Reg.R10, multiplier, 0, 1)
        for at, size in (0, 8), (8, HEAD_BYTES - 8):
            self.load(Reg.R2, Reg.R10, _TAGGED + HEADER_BYTES + at, size)
            self.load(Reg.R3, _SESSION, SessionAt.EXPECTED + at, size)
            self.jump_if(Reg.R2, "!=", Reg.R3, "other")

    def _take(self) -> None:
        self._load_bytes(ETHER_BYTES + REPORT_AT, _REPORT, REPORT_BYTES)
        for at in range(0, 24, 8):
            self.load(Reg.R2, Reg.R10, _REPORT + at, 8)
            self.store(_STATE, StateAt.REPORT + at, Reg.R2, 8)
        self.load(Reg.R2, Reg.R10, _TAGGED + NUMBER_AT, 8)
        self.from_big_endian(Reg.R2, 64)
        self.store(_STATE, StateAt.RECEIVED, Reg.R2, 8)
        self.call(_KTIME_NS)
        self.store(_STATE, StateAt.HEARD, Reg.R0, 8)
        self._count(StateAt.TAKEN)
        self.leave(_DROP)

    def _count(self, at: StateAt) -> None:
        self.load(Reg.R2, _STATE, at, 8)
        self.add(Reg.R2, 1)
        self.store(_STATE, at, Reg.R2, 8)


class _Sender(_Keepalives):
    def build(self) -> bytes:
        """Return the instructions of the program; call it once."""
        self.move(_SKB, Reg.R1)
        self.load(Reg.R2, _SKB, _CB, 4)
        self.store(Reg.R10, _INDEX, Reg.R2, 4)
        self.add(Reg.R2, 1)
        self.store(_SKB, _CB, Reg.R2, 4)
        self._look_up(self._maps.slots, _INDEX)
        self._find_session()
        self.call(_KTIME_NS)
        self.move(_NOW, Reg.R0)
        self.load(Reg.R2, _STATE, StateAt.HEARD, 8)
        self.subtract(_NOW, Reg.R2)
        self.divide(_NOW, 1_000)  # microseconds since then
        self._write_frame()
        self._write_tag()
        self._send()
        self.label("up")
        self.leave(_UP)
        self._add_subprograms()
        return self.assemble()

    def _write_frame(self) -> None:
        """Write the frame of the session, its next number and its link report."""
        self._store_bytes(0, _SESSION, SessionAt.FRAME, FRAME_BYTES)
        for at, into in (StateAt.SENT, _NUMBER), (StateAt.COUNT, _REPORT):
            self.load(Reg.R2, _STATE, at, 8)
            self.add(Reg.R2, 1)
            self.store(_STATE, at, Reg.R2, 8)
            self.from_big_endian(Reg.R2, 64)
            self.store(Reg.R10, into, Reg.R2, 8)
        self._store_bytes(ETHER_BYTES + NUMBER_AT, Reg.R10, _NUMBER, 8)
        self.load(Reg.R2, _STATE, StateAt.REPORT, 8)  # the neighbour's count, as it came
        self.store(Reg.R10, _REPORT + 8, Reg.R2, 8)
        self.move_word(Reg.R2, _NOW)
        self.from_big_endian(Reg.R2, 32)
        self.store(Reg.R10, _REPORT + 16, Reg.R2, 8)
        self._store_bytes(ETHER_BYTES + REPORT_AT, Reg.R10, _REPORT, REPORT_BYTES - 1)  # the loss is in the frame

    def _write_tag(self) -> None:
        self._load_bytes(ETHER_BYTES, _TAGGED, TAGGED_BYTES)
        self.jump_if(Reg.R0, "!=", 0, "up")
        self._compute_tag(SessionAt.OUT_KEYS)
        self._store_bytes(ETHER_BYTES + TAGGED_BYTES, Reg.R10, _DIGEST, TAG_BYTES)

    def _send(self) -> None:
        self.move(Reg.R2, _URGENT_PRIORITY)
        self.store(_SKB, _PRIORITY, Reg.R2, 4)
        self.move(Reg.R1, _SKB)
        self.load(Reg.R2, _SESSION, SessionAt.IFINDEX, 4)
        self.move(Reg.R3, 0)
        self.call(_CLONE_REDIRECT)
        self.leave(_DROP)


def receiver(maps: KeepaliveMaps) -> bytes:
    """Return the instructions of the program for the ingress of every port."""
    return _Receiver(maps).build()


def sender(maps: KeepaliveMaps) -> bytes:
    """Return the instructions of the program that sends."""
    return _Sender(maps).build()
