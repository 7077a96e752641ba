"""Binary interface between the kernel program and its control plane: the bytes of keys, values and counters.

Sans-I/O; numbers only. Numbers are in host byte order; names and addresses are bytes as in a frame::

    key      destination (32)  source, or zero for every source (32)
    entry    port, or GROUP or NOWHERE (4)  addresses (12)  alternate port or NOWHERE (4)  its addresses (12)
             group, or the pace of the one hop (4)  counter (4)  mask of the ports that its frames may come from (8)
    port     ifindex, 0 when it is down (4)  MTU (4)  flags (4)  unused (4)
    group    number of branches (4)  unused (4)
             64 times: port (2)  pace (1)  unused (1)  addresses (12)  alternate port or NOWHERE (4)  its addresses (12)
    count    frames (8)  bytes (8), on each CPU
    totals   drops by reason (8 each), the rest of ``Total`` (8 each), frames by side but the shared one (8 each), on
             each CPU
"""

from __future__ import annotations

import struct
from enum import IntEnum
from itertools import repeat
from typing import Final

from gdp.errors import DROP_COUNTERS
from gdp.limits import PACE_MAX
from gdp.names import NAME_BYTES
from gdp.switch.table import MACS_BYTES, SHARED_SIDE, Hops, Paces

INDEX_BYTES: Final = 4
KEY_BYTES: Final = 2 * NAME_BYTES
EVERY_SOURCE: Final = bytes(NAME_BYTES)
ENTRIES_DEFAULT: Final = 1 << 17  # 2 MiB of counters on every CPU
PORTS_MAX: Final = 1_024  # Python alone serves a port above that
GROUPS_MAX: Final = 4_096  # different sets of branches; entries with equal hops share one
BRANCHES_MAX: Final = 64

GROUP: Final = 0x7FFF_FFFE
NOWHERE_PORT: Final = 0x7FFF_FFFF


class EntryAt(IntEnum):
    """Offsets in an entry."""

    PORT = 0
    MACS = 4
    ALTERNATE = 4 + MACS_BYTES  # port and addresses of the alternate
    GROUP = 2 * (4 + MACS_BYTES)
    PACE = GROUP  # of an entry without a group
    COUNTER = GROUP + 4
    SIDES = COUNTER + INDEX_BYTES


class BranchAt(IntEnum):
    """Offsets in a branch, which is like the beginning of an entry."""

    PORT = 0
    PACE = 2


class PortAt(IntEnum):
    """Offsets in a port."""

    IFINDEX = 0
    MTU = 4
    FLAGS = 8


class PortFlag(IntEnum):
    """Flags of a port for the kernel program."""

    PEER = 1  # redirect to the other end of a veth pair


class Total(IntEnum):
    """Indices of the counters behind those of the drop reasons."""

    TAKEN = DROP_COUNTERS  # frames that were not punted
    COPIES = TAKEN + 1  # forwarded
    BYTES = TAKEN + 2  # of those copies, Ethernet header included
    FROM = TAKEN + 3  # frames taken from the port of a side; one counter for each side, in order


_HEAD: Final = struct.Struct(f"=I{MACS_BYTES}sI{MACS_BYTES}sI")
_TAIL: Final = struct.Struct("=IQ")
_PORT: Final = struct.Struct("=IIII")
_GROUP_HEAD: Final = struct.Struct("=II")
_BRANCH: Final = struct.Struct(f"=HBx{MACS_BYTES}sI{MACS_BYTES}s")
_NO_ALTERNATE: Final = (NOWHERE_PORT, bytes(MACS_BYTES))

ENTRY_BYTES: Final = _HEAD.size + _TAIL.size
PORT_BYTES: Final = _PORT.size
GROUP_HEAD_BYTES: Final = _GROUP_HEAD.size
BRANCH_BYTES: Final = _BRANCH.size
GROUP_BYTES: Final = GROUP_HEAD_BYTES + BRANCHES_MAX * BRANCH_BYTES
COUNT_BYTES: Final = 16
TOTALS_BYTES: Final = 8 * (Total.FROM + SHARED_SIDE)


def entry_head(
    port: int,
    macs: bytes = bytes(MACS_BYTES),
    alternate_port: int = NOWHERE_PORT,
    alternate_macs: bytes = bytes(MACS_BYTES),
    *,
    group: int = PACE_MAX,
) -> bytes:
    """Return the bytes of an entry before its counter; ``group`` is the pace, where it has none."""
    return _HEAD.pack(port, macs, alternate_port, alternate_macs, group)


def entry_tail(counter: int, sides: int) -> bytes:
    """Return the bytes of an entry after its counter."""
    return _TAIL.pack(counter, sides)


def port(ifindex: int, mtu: int, flags: int) -> bytes:
    """Return a port; ``ifindex`` 0 marks a port that is down."""
    return _PORT.pack(ifindex, mtu, flags, 0)


def group(branches: Hops, paces: Paces = ()) -> bytes:
    """Return a group of at most ``BRANCHES_MAX`` branches, with their paces, where they have some."""
    body = b"".join(
        _BRANCH.pack(branch[0], pace, *branch[1:], *(_NO_ALTERNATE if len(branch) == 2 else ()))
        for branch, pace in zip(branches, paces or repeat(PACE_MAX), strict=False)
    )
    return (_GROUP_HEAD.pack(len(branches), 0) + body).ljust(GROUP_BYTES, b"\0")
