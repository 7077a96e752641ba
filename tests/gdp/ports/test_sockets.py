"""Ingress filters of a port's sockets: exactly one traffic class takes each frame of ours, of any length.

The filters run here as the kernel runs them (classic BPF, Linux, Documentation/networking/filter.rst), as far as they
use it.
"""

from __future__ import annotations

import errno
import socket
import struct
from itertools import product

import pytest

from gdp.frame.codec import CONTROL_FROM, Flag, Kind
from gdp.ports import sockets
from gdp.ports.sockets import TrafficClass, attach_ethertype_filter, steps_of
from tests.fixtures_forwarding import ONE, frame

LOAD_BYTE, LOAD_LENGTH, JUMP_EQUAL, JUMP_AT_LEAST, JUMP_SET, RETURN = 0x30, 0x80, 0x15, 0x35, 0x45, 0x06
LOAD_HALF, LOAD_WORD = 0x28, 0x20
PACKET_TYPE_AT = 0xFFFFF004
TO_US, TO_ALL, TO_MANY, TO_ANOTHER, FROM_US = (
    socket.PACKET_HOST,
    socket.PACKET_BROADCAST,
    socket.PACKET_MULTICAST,
    socket.PACKET_OTHERHOST,
    socket.PACKET_OUTGOING,
)
KINDS = (0x00, Kind.DATA, Kind.ACKNACK, CONTROL_FROM - 1, CONTROL_FROM, Kind.HELLO, Kind.REVOKE, 0xFF)
FLAGS = (Flag.NONE, Flag.LAST, Flag.URGENT, Flag.URGENT | Flag.RELIABLE, 0xFF, 0xFF & ~Flag.URGENT)


def takes(traffic_class: TrafficClass, packet: bytes, kind: int = TO_US, neighbours: tuple[bytes, ...] = ()) -> bool:
    """Run a traffic class's filter on a packet, from the Ethernet header on."""
    at, value = 0, 0
    steps = steps_of(traffic_class, neighbours)
    while True:
        code, if_true, if_false, operand = steps[at]
        at += 1
        if code == RETURN:
            return bool(operand)
        if code == LOAD_LENGTH:
            value = len(packet)
        elif code == LOAD_BYTE and operand == PACKET_TYPE_AT:
            value = kind
        elif code in (LOAD_HALF, LOAD_WORD):
            size = 2 if code == LOAD_HALF else 4
            value = int.from_bytes(packet[operand : operand + size], "big")
        elif code == LOAD_BYTE:
            if operand >= len(packet):
                return False
            value = packet[operand]
        else:
            holds = {
                JUMP_EQUAL: value == operand,
                JUMP_AT_LEAST: value >= operand,
                JUMP_SET: bool(value & operand),
            }[code]
            at += if_true if holds else if_false


def lanes_of(packet: bytes, kind: int = TO_US, neighbours: tuple[bytes, ...] = ()) -> list[str]:
    """Return the names of the traffic classes that take a packet."""
    return [lane.name for lane in TrafficClass if takes(lane, packet, kind, neighbours)]


def lane_of_control(kind: int) -> str:
    return "HELLO" if kind == Kind.HELLO else "CONTROL"


def neighbourhood(packet: bytes, count: int) -> tuple[bytes, ...]:
    """Return addresses, one of which is the packet's sender; the others differ from it in one byte."""
    mac = packet[6:12]
    others = (mac[:at] + bytes([mac[at] ^ 1 << bit]) + mac[at + 1 :] for bit in range(8) for at in range(6))
    return (mac, *others)[:count]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("flags", FLAGS)
def test_a_frame_to_us_comes_by_one_lane_as_its_kind_and_flags_say(kind: int, flags: int) -> None:
    of_data = "URGENT" if flags & Flag.URGENT else "ORDINARY"
    packet = frame(ONE, kind=kind, flags=flags)
    assert lanes_of(packet) == ["ALL", "GUEST" if kind >= CONTROL_FROM else of_data]
    for count in (1, 2, 40):
        known = neighbourhood(packet, count)
        assert lanes_of(packet, TO_US, known) == ["ALL", lane_of_control(kind) if kind >= CONTROL_FROM else of_data]
        assert lanes_of(packet, TO_US, known[1:]) == ["ALL", "GUEST" if kind >= CONTROL_FROM else of_data]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("flags", FLAGS)
def test_of_broadcasts_only_a_neighbours_word_comes_in(kind: int, flags: int) -> None:
    packet = frame(ONE, kind=kind, flags=flags)
    assert lanes_of(packet, TO_ALL) == (["ALL", "GUEST"] if kind >= CONTROL_FROM else [])
    assert lanes_of(packet, TO_ALL, neighbourhood(packet, 3)) == (
        ["ALL", lane_of_control(kind)] if kind >= CONTROL_FROM else []
    )


@pytest.mark.parametrize("station", [TO_MANY, TO_ANOTHER, FROM_US])
def test_what_is_for_others_comes_in_by_no_lane(station: int) -> None:
    for kind, flags in product(KINDS, FLAGS):
        assert lanes_of(frame(ONE, kind=kind, flags=flags), station) == []


@pytest.mark.parametrize("length", range(14, 20))
@pytest.mark.parametrize(("kind", "flags"), [(Kind.DATA, 0), (Kind.DATA, Flag.URGENT), (Kind.HELLO, 0)])
def test_a_frame_cut_short_still_comes_by_one_lane_so_that_it_is_counted(length: int, kind: int, flags: int) -> None:
    short = frame(ONE, kind=kind, flags=flags)[:length]
    found = lanes_of(short)
    assert found[0] == "ALL"
    assert len(found) == 2


def test_every_jump_of_a_filter_ends_inside_it() -> None:
    for lane in TrafficClass:
        steps = steps_of(lane, [bytes([each]) * 6 for each in range(64)])
        for at, (code, if_true, if_false, _) in enumerate(steps):
            assert code in (LOAD_BYTE, LOAD_LENGTH, JUMP_EQUAL, JUMP_AT_LEAST, JUMP_SET, RETURN, LOAD_HALF, LOAD_WORD)
            assert at + 1 + max(if_true, if_false) < len(steps) or code == RETURN
        assert steps[-1][0] == RETURN


class Recorder:
    """Socket that records its requests and refuses one option."""

    def __init__(self, refuses: int | None = None, number: int = errno.ENOPROTOOPT) -> None:
        self.options: dict[tuple[int, int], int | bytes] = {}
        self._refuses = refuses
        self._number = number

    def setsockopt(self, level: int, option: int, value: int | bytes) -> None:
        if option == self._refuses:
            raise OSError(self._number, "refused")
        self.options[level, option] = value


@pytest.mark.parametrize("traffic_class", TrafficClass)
def test_the_kernel_is_given_the_whole_filter(traffic_class: TrafficClass) -> None:
    asked = Recorder()
    attach_ethertype_filter(asked, traffic_class)  # type: ignore[arg-type]
    given = asked.options[socket.SOL_SOCKET, 26]
    assert isinstance(given, bytes)
    assert struct.unpack("@HP", given)[0] == len(steps_of(traffic_class))


def test_an_older_kernel_without_the_option_to_ignore_what_leaves_will_do() -> None:
    attach_ethertype_filter(Recorder(refuses=23))  # type: ignore[arg-type]
    with pytest.raises(OSError, match="refused"):
        attach_ethertype_filter(Recorder(refuses=23, number=errno.EPERM))  # type: ignore[arg-type]


def test_buffers_are_asked_for_past_the_limit_and_else_up_to_it() -> None:
    free, bound = Recorder(), BoundRecorder()
    sockets.large_buffers(free)  # type: ignore[arg-type]
    sockets.large_buffers(bound)  # type: ignore[arg-type]
    assert {option for _, option in free.options} == {32, 33}
    assert {option for _, option in bound.options} == {socket.SO_SNDBUF, socket.SO_RCVBUF}


class BoundRecorder(Recorder):
    """Socket of a process that may not exceed the system's limits."""

    def setsockopt(self, level: int, option: int, value: int | bytes) -> None:
        if option in (32, 33):
            raise PermissionError
        super().setsockopt(level, option, value)
