"""Packet rings: frames are sent and received through memory shared with the kernel; only a trial.

I/O. Source: ``linux/if_packet.h``, Documentation/networking/packet_mmap.rst. A ring has ``SLOTS`` slots of one size, or
with ``TPACKET_V3`` blocks that the kernel fills::

    slot of TPACKET_V2     [ header 32 | Ethernet header 14 | frame ... ]          sent
                           [ header 32 | address, padding | Ethernet header ... ]  received, at ``tp_mac``
    block of TPACKET_V3    [ header 48 | packet | packet | ... ]                   each packet names the next one
"""

from __future__ import annotations

import ctypes
import mmap
import socket
import struct
from array import array
from collections.abc import Sequence
from typing import Final

from gdp.frame.codec import ETHER_BYTES
from gdp.frame.kinds import ETHERTYPE
from gdp.ports.sockets import open_port

__all__ = ["BlockRing", "SendRing", "SlotRing"]

_SOL_PACKET: Final = 263
_PACKET_RX_RING, _PACKET_VERSION, _PACKET_TX_RING = 5, 10, 13
_TPACKET_V2, _TPACKET_V3 = 1, 2
_SEND_REQUEST, _USER = 1, 1
_HEADER_BYTES: Final = 32  # tpacket2_hdr, aligned
_SLOTS: Final = 256
_BLOCK_BYTES: Final = 1 << 20
_BLOCKS: Final = 4
_RETIRE_MS: Final = 1  # the least: a block that is not full is handed over after it
_PACKET: Final = struct.Struct("=III")  # of TPACKET_V3: next offset, seconds, nanoseconds
_MAC_AT, _LENGTH_AT = 24, 12  # in tpacket3_hdr
_FIRST_AT, _COUNT_AT, _STATUS_AT = 16, 12, 8  # in tpacket_block_desc, with its block header


def _slot_bytes(frame_bytes: int) -> int:
    """Return the size of a slot, a power of two, so that blocks have no gaps."""
    return 1 << (frame_bytes + 2 * _HEADER_BYTES + ETHER_BYTES + 32).bit_length()


def _map_slots(opened: socket.socket, option: int, slot_bytes: int) -> mmap.mmap:
    opened.setsockopt(_SOL_PACKET, _PACKET_VERSION, struct.pack("=I", _TPACKET_V2))
    block = max(_BLOCK_BYTES, slot_bytes)
    blocks = _SLOTS * slot_bytes // block or 1
    slots = blocks * block // slot_bytes
    opened.setsockopt(_SOL_PACKET, option, struct.pack("=IIII", block, blocks, slot_bytes, slots))
    return mmap.mmap(opened.fileno(), blocks * block)


class SendRing:
    """Ring from which frames are sent: they are copied into slots, and one system call sends all of them."""

    def __init__(self, ifname: str, frame_bytes: int, macs: bytes, *, bypass_qdisc: bool) -> None:
        self._socket = open_port(ifname, bypass_qdisc=bypass_qdisc)
        self._slot = _slot_bytes(frame_bytes)
        self._memory = _map_slots(self._socket, _PACKET_TX_RING, self._slot)
        self._bytes = memoryview(self._memory)
        words, step = self._bytes.cast("I"), self._slot // 4
        self._count = len(self._memory) // self._slot
        self._status, self._lengths = words[0::step], words[1::step]
        self._send = ctypes.CDLL(None, use_errno=True).send
        self._next = 0
        for at in range(_HEADER_BYTES, len(self._memory), self._slot):
            self._bytes[at : at + ETHER_BYTES] = macs + ETHERTYPE.to_bytes(2, "big")

    def send(self, frames: Sequence[bytes]) -> int:
        """Send frames, at most as many as there are slots, without waiting; return the bytes that left."""
        until_end = self._count - self._next  # the kernel takes every slot in turn
        self._put(frames[:until_end])
        if len(frames) > until_end:
            self._put(frames[until_end:])
        return int(self._send(self._socket.fileno(), None, 0, int(socket.MSG_DONTWAIT)))

    def _put(self, frames: Sequence[bytes]) -> None:
        memory, step, first, count = self._bytes, self._slot, self._next, len(frames)
        at = first * step + _HEADER_BYTES + ETHER_BYTES
        for frame in frames:
            memory[at : at + len(frame)] = frame
            at += step
        lengths = array("I", [len(frame) + ETHER_BYTES for frame in frames])
        self._lengths[first : first + count] = memoryview(lengths)
        self._status[first : first + count] = memoryview(array("I", [_SEND_REQUEST] * count))
        self._next = (first + count) % self._count

    def close(self) -> None:
        """Free the ring."""
        for view in (self._status, self._lengths, self._bytes):
            view.release()
        self._socket.close()


class SlotRing:
    """Ring with one slot for each received frame (TPACKET_V2)."""

    def __init__(self, ifname: str, frame_bytes: int) -> None:
        self.socket = open_port(ifname)
        self._slot = _slot_bytes(frame_bytes)
        self._memory = _map_slots(self.socket, _PACKET_RX_RING, self._slot)
        self._words = memoryview(self._memory).cast("I")
        self._count = len(self._memory) // self._slot
        self._next = 0

    def receive(self) -> list[bytes]:
        """Return the frames that wait, from the GDP header on."""
        words, step, frames = self._words, self._slot // 4, []
        while words[self._next * step] & _USER:
            word = self._next * step
            begin = word * 4 + (words[word + 3] & 0xFFFF)
            frames.append(self._memory[begin + ETHER_BYTES : begin + words[word + 2]])
            words[word] = 0
            self._next = (self._next + 1) % self._count
        return frames

    def close(self) -> None:
        """Free the ring."""
        self.socket.close()


class BlockRing:
    """Ring of blocks that hold many received frames each (TPACKET_V3)."""

    def __init__(self, ifname: str, frame_bytes: int) -> None:
        self.socket = open_port(ifname)
        self.socket.setsockopt(_SOL_PACKET, _PACKET_VERSION, struct.pack("=I", _TPACKET_V3))
        slot = _slot_bytes(frame_bytes)
        slots = _BLOCKS * _BLOCK_BYTES // slot
        request = struct.pack("=IIIIIII", _BLOCK_BYTES, _BLOCKS, slot, slots, _RETIRE_MS, 0, 0)
        self.socket.setsockopt(_SOL_PACKET, _PACKET_RX_RING, request)
        self._memory = mmap.mmap(self.socket.fileno(), _BLOCKS * _BLOCK_BYTES)
        self._words = memoryview(self._memory).cast("I")
        self._next = 0

    def receive(self) -> list[bytes]:
        """Return the frames of the blocks that the kernel has handed over, from the GDP header on."""
        frames, words, memory = [], self._words, self._memory
        while words[(at := self._next * _BLOCK_BYTES) // 4 + _STATUS_AT // 4] & _USER:
            count = words[(at + _COUNT_AT) // 4]
            packet = at + words[(at + _FIRST_AT) // 4]
            for _ in range(count):
                (following, _, _) = _PACKET.unpack_from(memory, packet)
                length, mac = words[(packet + _LENGTH_AT) // 4], words[(packet + _MAC_AT) // 4] & 0xFFFF
                frames.append(memory[packet + mac + ETHER_BYTES : packet + mac + length])
                packet += following
            words[(at + _STATUS_AT) // 4] = 0
            self._next = (self._next + 1) % _BLOCKS
        return frames

    def close(self) -> None:
        """Free the ring."""
        self.socket.close()
