"""Texts of refused netlink requests; the other end of a socket pair plays the kernel."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator

import pytest

from gdp.errors import LocalError
from gdp.ports import netlink
from gdp.ports.netlink import CLSACT_EGRESS, LinkAttribute, NetlinkSocket

ERROR, DONE, NEW_LINK = 2, 3, 16
QUEUE = LinkAttribute.QDISC


def message(kind: int, sequence: int, body: bytes) -> bytes:
    return struct.pack("=IHHII", 16 + len(body), kind, 0, sequence, 0) + body


def refusal(kind: int, sequence: int, number: int) -> bytes:
    return message(kind, sequence, struct.pack("=i", -number))


def device(sequence: int, queue: bytes) -> bytes:
    return message(NEW_LINK, sequence, bytes(16) + struct.pack("=HH", 4 + len(queue), QUEUE) + queue)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    monkeypatch.setattr(netlink, "_open", lambda _: ours)
    monkeypatch.setattr(netlink, "_FOREVER_S", 0.01)
    with ours, theirs:
        yield theirs


def test_no_such_device_has_no_attributes(kernel: socket.socket) -> None:
    kernel.send(refusal(ERROR, 1, errno.ENODEV))
    assert NetlinkSocket().link(7) == {}


@pytest.mark.parametrize("number", [errno.EPERM, errno.ENOBUFS, errno.EBUSY])
def test_a_refusal_does_not_read_as_nothing_there(kernel: socket.socket, number: int) -> None:
    asking = NetlinkSocket()
    kernel.send(refusal(ERROR, 1, number))
    with pytest.raises(LocalError):
        asking.link(7)
    kernel.send(refusal(ERROR, 2, number))
    with pytest.raises(LocalError):
        asking.filters(7, CLSACT_EGRESS)
    kernel.send(refusal(DONE, 3, number))
    with pytest.raises(LocalError):
        asking.queues()


def test_a_late_answer_is_not_taken_for_the_next_ones(kernel: socket.socket) -> None:
    asking = NetlinkSocket()
    with pytest.raises(LocalError, match="timed out"):
        asking.link(7)
    kernel.send(device(1, b"late"))
    with pytest.raises(LocalError, match="timed out"):
        asking.link(7)
    kernel.send(device(2, b"late"))
    kernel.send(device(3, b"later"))
    asking._has_leftovers = False  # as if they came during the request
    assert asking.link(7) == {QUEUE: b"later"}


def test_without_a_descriptor_there_is_a_local_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*_: object) -> socket.socket:
        raise OSError(errno.EMFILE, "too many")

    monkeypatch.setattr(socket, "socket", none_left)
    with pytest.raises(LocalError, match="too many"):
        NetlinkSocket()
