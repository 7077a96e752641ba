"""Remains of the kernel plane after every kind of end, and its errors where it is not permitted."""

from __future__ import annotations

import errno
import os
import socket
import struct
import sys
import time
from collections.abc import Iterator

import pytest
from pyroute2 import IPRoute

from gdp.errors import LocalError
from gdp.ports.kernel.assembler import Assembler
from gdp.ports.kernel.loaded_program import PROGRAM
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.kernel.syscall import (
    BpfError,
    attached,
    bpf,
    create_link,
    info_of,
    load_program,
    name_of,
)
from gdp.switch.table import Table
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import LabProcess, calling, until
from netns_tests.test_planes import PORT_MACS, far_end
from tests.fixtures_forwarding import MTUS, ONE, PEER_MACS, WIDE, filled, frame, leaves

pytestmark = pytest.mark.netns

TCX_INGRESS = 46
PROG_GET_NEXT_ID, LINK_GET_FD_BY_ID, LINK_GET_NEXT_ID = 11, 30, 31  # enum bpf_cmd
PATIENCE_S = 20.0


@pytest.fixture
def ports(space: Space) -> list[str]:
    for port, mac in PORT_MACS.items():
        space.veth(f"p{port}", f"q{port}", mac, PEER_MACS[port], MTUS[port])
    try:
        KernelPlane().close()
    except LocalError as error:
        pytest.skip(str(error).partition("\n")[0])
    return [f"p{port}" for port in PORT_MACS]


def keep_plane(mode: str, *ports: str) -> None:
    """Print the programs of a kernel plane, and poll it until killed; a process of its own."""
    plane = KernelPlane(ports, table(), clsact=mode == "filter")
    print(*(program_id(plane._loaded.program_of(port)) for port in plane.ports), flush=True)
    while True:
        plane.poll(None)


def running(machine: LabMachine, mode: str, ports: list[str]) -> tuple[LabProcess, list[int]]:
    """Start a process with a kernel plane; return it with its programs."""
    child = machine.launch(calling(keep_plane, mode, *ports))
    return child, [int(each) for each in child.read_line(PATIENCE_S).split()]


def program_id(program: int) -> int:
    """Return the id of an open program, constant while it is loaded."""
    return int(struct.unpack_from("=II", info_of(program))[1])


def ids(next_id: int) -> Iterator[int]:
    """Yield the ids of all programs (or links) of the system."""
    at = 0
    while True:
        attributes = bytearray(struct.pack("=II8x", at, 0))
        try:
            bpf(next_id, attributes, "list what is loaded")
        except BpfError as error:
            if error.number == errno.ENOENT:
                return
            raise
        at = struct.unpack_from("=II", attributes)[1]
        yield at


def loaded() -> dict[int, str]:
    """Return the names of all programs in the kernel; others on this machine may have loaded theirs."""
    return {each: name for each in ids(PROG_GET_NEXT_ID) if (name := name_of(each)) is not None}


def links_of(program: int) -> int:
    """Return how many links a program has."""
    count = 0
    for each in ids(LINK_GET_NEXT_ID):
        try:
            opened = bpf(LINK_GET_FD_BY_ID, bytearray(struct.pack("=I12x", each)), "open a link")
        except BpfError as error:
            if error.number == errno.ENOENT:  # removed in the meantime
                continue
            raise
        count += struct.unpack_from("=III", info_of(opened))[2] == program
        os.close(opened)
    return count


def gone(program: int) -> bool:
    """Wait until a program is gone: the kernel frees it a moment after its last user."""
    return until(lambda: program not in loaded(), f"the end of program {program}", PATIENCE_S)


def filters(ifname: str) -> list[str]:
    with IPRoute() as ask:
        found = ask.get_filters(index=socket.if_nametoindex(ifname), parent=0xFFFFFFF2)
        return [each.get_nested("TCA_OPTIONS", "TCA_BPF_NAME") or "" for each in found if each["handle"]]


def has_clsact(ifname: str) -> bool:
    with IPRoute() as ask:
        found = ask.get_qdiscs(index=socket.if_nametoindex(ifname))
        return any(each.get_attr("TCA_KIND") == "clsact" for each in found)


def table() -> Table:
    return filled()


def crosses(patience_s: float) -> bool:
    """Return whether a frame that enters ``p0`` leaves ``p1`` within this time without help from Python."""
    sender, receiver = far_end("q0"), far_end("q1")
    with sender, receiver:
        receiver.settimeout(patience_s)
        sender.send(frame(ONE))
        try:
            return receiver.recv(1 << 16) == leaves(frame(ONE), WIDE)[WIDE]
        except TimeoutError:
            return False


@pytest.mark.parametrize("clsact", [False, True], ids=["link", "filter"])
def test_opening_and_closing_again_and_again_leaves_nothing(ports: list[str], clsact: bool) -> None:
    descriptors = os.listdir("/proc/self/fd")
    for _ in range(3):
        plane = KernelPlane(ports, table(), clsact=clsact)
        mine = [program_id(plane._loaded.program_of(port)) for port in range(len(ports))]
        names = loaded()
        assert {names[each] for each in mine} == {PROGRAM}
        assert list(map(links_of, mine)) == [0 if clsact else 1] * len(ports)
        plane.close()
        assert all(map(gone, mine))
        assert list(map(links_of, mine)) == [0] * len(ports)
    assert len(os.listdir("/proc/self/fd")) == len(descriptors)
    assert not any(map(has_clsact, ports))


def test_a_killed_switch_leaves_no_program_and_no_link(machine: LabMachine, ports: list[str]) -> None:
    child, mine = running(machine, "link", ports)
    assert list(map(links_of, mine)) == [1] * len(ports)
    assert crosses(PATIENCE_S)
    machine.kill(child)
    assert all(map(gone, mine))
    assert not crosses(0.1)
    assert attached(socket.if_nametoindex(ports[0]), TCX_INGRESS) == []


def test_the_filter_of_a_killed_switch_forwards_no_more_and_the_next_run_replaces_it(
    machine: LabMachine, ports: list[str]
) -> None:
    child, mine = running(machine, "filter", ports)
    assert crosses(PATIENCE_S)
    machine.kill(child)
    assert [name.startswith(f"{PROGRAM}:{child.pid}:") for name in filters(ports[0])] == [True]
    until(lambda: not crosses(0.1), "the end of its lease", PATIENCE_S)
    plane = KernelPlane(ports, table(), clsact=True)
    assert all(map(gone, mine))
    assert [name.split(":")[1] for name in filters(ports[0])] == [str(os.getpid())]
    assert crosses(PATIENCE_S)
    plane.close()
    assert not any(map(has_clsact, ports))


@pytest.mark.parametrize(
    ("first", "words", "clsact"),
    [
        pytest.param(first, words, clsact, marks=[pytest.mark.nightly] * (clsact == (first == "link")))
        for first, words in (("link", "a live switch"), ("filter", "live process {pid}"))
        for clsact in (False, True)
    ],
)
def test_a_device_that_a_live_switch_has_is_refused(
    machine: LabMachine, ports: list[str], first: str, words: str, clsact: bool
) -> None:
    child, _ = running(machine, first, ports)
    with pytest.raises(LocalError, match=words.format(pid=child.pid)):
        KernelPlane(ports, table(), clsact=clsact)
    assert crosses(PATIENCE_S)


@pytest.mark.parametrize("clsact", [False, True], ids=["link", "filter"])
def test_somebody_elses_program_on_the_same_hook_stays(ports: list[str], clsact: bool) -> None:
    passing = Assembler()
    passing.leave(-1)
    theirs = load_program(passing.assemble(), "theirs", b"Apache-2.0")
    ifindex = socket.if_nametoindex(ports[0])
    with IPRoute() as ask:
        ask.tc("add", "clsact", ifindex)
        place = {"parent": 0xFFFFFFF2, "fd": theirs, "name": "theirs", "direct_action": True}
        ask.tc("add-filter", "bpf", ifindex, **place)
    link = create_link(theirs, ifindex, TCX_INGRESS)
    plane = KernelPlane(ports, table(), clsact=clsact)
    assert crosses(PATIENCE_S)
    plane.close()
    assert filters(ports[0]) == ["theirs"]
    assert len(attached(ifindex, TCX_INGRESS)) == 1
    os.close(link)
    os.close(theirs)


CHOOSE = """
import sys
from gdp.errors import LocalError
from gdp.nodes.data_plane import choose_plane
from gdp.switch.table import Table
try:
    chosen = choose_plane(sys.argv[1], ["p0"], Table(), 100)
except LocalError as error:
    sys.exit(str(error))
print(chosen.name, chosen.reason, sep="|")
chosen.plane.close()
"""


@pytest.mark.parametrize("lacks", ["bpf,-sys_admin", "net_admin,-sys_admin"])
def test_without_the_capability_it_says_so_and_takes_the_next_best(
    machine: LabMachine, ports: list[str], lacks: str
) -> None:
    drop = [f"--bounding-set=-{lacks}", f"--inh-caps=-{lacks}"]
    with_less = ["setpriv", *drop, "--", sys.executable, "-c", CHOOSE]
    auto = machine.run(*with_less, "auto")
    assert auto.returncode == 0, auto.stderr
    name, reason = auto.stdout.strip().split("|")
    assert name == "raw"
    assert "EPERM" in reason
    assert "CAP_BPF" in reason
    kernel = machine.run(*with_less, "kernel")
    assert kernel.returncode == 1
    assert "data plane kernel:" in kernel.stderr
    assert "EPERM" in kernel.stderr


def test_where_it_is_allowed_it_is_what_auto_takes(machine: LabMachine, ports: list[str]) -> None:
    assert machine.output(sys.executable, "-c", CHOOSE, "auto") == "kernel|\n"


def test_a_device_that_another_switch_still_holds_is_opened_when_that_lets_go(space: Space) -> None:
    space.veth("one", "two", PORT_MACS[0], PEER_MACS[0])
    former, later = KernelPlane(["one"]), KernelPlane()
    try:
        index = later.add_port("moved", may_be_absent=True)
        for words in (("set", "one", "down"), ("set", "one", "name", "moved"), ("set", "moved", "up")):
            space.ip("link", *words)
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            later.poll(0.1)
        assert not later.ports[index].up
        former.close()
        until(lambda: later.ports[index].up, meanwhile=lambda: later.poll(1.0))
    finally:
        later.close()
