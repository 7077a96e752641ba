"""Direct delivery of the kernel plane to the other end of a veth pair, and the cases in which it must not do so."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
from collections.abc import Iterator

import pytest
from pyroute2 import IPRoute

from gdp.errors import LocalError
from gdp.ports.kernel.abi import PortAt, PortFlag
from gdp.ports.kernel.assembler import Assembler
from gdp.ports.kernel.device import peer_is_bare
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.kernel.program import UP
from gdp.ports.kernel.syscall import Command, address, bpf, create_link, load_program
from gdp.ports.netlink import NetlinkSocket
from lab.namespaces import Space, wait_for_carrier
from lab.process import until
from netns_tests.conftest import MakeKernel
from netns_tests.test_kernel_plane import LOOK_S
from netns_tests.test_planes import PORT_MACS, far_end
from tests.fixtures_forwarding import (
    BOTH,
    IN,
    ONE,
    PEER_MACS,
    WIDE,
    filled,
    frame,
    leaves,
)

pytestmark = pytest.mark.netns

TCX_EGRESS, XDP = 47, 37
XDP_PROGRAM = 6


@contextlib.contextmanager
def passing_xdp() -> Iterator[int]:
    code, licence = Assembler(), b"Apache-2.0\0"
    code.leave(2)  # XDP_PASS
    steps = code.assemble()
    attributes = struct.pack("=IIQQ", XDP_PROGRAM, len(steps) // 8, address(steps), address(licence))
    program = bpf(Command.PROG_LOAD, bytearray(attributes.ljust(64, b"\0")), "load a program")
    yield program
    os.close(program)


@contextlib.contextmanager
def passing_program() -> Iterator[int]:
    code = Assembler()
    code.leave(UP)
    program = load_program(code.assemble(), "passing", b"Apache-2.0")
    yield program
    os.close(program)


def test_the_other_end_is_reached_straight_only_where_nothing_is_passed_by(space: Space) -> None:
    space.veth("p0", "q0", PORT_MACS[IN], PEER_MACS[IN])
    port = socket.if_nametoindex("p0")
    asking = NetlinkSocket()
    with (
        contextlib.closing(asking),
        contextlib.closing(Space()) as there,
        passing_program() as program,
        passing_xdp() as xdp,
    ):
        assert not peer_is_bare(asking, port)  # the other end is here
        space.ip("link", "set", "q0", "netns", str(there.path))
        assert peer_is_bare(asking, port)
        with IPRoute() as ask:
            ask.tc("add", "pfifo", port, handle=0x10000)
            assert not peer_is_bare(asking, port)
            ask.tc("del", "pfifo", port, handle=0x10000, parent=0xFFFFFFFF)
            assert peer_is_bare(asking, port)
            ask.tc("add", "clsact", port)
            assert peer_is_bare(asking, port)
            ask.tc("add-filter", "bpf", port, parent=0xFFFFFFF3, fd=program, name="passing", direct_action=True)
            assert not peer_is_bare(asking, port)
            ask.tc("del", "clsact", port)
        link = create_link(program, port, TCX_EGRESS)
        assert not peer_is_bare(asking, port)
        os.close(link)
        assert peer_is_bare(asking, port)
        link = there.inside(lambda: create_link(xdp, socket.if_nametoindex("q0"), XDP))
        assert not peer_is_bare(asking, port)
        os.close(link)
        assert peer_is_bare(asking, port)


def is_straight(plane: KernelPlane, port: int) -> bool:
    facts = plane._loaded.ports.get(port.to_bytes(4, sys.byteorder))
    assert facts is not None
    return bool(facts[PortAt.FLAGS] & PortFlag.PEER)


@pytest.mark.parametrize("peer", [True, False])
def test_a_frame_reaches_another_namespace_straight_or_by_the_queue_that_was_put_in_between(
    make_kernel: MakeKernel, space: Space, peer: bool
) -> None:
    with contextlib.closing(Space()) as there, far_end("q0") as sender:
        space.ip("link", "set", "q1", "netns", str(there.path))
        there.ip("link", "set", "q1", "up")
        wait_for_carrier("p1")
        plane = make_kernel(filled(), peer=peer)
        with there.inside(lambda: far_end("q1")) as receiver, IPRoute() as ask:
            assert is_straight(plane, WIDE) == peer
            sender.send(frame(ONE))
            assert receiver.recv(1 << 16) == leaves(frame(ONE), WIDE)[WIDE]
            ask.tc("add", "tbf", socket.if_nametoindex("p1"), handle=0x10000, rate=1_000_000, burst=3_000, limit=9_000)
            until(lambda: not is_straight(plane, WIDE), meanwhile=lambda: plane.poll(LOOK_S))
            sender.send(frame(BOTH))
            assert receiver.recv(1 << 16) == leaves(frame(BOTH), WIDE)[WIDE]
        assert plane._counters.frames_in == 0
        assert plane.counters.forwarded == 3


def test_a_question_that_is_refused_takes_the_plain_way_until_it_is_answered(
    make_kernel: MakeKernel, space: Space, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> list[tuple[int, bytes]]:
        raise LocalError("no answer")

    with contextlib.closing(Space()) as there:
        space.ip("link", "set", "q1", "netns", str(there.path))
        there.ip("link", "set", "q1", "up")
        wait_for_carrier("p1")
        plane = make_kernel(filled())
        assert is_straight(plane, WIDE)
        with monkeypatch.context() as patch:
            patch.setattr(NetlinkSocket, "_ask", refuse)
            plane._next_upkeep_s = plane._next_look_s = 0.0
            plane.poll(0)
            assert not is_straight(plane, WIDE)
        plane._next_upkeep_s = plane._next_look_s = 0.0
        plane.poll(0)
        assert is_straight(plane, WIDE)
