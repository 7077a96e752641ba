"""Socket buffers of another process, and what a refusal says."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
from collections.abc import Iterator

import pytest

from gdp.errors import LocalError
from gdp.ports.tunnel import socket_buffers
from gdp.ports.tunnel.socket_buffers import SocketBuffers


@pytest.fixture
def own_process() -> Iterator[SocketBuffers]:
    """This process, with a UDP socket."""
    pidfd = os.pidfd_open(os.getpid())
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM):
            yield SocketBuffers(os.getpid(), pidfd)
    finally:
        os.close(pidfd)


def test_a_refusal_is_reported_once(own_process: SocketBuffers, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: int) -> int:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(socket_buffers, "call", refuse)
    with pytest.raises(LocalError, match=r"loses packets under load.*not permitted"):
        own_process.enlarge()
    own_process.enlarge()


def test_a_socket_that_was_closed_meanwhile_is_skipped(
    own_process: SocketBuffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(*_: int) -> int:
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr(socket_buffers, "call", closed)
    own_process.enlarge()


def test_a_process_that_ended_has_no_sockets() -> None:
    with subprocess.Popen(["/bin/true"]) as process:
        pidfd = os.pidfd_open(process.pid)
    try:
        SocketBuffers(process.pid, pidfd).enlarge()
    finally:
        os.close(pidfd)
