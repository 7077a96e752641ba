"""ROS processes of this host: their ROS domain, their DDS transports, and their network namespace.

I/O; it reads ``/proc`` (proc(5)). Processes of other users are left out where they may not be read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gdp.diagnosis.facts import RosProcess

_LIBRARIES: Final = ("librcl.so", "librmw", "libfastrtps", "libfastdds", "libddsc.so")
_COMMAND_CHARS: Final = 60
_FOUND_MAX: Final = 64


def ros_processes(without: frozenset[int] = frozenset(), near: int | None = None) -> tuple[RosProcess, ...]:
    """Return the processes that have loaded a ROS or DDS library.

    Args:
        without: process numbers to leave out: proxies.
        near: the proxy's process, whose network namespace the others are compared with; None: that of this process.
    """
    return tuple(_ros_processes(without | {os.getpid()}, "self" if near is None else str(near)))[:_FOUND_MAX]


def _ros_processes(without: frozenset[int], near: str) -> Iterator[RosProcess]:
    namespace = _namespace(near)
    for folder in sorted(Path("/proc").iterdir()):
        if not folder.name.isdigit() or int(folder.name) in without:
            continue
        try:
            if not any(each in (folder / "maps").read_text() for each in _LIBRARIES):
                continue
            words = (folder / "cmdline").read_bytes().split(b"\0")
            given = dict(each.partition(b"=")[::2] for each in (folder / "environ").read_bytes().split(b"\0"))
        except OSError:
            continue  # it ended, or belongs to another user
        domain = given.get(b"ROS_DOMAIN_ID", b"").decode(errors="replace")
        yield RosProcess(
            pid=int(folder.name),
            command=b" ".join(words).decode(errors="replace").strip()[:_COMMAND_CHARS],
            domain=int(domain) if domain.isdigit() else 0,
            transports=given.get(b"FASTDDS_BUILTIN_TRANSPORTS", b"").decode(errors="replace"),
            is_apart=_namespace(folder.name) != namespace,
        )


def _namespace(process: str) -> str:
    try:
        return os.readlink(f"/proc/{process}/ns/net")
    except OSError:
        return ""
