"""Wait until descriptors are readable."""

from __future__ import annotations

import os
import socket

from gdp.ports.readiness import readable


def test_what_holds_bytes_or_has_ended_is_readable_and_nothing_else() -> None:
    ours, theirs = socket.socketpair()
    ended, other = os.pipe()
    silent, held = os.pipe()
    os.close(other)
    with ours, theirs:
        theirs.send(b"x")
        files: list[socket.socket | int] = [ours, theirs, ended, silent]
        assert readable(files, 0) == [ours, ended]
        assert readable([ours, theirs]) == [ours]
    for each in (ended, silent, held):
        os.close(each)
