"""AF_PACKET sockets with filters that accept only our frames.

I/O; it opens and queries sockets, and keeps no state. For a socket of another kind a call raises ``OSError``.
Source: packet(7), socket(7), ``linux/filter.h`` (classic BPF, which needs no privilege beyond the raw socket itself).

A short filter in the kernel decides what a port accepts, so a frame of another protocol costs Python nothing. Accepted
are frames to the port's own address, and broadcast frames whose kind is for the neighbour itself. These are neither
forwarded nor counted: a frame to another station (``PACKET_OTHERHOST``, seen on a shared or promiscuous link), a
multicast, an echo of our own sending, and a broadcast data frame (which every switch on a shared link would forward
again).

A port may have a socket for each *traffic class*, so that no frame queues after less important ones. The
classes in order are: hellos of neighbours, their control frames, urgent frames, ordinary frames, and control frames of
strangers. A flood of one class fills only the queue of that class. A neighbour is identified by its address, which the
filters get with each change. Frames of neighbours and urgent ones carry a priority. Every
queueing discipline with bands honours it (``pfifo_fast``, ``prio``, and the access categories of Wi-Fi).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import socket
import struct
import time
from array import array
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import Final

from gdp.errors import LocalError
from gdp.frame.codec import CONTROL_FROM, ETHER_BYTES, ETHERTYPE, FLAGS_AT, KIND_AT, Flag, Kind

AS_ROOT: Final = "run this as root, or with scripts/privileged.sh"
NO_RAW_SOCKETS: Final = f"raw sockets need root or CAP_NET_RAW; {AS_ROOT}"

_SOL_PACKET: Final = 263
_PACKET_STATISTICS: Final = 6
_PACKET_IGNORE_OUTGOING: Final = 23  # Linux 4.20; older kernels rely on the filter
_SO_ATTACH_FILTER: Final = 26
_SO_SNDBUFFORCE: Final = 32
_SO_RCVBUFFORCE: Final = 33
_GREETING_BUFFER_BYTES: Final = 128 << 10  # about a hundred hellos: in a flood, more would be stale when read
_BUFFER_BYTES: Final = 16 << 20  # a 921,600-byte message is 1.6 MB of socket memory at MTU 1500

_SIOCGSTAMPNS: Final = 0x8907  # of 64-bit systems
_TIMESPEC: Final = struct.Struct("@qq")
_WAITED_MOST_S: Final = 10.0  # beyond that the system clock was set

_Step = tuple[int, int, int, int]  # code, steps to jump if true, if false, value
_LOAD_BYTE: Final = 0x30  # BPF_LD | BPF_B | BPF_ABS; a load beyond the frame's end rejects the frame
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
_CLASSED_BYTES: Final = ETHER_BYTES + FLAGS_AT + 1  # the bytes that determine a frame's class
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
    (_JUMP_GREATER_EQUAL, 1, 0, _CLASSED_BYTES),
    _LEAVE,
    _KIND,
    (_JUMP_GREATER_EQUAL, 1, 0, CONTROL_FROM),
    _LEAVE,
)
_NO_HELLO: Final = ((_JUMP_EQUAL, 0, 1, Kind.HELLO), _LEAVE)
_HELLO_ONLY: Final = ((_JUMP_EQUAL, 1, 0, Kind.HELLO), _LEAVE)


class TrafficClass(Enum):
    """Traffic class of a socket: filter steps of (code, jump if true, jump if false, value).

    In the classes of ``_BY_ADDRESS`` the sender's address decides what follows.
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
    GUEST = _CONTROL_ONLY  # of all other senders
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
        (_JUMP_GREATER_EQUAL, 0, 4, _CLASSED_BYTES),  # the plane counts shorter ones
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


def steps_of(traffic_class: TrafficClass, neighbours: Iterable[bytes] = ()) -> tuple[_Step, ...]:
    """Return the filter of a traffic class; ``neighbours``: addresses, 6 bytes each; each one adds five steps."""
    steps: tuple[_Step, ...] = traffic_class.value
    if traffic_class not in _BY_ADDRESS:
        return steps
    neighbours_own, others = _BY_ADDRESS[traffic_class]
    for mac in sorted(neighbours):
        steps += (
            (_LOAD_WORD, 0, 0, _SOURCE_AT),
            (_JUMP_EQUAL, 0, 3, int.from_bytes(mac[:4], "big")),
            (_LOAD_HALF, 0, 0, _SOURCE_AT + 4),
            (_JUMP_EQUAL, 0, 1, int.from_bytes(mac[4:], "big")),
            neighbours_own,
        )
    return (*steps, others)


def tell_neighbours(opened: socket.socket, traffic_class: TrafficClass, neighbours: Iterable[bytes]) -> None:
    """Set the addresses of a port's neighbours in the filter of a socket."""
    _filter(opened, steps_of(traffic_class, neighbours))


def open_port(ifname: str, traffic_class: TrafficClass = TrafficClass.ALL) -> socket.socket:
    """Open a non-blocking socket for our EtherType on one device.

    Args:
        traffic_class: which of our frames it accepts.

    Raises:
        LocalError: the process may not open raw sockets, or the device does not exist.
    """
    try:
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # protocol 0: receives nothing before it is bound
    except PermissionError as error:
        raise LocalError(NO_RAW_SOCKETS) from error
    try:
        attach_ethertype_filter(opened, traffic_class)
        if traffic_class in (TrafficClass.CONTROL, TrafficClass.HELLO, TrafficClass.URGENT):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY)
        if traffic_class in (TrafficClass.HELLO, TrafficClass.GUEST):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _GREETING_BUFFER_BYTES)
        else:
            large_buffers(opened)
        opened.setblocking(False)
        opened.bind((ifname, ETHERTYPE))
    except OSError as error:
        opened.close()
        raise LocalError(f"port {ifname}: {error.strerror}") from error
    return opened


def attach_ethertype_filter(opened: socket.socket, traffic_class: TrafficClass = TrafficClass.ALL) -> None:
    """Attach the filter of a traffic class, which the head of this module describes."""
    _filter(opened, steps_of(traffic_class))
    try:
        opened.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
    except OSError as error:
        if error.errno != errno.ENOPROTOOPT:
            raise


def attach_drop_all_filter(opened: socket.socket) -> None:
    """Attach a filter that rejects every new frame; frames that already arrived can still be read."""
    _filter(opened, (_LEAVE,))


def _filter(opened: socket.socket, steps: Sequence[_Step]) -> None:
    program = array("B", b"".join(struct.pack("=HBBI", *step) for step in steps))
    opened.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(steps), program.buffer_info()[0]))


def kernel_drops(opened: socket.socket) -> int:
    """Return how many frames the kernel dropped at this socket's full buffer since the last call."""
    return int(struct.unpack("=II", opened.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8))[1])


def keep_arrival_times(opened: socket.socket) -> None:
    """Let the kernel keep the arrival time of the frame that was read last."""
    with contextlib.suppress(OSError):  # the first call starts it, and finds none yet
        fcntl.ioctl(opened, _SIOCGSTAMPNS, bytearray(_TIMESPEC.size))


def waited_s(opened: socket.socket) -> float:
    """Return for how many seconds the frame that was read last had waited at the socket; 0: not known.

    Source: socket(7), SIOCGSTAMP. It is one system call for a batch of frames, and no work for each of them.
    """
    stamp = bytearray(_TIMESPEC.size)
    try:
        fcntl.ioctl(opened, _SIOCGSTAMPNS, stamp)
    except OSError:
        return 0.0
    seconds, nanoseconds = _TIMESPEC.unpack(stamp)
    since_s = (time.time_ns() - (seconds * 1_000_000_000 + nanoseconds)) * 1e-9
    return since_s if 0.0 <= since_s < _WAITED_MOST_S else 0.0


def large_buffers(opened: socket.socket) -> None:
    """Set large buffers in both directions: past the system's limit if allowed, else up to it."""
    for forced, plain in (_SO_RCVBUFFORCE, socket.SO_RCVBUF), (_SO_SNDBUFFORCE, socket.SO_SNDBUF):
        try:
            opened.setsockopt(socket.SOL_SOCKET, forced, _BUFFER_BYTES)
        except PermissionError:
            opened.setsockopt(socket.SOL_SOCKET, plain, _BUFFER_BYTES)
