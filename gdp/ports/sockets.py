"""AF_PACKET sockets that see our frames and nothing else.

Place: I/O; opens and asks sockets, keeps nothing.
Source: packet(7), socket(7), ``linux/filter.h`` (classic BPF, which needs no privilege beyond the raw socket itself).

What a port lets in is settled in the kernel, by a few loads and compares, so that no frame that is someone else's costs
Python anything: frames to the port's own address, and broadcast frames whose kind is for the neighbour itself. A frame
to another station (``PACKET_OTHERHOST``, seen on a shared or promiscuous link), a multicast, an echo of our own
sending, and a data frame that was broadcast (which every switch on a shared link would forward once more) are none of
our business: neither forwarded nor counted.

A port may have a socket for each *lane*, so that nothing waits in a queue behind what matters less: what neighbours
say to each other, their hellos, frames flagged urgent, all the rest, and last what strangers say to us. A flood on one
lane fills that lane's queue alone. Who is a neighbour is told by its address, which the filters are given with each
change. What leaves by the lanes of neighbours and of urgent frames carries a priority that every queueing discipline
with bands honours (``pfifo_fast``, ``prio``, and the access categories of Wi-Fi).
"""

from __future__ import annotations

import errno
import socket
import struct
from array import array
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import Final

from gdp.errors import LocalError
from gdp.frame.codec import ETHER_BYTES, FLAGS_AT, KIND_AT
from gdp.frame.kinds import CONTROL_FROM, ETHERTYPE, Flag, Kind

__all__ = [
    "AS_ROOT",
    "NO_RAW_SOCKETS",
    "TrafficClass",
    "attach_drop_all_filter",
    "attach_ethertype_filter",
    "kernel_drops",
    "large_buffers",
    "open_port",
    "steps_of",
    "tell_neighbours",
]

AS_ROOT: Final = "run this as root, or with scripts/privileged.sh"
NO_RAW_SOCKETS: Final = f"raw sockets need root or CAP_NET_RAW; {AS_ROOT}"

_SOL_PACKET: Final = 263
_PACKET_STATISTICS: Final = 6
_PACKET_QDISC_BYPASS: Final = 20
_PACKET_IGNORE_OUTGOING: Final = 23  # Linux 4.20; older kernels rely on the filter
_SO_ATTACH_FILTER: Final = 26
_SO_SNDBUFFORCE: Final = 32
_SO_RCVBUFFORCE: Final = 33
_GREETING_BUFFER_BYTES: Final = 128 << 10  # about a hundred hellos: those of a flood are old before they are read
_BUFFER_BYTES: Final = 16 << 20  # a 921,600-byte message is 1.6 MB of socket memory at MTU 1500

_Step = tuple[int, int, int, int]  # code, steps to jump if it holds, if it does not, value
_LOAD_BYTE: Final = 0x30  # BPF_LD | BPF_B | BPF_ABS; beyond the frame's end, the frame is left
_LOAD_HALF: Final = 0x28  # BPF_LD | BPF_H | BPF_ABS
_LOAD_WORD: Final = 0x20  # BPF_LD | BPF_W | BPF_ABS
_LOAD_LENGTH: Final = 0x80  # BPF_LD | BPF_W | BPF_LEN
_JUMP_EQUAL: Final = 0x15  # BPF_JMP | BPF_JEQ | BPF_K
_JUMP_GREATER_EQUAL: Final = 0x35  # BPF_JMP | BPF_JGE | BPF_K
_RETURN: Final = 0x06  # BPF_RET | BPF_K
_PACKET_TYPE: Final = 0xFFFFF004  # SKF_AD_OFF + SKF_AD_PKTTYPE
_WHOLE: Final = 0xFFFFFFFF
_JUMP_SET: Final = 0x45  # BPF_JMP | BPF_JSET | BPF_K
_PRIORITY: Final = 6  # TC_PRIO_INTERACTIVE: the first band; 7 would need CAP_NET_ADMIN
_KIND: Final = (_LOAD_BYTE, 0, 0, ETHER_BYTES + KIND_AT)
_FLAGS: Final = (_LOAD_BYTE, 0, 0, ETHER_BYTES + FLAGS_AT)
_TYPE: Final = (_LOAD_BYTE, 0, 0, _PACKET_TYPE)
_LANED_BYTES: Final = ETHER_BYTES + FLAGS_AT + 1  # what tells a frame's lane
_LENGTH: Final = (_LOAD_LENGTH, 0, 0, 0)
_TAKE: Final = (_RETURN, 0, 0, _WHOLE)
_LEAVE: Final = (_RETURN, 0, 0, 0)
_SOURCE_AT: Final = 6  # in the Ethernet header
_CONTROL_ONLY: Final = (
    _TYPE,
    (_JUMP_EQUAL, 2, 0, socket.PACKET_HOST),
    (_JUMP_EQUAL, 1, 0, socket.PACKET_BROADCAST),
    _LEAVE,
    _LENGTH,
    (_JUMP_GREATER_EQUAL, 1, 0, _LANED_BYTES),
    _LEAVE,
    _KIND,
    (_JUMP_GREATER_EQUAL, 1, 0, CONTROL_FROM),
    _LEAVE,
)
_NO_HELLO: Final = ((_JUMP_EQUAL, 0, 1, Kind.HELLO), _LEAVE)
_HELLO_ONLY: Final = ((_JUMP_EQUAL, 1, 0, Kind.HELLO), _LEAVE)


class TrafficClass(Enum):
    """Which of our frames a socket sees: steps of (code, jump if true, jump if false, value).

    In the lanes of ``_BY_ADDRESS`` the sender's address decides what follows.
    """

    ALL = (
        _TYPE,
        (_JUMP_EQUAL, 3, 0, socket.PACKET_HOST),
        (_JUMP_EQUAL, 0, 3, socket.PACKET_BROADCAST),
        _KIND,
        (_JUMP_GREATER_EQUAL, 0, 1, CONTROL_FROM),
        _TAKE,
        _LEAVE,
    )
    CONTROL = (*_CONTROL_ONLY, *_NO_HELLO)  # of neighbours
    HELLO = (*_CONTROL_ONLY, *_HELLO_ONLY)  # of neighbours
    GUEST = _CONTROL_ONLY  # of everybody else
    URGENT = (
        _TYPE,
        (_JUMP_EQUAL, 0, 5, socket.PACKET_HOST),
        _KIND,
        (_JUMP_GREATER_EQUAL, 3, 0, CONTROL_FROM),
        _FLAGS,
        (_JUMP_SET, 0, 1, Flag.URGENT),
        _TAKE,
        _LEAVE,
    )
    ORDINARY = (
        _TYPE,
        (_JUMP_EQUAL, 0, 7, socket.PACKET_HOST),
        _LENGTH,
        (_JUMP_GREATER_EQUAL, 0, 4, _LANED_BYTES),  # shorter ones are for the plane to count
        _KIND,
        (_JUMP_GREATER_EQUAL, 3, 0, CONTROL_FROM),
        _FLAGS,
        (_JUMP_SET, 1, 0, Flag.URGENT),
        _TAKE,
        _LEAVE,
    )


_BY_ADDRESS: Final = {
    TrafficClass.CONTROL: (_TAKE, _LEAVE),
    TrafficClass.HELLO: (_TAKE, _LEAVE),
    TrafficClass.GUEST: (_LEAVE, _TAKE),
}


def steps_of(lane: TrafficClass, neighbours: Iterable[bytes] = ()) -> tuple[_Step, ...]:
    """Return the filter of a lane.

    Args:
        neighbours: addresses, 6 bytes each; five steps for each of them.
    """
    steps: tuple[_Step, ...] = lane.value
    if lane not in _BY_ADDRESS:
        return steps
    neighbours_own, others = _BY_ADDRESS[lane]
    for mac in sorted(neighbours):
        steps += (
            (_LOAD_WORD, 0, 0, _SOURCE_AT),
            (_JUMP_EQUAL, 0, 3, int.from_bytes(mac[:4], "big")),
            (_LOAD_HALF, 0, 0, _SOURCE_AT + 4),
            (_JUMP_EQUAL, 0, 1, int.from_bytes(mac[4:], "big")),
            neighbours_own,
        )
    return (*steps, others)


def tell_neighbours(opened: socket.socket, lane: TrafficClass, neighbours: Iterable[bytes]) -> None:
    """Give a socket the addresses of a port's neighbours.

    Raises:
        OSError: not a packet socket.
    """
    _filter(opened, steps_of(lane, neighbours))


def open_port(ifname: str, lane: TrafficClass = TrafficClass.ALL, *, bypass_qdisc: bool = False) -> socket.socket:
    """Open a non-blocking socket for our EtherType on one device.

    Args:
        lane: which of our frames it sees.
        bypass_qdisc: hand frames to the driver past traffic control; quicker, but shaping (tc) is skipped too.

    Raises:
        LocalError: raw sockets are not allowed here, or no such device.
    """
    try:
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # protocol 0: hears nothing before it is bound
    except PermissionError as error:
        raise LocalError(NO_RAW_SOCKETS) from error
    try:
        attach_ethertype_filter(opened, lane)
        if lane in (TrafficClass.CONTROL, TrafficClass.HELLO, TrafficClass.URGENT):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY)
        if bypass_qdisc:
            opened.setsockopt(_SOL_PACKET, _PACKET_QDISC_BYPASS, 1)
        if lane in (TrafficClass.HELLO, TrafficClass.GUEST):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _GREETING_BUFFER_BYTES)
        else:
            large_buffers(opened)
        opened.setblocking(False)
        opened.bind((ifname, ETHERTYPE))
    except OSError as error:
        opened.close()
        raise LocalError(f"port {ifname}: {error.strerror}") from error
    return opened


def attach_ethertype_filter(opened: socket.socket, lane: TrafficClass = TrafficClass.ALL) -> None:
    """Let in what the head of this module says, as far as it belongs on this lane.

    Raises:
        OSError: not a packet socket.
    """
    _filter(opened, steps_of(lane))
    try:
        opened.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
    except OSError as error:
        if error.errno != errno.ENOPROTOOPT:
            raise


def attach_drop_all_filter(opened: socket.socket) -> None:
    """Let nothing more in; what has arrived can still be taken.

    Raises:
        OSError: not a packet socket.
    """
    _filter(opened, (_LEAVE,))


def _filter(opened: socket.socket, steps: Sequence[_Step]) -> None:
    program = array("B", b"".join(struct.pack("=HBBI", *step) for step in steps))
    opened.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(steps), program.buffer_info()[0]))


def kernel_drops(opened: socket.socket) -> int:
    """Return how many frames the kernel dropped at this socket, its buffer being full, since last asked."""
    return int(struct.unpack("=II", opened.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8))[1])


def large_buffers(opened: socket.socket) -> None:
    """Ask for large buffers both ways: past the system's limit where that is allowed, else up to it."""
    for forced, plain in (_SO_RCVBUFFORCE, socket.SO_RCVBUF), (_SO_SNDBUFFORCE, socket.SO_SNDBUF):
        try:
            opened.setsockopt(socket.SOL_SOCKET, forced, _BUFFER_BYTES)
        except PermissionError:
            opened.setsockopt(socket.SOL_SOCKET, plain, _BUFFER_BYTES)
