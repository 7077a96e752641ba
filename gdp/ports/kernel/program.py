"""Forwarding decision as an eBPF program on the ingress of every port, written in the order of its steps.

Sans-I/O; map descriptors in, instructions out.
Source: ``gdp.switch.forwarder.decide``, from which the program must never differ; Linux, include/uapi/linux/bpf.h, for
the helpers and ``struct __sk_buff``; linux/pkt_sched.h for the priority. The codec has the header's offsets, which
tests compare with the normative Scapy layer, because Scapy takes longer to load than everything else in a switch.

The program *takes* a frame (forwards it, or drops and counts it) if it is sure. Any other frame goes *up*: it continues
to the port's packet socket, where Python decides with the same table and counts. So the program does not handle rare
cases::

    to our station? -> leased, and over? -> whole header? -> version, kind, hops, length good? -> known?
          no: up            yes: up             no: up                 no: up                     no: up
                                                      known -> another side's: drop | nowhere | one hop | a group

A hop whose pace is below the frame's gets no copy. While a hop's port is down, the program uses its alternate. One
write into the map of ports takes a port down, however many entries name it.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import Final

from gdp.errors import DropReason
from gdp.frame.codec import (
    CONTROL_FROM,
    ETHER_BYTES,
    ETHERTYPE,
    HOPS_MASK,
    OVERHEAD_BYTES,
    SECOND_PATH,
    VERSION,
    Flag,
    layout,
)
from gdp.names import NAME_BYTES
from gdp.ports.kernel.abi import (
    BRANCH_BYTES,
    BRANCHES_MAX,
    GROUP,
    GROUP_HEAD_BYTES,
    INDEX_BYTES,
    NOWHERE_PORT,
    BranchAt,
    EntryAt,
    PortAt,
    PortFlag,
    Total,
)
from gdp.ports.kernel.assembler import Assembler, Reg
from gdp.switch.table import MACS_BYTES, SHARED_SIDE

LICENCE: Final = b"Apache-2.0"  # the helpers used here require no other licence
UP: Final = -1  # TC_ACT_UNSPEC, TCX_NEXT: the next program at this hook gets the frame
DROP: Final = 2  # TC_ACT_SHOT, TCX_DROP
REDIRECT: Final = 7  # TC_ACT_REDIRECT, TCX_REDIRECT

_SKB: Final = Reg.R6
_UNTIL, _FRAME, _PORT, _BRANCH = (Reg.R7,) * 4  # one at a time; pointers into the frame become invalid in a group
_TOTALS: Final = Reg.R8
_ENTRY, _TURN = Reg.R9, Reg.R9

# struct __sk_buff
_LEN, _PKT_TYPE, _PROTOCOL, _VLAN_PRESENT, _PRIORITY, _DATA, _DATA_END = 0, 4, 16, 20, 32, 76, 80
# enum bpf_func_id
_LOOKUP, _KTIME_NS, _STORE_BYTES, _CLONE_REDIRECT, _REDIRECT, _PULL, _REDIRECT_PEER = 1, 5, 9, 13, 23, 39, 155

_URGENT_PRIORITY: Final = 6  # TC_PRIO_INTERACTIVE: the first band of pfifo_fast and prio
_CONGESTION_NOTED: Final = 2  # NET_XMIT_CN: sent, though the queue is getting full

# The stack, from R10 down:
#
#     -64  key: destination (32)  every source (32)
#     -72  index of a map (4)  unused (4)
#     -80  pointer to the group (8)
#     -88  ifindex of a branch (8)
#     -96  pace of the frame (8)
_KEY: Final = -2 * NAME_BYTES
_INDEX: Final = _KEY - 8
_GROUP: Final = _INDEX - 8
_IFINDEX: Final = _GROUP - 8
_PACE: Final = _IFINDEX - 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Descriptors:
    """File descriptors of the maps that the program reads.

    Without ``lease`` the program forwards for as long as it is loaded.
    """

    entries: int
    ports: int
    groups: int
    totals: int
    counts: int
    lease: int | None = None


class ForwarderProgram(Assembler):
    """Assembler of the forwarding program, one method per step."""

    def __init__(self, maps: Descriptors, side: int) -> None:
        super().__init__()
        self._side = side
        self._maps = maps
        places = layout()
        self._at = {name: ETHER_BYTES + offset for name, (offset, _) in places.items()}

    def build(self) -> bytes:
        """Return the instructions of the whole program; call it once."""
        self._only_ours()
        if self._maps.lease is not None:
            self._only_while_valid(self._maps.lease)
        self._whole_header()
        self._good_header()
        self._look_up()
        self._from_its_side()
        self._urgency()
        self._where()
        self._one_hop()
        self._group()
        self._ends()
        self._second_path()
        return self.assemble()

    def _only_ours(self) -> None:
        """Accept frames to this station, of our EtherType, and in no VLAN."""
        self.move(_SKB, Reg.R1)
        self.load(Reg.R2, _SKB, _PROTOCOL, 4)
        self.jump_if(Reg.R2, "!=", socket.htons(ETHERTYPE), "up")
        self.load(Reg.R2, _SKB, _PKT_TYPE, 4)
        self.jump_if(Reg.R2, "!=", socket.PACKET_HOST, "up")
        self.load(Reg.R2, _SKB, _VLAN_PRESENT, 4)
        self.jump_if(Reg.R2, "!=", 0, "up")

    def _only_while_valid(self, lease: int) -> None:
        """Forward only while the lease is valid, because the program may outlive its switch."""
        self._find(lease, 0)
        self.jump_if(Reg.R0, "==", 0, "up")
        self.load(_UNTIL, Reg.R0, 0, 8)
        self.call(_KTIME_NS)
        self.jump_if(Reg.R0, ">", _UNTIL, "up")

    def _whole_header(self) -> None:
        """Make the header readable, then prove its length to the verifier."""
        self.load(Reg.R2, _SKB, _DATA, 4)
        self.load(Reg.R3, _SKB, _DATA_END, 4)
        self.add(Reg.R2, OVERHEAD_BYTES)
        self.jump_if(Reg.R2, "<=", Reg.R3, "in one piece")
        self.move(Reg.R1, _SKB)
        self.move(Reg.R2, OVERHEAD_BYTES)
        self.call(_PULL)
        self.jump_if(Reg.R0, "!=", 0, "up")
        self.label("in one piece")
        self.load(_FRAME, _SKB, _DATA, 4)
        self.load(Reg.R3, _SKB, _DATA_END, 4)
        self.move(Reg.R2, _FRAME)
        self.add(Reg.R2, OVERHEAD_BYTES)
        self.jump_if(Reg.R2, ">", Reg.R3, "up")

    def _good_header(self) -> None:
        self.load(Reg.R2, _FRAME, self._at["version"], 1)
        self.jump_if(Reg.R2, "!=", VERSION, "up")
        self.load(Reg.R2, _FRAME, self._at["kind"], 1)
        self.jump_if(Reg.R2, ">=", CONTROL_FROM, "up")
        self.load(Reg.R2, _FRAME, self._at["length"], 2)
        self.from_big_endian(Reg.R2, 16)
        self.load(Reg.R3, _SKB, _LEN, 4)
        self.subtract(Reg.R3, OVERHEAD_BYTES)
        self.jump_if(Reg.R2, ">", Reg.R3, "up")
        self.load(Reg.R2, _FRAME, self._at["hops_left"], 1)
        self.jump_if(Reg.R2, "&", SECOND_PATH, "second path")
        self.jump_if(Reg.R2, "<=", 1, "up")

    def _look_up(self) -> None:
        """Look up destination and source, contiguous in the frame as in a key; then the destination alone."""
        self.load_map(Reg.R1, self._maps.entries)
        self.move(Reg.R2, _FRAME)
        self.add(Reg.R2, self._at["destination"])
        self.call(_LOOKUP)
        self.jump_if(Reg.R0, "!=", 0, "known")
        for at in range(0, NAME_BYTES, 8):
            self.load(Reg.R2, _FRAME, self._at["destination"] + at, 8)
            self.store(Reg.R10, _KEY + at, Reg.R2, 8)
            self.store(Reg.R10, _KEY + NAME_BYTES + at, 0, 8)
        self._find_entry()
        self.jump_if(Reg.R0, "==", 0, "up")
        self.label("known")
        self.move(_ENTRY, Reg.R0)
        self._find(self._maps.totals, 0)
        self.jump_if(Reg.R0, "==", 0, "up")
        self.move(_TOTALS, Reg.R0)

    def _second_path(self) -> None:
        """Look up a second copy by the destination with its last bit inverted. It costs other frames one jump.

        A miss goes up: the map may have left an entry out.
        """
        self.label("second path")
        self.mask(Reg.R2, HOPS_MASK)
        self.jump_if(Reg.R2, "<=", 1, "up")
        for at in range(0, 2 * NAME_BYTES, 8):
            self.load(Reg.R2, _FRAME, self._at["destination"] + at, 8)
            self.store(Reg.R10, _KEY + at, Reg.R2, 8)
        last = NAME_BYTES - 1
        self.load(Reg.R2, _FRAME, self._at["destination"] + last, 1)
        self.exclusive_or(Reg.R2, 1)
        self.store(Reg.R10, _KEY + last, Reg.R2, 1)
        self._find_entry()
        self.jump_if(Reg.R0, "!=", 0, "known")
        for at in range(0, NAME_BYTES, 8):
            self.store(Reg.R10, _KEY + NAME_BYTES + at, 0, 8)
        self._find_entry()
        self.jump_if(Reg.R0, "!=", 0, "known")
        self.jump("up")

    def _from_its_side(self) -> None:
        """Check the reverse path: frames of a publisher must come from its direction."""
        self.load(Reg.R2, _ENTRY, EntryAt.SIDES, 8)
        self.move(Reg.R3, 1)
        self.shift_left(Reg.R3, self._side)
        self.jump_if(Reg.R2, "&", Reg.R3, "from its side")
        self._count_taken()
        self._count(DropReason.WRONG_SIDE)
        self.jump("drop")
        self.label("from its side")

    def _urgency(self) -> None:
        """Set the priority of urgent frames, so that the queue of a device sends them first."""
        self.load(Reg.R2, _FRAME, self._at["flags"], 1)
        self.jump_if(Reg.R2, "&", Flag.URGENT, "urgent")
        self.label("any urgency")

    def _where(self) -> None:
        self.load(Reg.R2, _ENTRY, EntryAt.PORT, 4)
        self.jump_if(Reg.R2, "==", GROUP, "group")
        self.jump_if(Reg.R2, "==", NOWHERE_PORT, "nowhere")
        # any other value falls into ``_one_hop`` with the port in R2

    def _one_hop(self) -> None:
        """Forward to one hop. R2: the port; R4 points to the chosen port in the entry, then its addresses."""
        self.load(Reg.R3, _FRAME, self._at["pace"], 1)
        self.load(Reg.R4, _ENTRY, EntryAt.PACE, 4)
        self.jump_if(Reg.R3, ">", Reg.R4, "thinned")
        self._find(self._maps.ports, Reg.R2)
        self.jump_if(Reg.R0, "==", 0, "up")
        self.move(Reg.R4, _ENTRY)
        self.load(Reg.R2, Reg.R0, PortAt.IFINDEX, 4)
        self.jump_if(Reg.R2, "!=", 0, "port chosen")
        self.load(Reg.R2, _ENTRY, EntryAt.ALTERNATE, 4)
        self.jump_if(Reg.R2, "==", NOWHERE_PORT, "down")
        self._find(self._maps.ports, Reg.R2)
        self.jump_if(Reg.R0, "==", 0, "up")
        self.load(Reg.R2, Reg.R0, PortAt.IFINDEX, 4)
        self.jump_if(Reg.R2, "==", 0, "down")
        self.move(Reg.R4, _ENTRY)
        self.add(Reg.R4, EntryAt.ALTERNATE)
        self.label("port chosen")
        self._frame_bytes(Reg.R2)
        self.load(Reg.R3, Reg.R0, PortAt.MTU, 4)
        self.jump_if(Reg.R2, ">", Reg.R3, "up")
        self._one_hop_fewer()
        for at in range(0, MACS_BYTES, 4):
            self.load(Reg.R2, Reg.R4, EntryAt.MACS + at, 4)
            self.store(_FRAME, at, Reg.R2, 4)
        self.move(_PORT, Reg.R0)  # the frame is not read after this
        self._count_taken()
        self._count_copy()
        self._count_entry("one hop")
        self.load(Reg.R1, _PORT, PortAt.IFINDEX, 4)
        self.load(Reg.R3, _PORT, PortAt.FLAGS, 4)
        self.move(Reg.R2, 0)
        self.jump_if(Reg.R3, "&", PortFlag.PEER, "to the peer")
        self.call(_REDIRECT)
        self.leave()
        self.label("to the peer")
        self.call(_REDIRECT_PEER)
        self.leave()

    def _group(self) -> None:
        """Send a copy to every branch that can take it; after the first copy nothing may go up."""
        self._begin_group()
        self.move(_TURN, 0)
        self.label("branch")
        self.jump_if(_TURN, ">=", BRANCHES_MAX, "drop")
        self.load(Reg.R1, Reg.R10, _GROUP, 8)
        self.load(Reg.R2, Reg.R1, 0, 4)
        self.jump_if(_TURN, ">=", Reg.R2, "drop")
        self.move(_BRANCH, _TURN)
        self.shift_left(_BRANCH, BRANCH_BYTES.bit_length() - 1)
        self.add(_BRANCH, Reg.R1)
        self.load(Reg.R2, _BRANCH, GROUP_HEAD_BYTES + BranchAt.PACE, 1)
        self.load(Reg.R3, Reg.R10, _PACE, 8)
        self.jump_if(Reg.R3, ">", Reg.R2, "branch thinned")
        self.load(Reg.R2, _BRANCH, GROUP_HEAD_BYTES + BranchAt.PORT, 2)
        self._find(self._maps.ports, Reg.R2)
        self.jump_if(Reg.R0, "==", 0, "branch down")
        self.load(Reg.R2, Reg.R0, PortAt.IFINDEX, 4)
        self.jump_if(Reg.R2, "!=", 0, "branch chosen")
        self.load(Reg.R2, _BRANCH, GROUP_HEAD_BYTES + EntryAt.ALTERNATE, 4)
        self.jump_if(Reg.R2, "==", NOWHERE_PORT, "branch down")
        self._find(self._maps.ports, Reg.R2)
        self.jump_if(Reg.R0, "==", 0, "branch down")
        self.load(Reg.R2, Reg.R0, PortAt.IFINDEX, 4)
        self.jump_if(Reg.R2, "==", 0, "branch down")
        self.add(_BRANCH, EntryAt.ALTERNATE)
        self.label("branch chosen")
        self.store(Reg.R10, _IFINDEX, Reg.R2, 8)
        self._frame_bytes(Reg.R2)
        self.load(Reg.R3, Reg.R0, PortAt.MTU, 4)
        self.jump_if(Reg.R2, ">", Reg.R3, "branch too narrow")
        self._send_copy()
        self.jump_if(Reg.R0, "==", 0, "branch sent")
        self.jump_if(Reg.R0, "!=", _CONGESTION_NOTED, "branch full")
        self.label("branch sent")
        self._count_copy()
        self.label("next branch")
        self.add(_TURN, 1)
        self.jump("branch")
        for label, reason in (
            ("branch thinned", DropReason.THINNED),
            ("branch down", DropReason.PORT_DOWN),
            ("branch too narrow", DropReason.TOO_BIG),
            ("branch full", DropReason.PORT_FULL),
        ):
            self.label(label)
            self._count(reason)
            self.jump("next branch")

    def _begin_group(self) -> None:
        """Find the group of an entry, and keep what the frame shows no longer once it was sent."""
        self.label("group")
        self.load(Reg.R2, _ENTRY, EntryAt.GROUP, 4)
        self._find(self._maps.groups, Reg.R2)
        self.jump_if(Reg.R0, "==", 0, "up")
        self.store(Reg.R10, _GROUP, Reg.R0, 8)
        self.load(Reg.R2, _FRAME, self._at["pace"], 1)
        self.store(Reg.R10, _PACE, Reg.R2, 8)
        self._one_hop_fewer()
        self._count_taken()
        self._count_entry("group")

    def _send_copy(self) -> None:
        """Write the branch's addresses into the frame and send a clone; R0: 0, or an error."""
        self.move(Reg.R1, _SKB)
        self.move(Reg.R2, 0)
        self.move(Reg.R3, _BRANCH)
        self.add(Reg.R3, GROUP_HEAD_BYTES + INDEX_BYTES)
        self.move(Reg.R4, MACS_BYTES)
        self.move(Reg.R5, 0)
        self.call(_STORE_BYTES)
        self.jump_if(Reg.R0, "!=", 0, "branch full")
        self.move(Reg.R1, _SKB)
        self.load(Reg.R2, Reg.R10, _IFINDEX, 8)
        self.move(Reg.R3, 0)
        self.call(_CLONE_REDIRECT)

    def _ends(self) -> None:
        self.label("thinned")
        self._count_taken()
        self._count(DropReason.THINNED)
        self.jump("drop")
        self.label("nowhere")
        self._count_taken()
        self._count(DropReason.NO_ROUTE)
        self.jump("drop")
        self.label("down")
        self._count_taken()
        self._count(DropReason.PORT_DOWN)
        # falls into "drop"; a group, which has already counted, also ends there
        self.label("drop")
        self.leave(DROP)
        self.label("urgent")
        self.move(Reg.R2, _URGENT_PRIORITY)
        self.store(_SKB, _PRIORITY, Reg.R2, 4)
        self.jump("any urgency")
        self.label("up")
        self.leave(UP)

    # building blocks

    def _find(self, descriptor: int, index: Reg | int) -> None:
        """Set R0 to the value at an index of a map, or 0."""
        self.store(Reg.R10, _INDEX, index, 4)
        self.load_map(Reg.R1, descriptor)
        self.move(Reg.R2, Reg.R10)
        self.add(Reg.R2, _INDEX)
        self.call(_LOOKUP)

    def _find_entry(self) -> None:
        """Set R0 to the entry of the key on the stack, or 0."""
        self.load_map(Reg.R1, self._maps.entries)
        self.move(Reg.R2, Reg.R10)
        self.add(Reg.R2, _KEY)
        self.call(_LOOKUP)

    def _frame_bytes(self, to: Reg) -> None:
        """Load the bytes that count against an MTU: all after the Ethernet header, padding too."""
        self.load(to, _SKB, _LEN, 4)
        self.subtract(to, ETHER_BYTES)

    def _one_hop_fewer(self) -> None:
        self.load(Reg.R2, _FRAME, self._at["hops_left"], 1)
        self.subtract(Reg.R2, 1)
        self.store(_FRAME, self._at["hops_left"], Reg.R2, 1)

    def _count(self, index: int, amount: Reg | int = 1) -> None:
        """Add to a counter, not atomically: receiving never interrupts receiving on one CPU."""
        self.load(Reg.R1, _TOTALS, 8 * index, 8)
        self.add(Reg.R1, amount)
        self.store(_TOTALS, 8 * index, Reg.R1, 8)

    def _count_taken(self) -> None:
        self._count(Total.TAKEN)
        if self._side < SHARED_SIDE:
            self._count(Total.FROM + self._side)

    def _count_copy(self) -> None:
        self._count(Total.COPIES)
        self.load(Reg.R2, _SKB, _LEN, 4)
        self._count(Total.BYTES, Reg.R2)

    def _count_entry(self, where: str) -> None:
        self.load(Reg.R2, _ENTRY, EntryAt.COUNTER, 4)
        self._find(self._maps.counts, Reg.R2)
        self.jump_if(Reg.R0, "==", 0, f"{where} not counted")
        self.load(Reg.R2, _SKB, _LEN, 4)
        for at, amount in ((0, 1), (8, Reg.R2)):
            self.load(Reg.R1, Reg.R0, at, 8)
            self.add(Reg.R1, amount)
            self.store(Reg.R0, at, Reg.R1, 8)
        self.label(f"{where} not counted")


def forwarder(maps: Descriptors, side: int = 0) -> bytes:
    """Return the instructions of the program for a port; ``side``: its bit in an entry's mask."""
    return ForwarderProgram(maps, side).build()
