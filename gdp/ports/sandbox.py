"""Sandbox: the rights that a node drops after its sockets and programs are open.

I/O. The order is: ``no_new_privs``, Landlock, the bounding set, capabilities, seccomp. A step that this kernel or this
user's rights do not allow is left out; ``Rights`` is what the kernel reports afterwards. Capabilities and Landlock
belong to a thread, so a node calls this before it starts its threads.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.ports.confine import landlock, seccomp
from gdp.ports.confine.capabilities import Capability, drop_bounding, keep_only
from gdp.ports.confine.system import prctl

log = logging.getLogger(__name__)

_NO_NEW_PRIVS: Final = 38  # PR_SET_NO_NEW_PRIVS
_STATUS: Final = Path("/proc/thread-self/status")
_TASKS: Final = Path("/proc/self/task")


@dataclass(frozen=True, slots=True, kw_only=True)
class Needs:
    """Rights that a process continues to need.

    Args:
        capabilities: capabilities that it keeps, as far as it has them.
        writes: files and folders that it changes.
        reads: files and folders that it reads in addition; None: any.
        tcp_ports: TCP ports on which it listens, and it opens no TCP connection; None: any.
        starts_programs: whether it starts programs; they get no capability.
        spared_calls: system calls of ``seccomp.denied`` that it makes.
        uses_open_programs: as of ``seccomp.refuse``.
        only_reads: it makes no system call but those of ``seccomp.allowed``.
    """

    capabilities: frozenset[Capability] = frozenset()
    writes: tuple[Path, ...] = ()
    reads: tuple[Path, ...] | None = None
    tcp_ports: tuple[int, ...] | None = None
    starts_programs: bool = False
    spared_calls: frozenset[str] = frozenset()
    uses_open_programs: bool = False
    only_reads: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Rights:
    """Rights that this thread still has, as the kernel reports them.

    Args:
        capabilities: in effect; lower case without ``CAP_``, or a number if it has no name here.
        bounding: number of capabilities that a root program started from here could get.
        landlock: the version in use; 0: none.
        threads: number of threads of this process; if more than one, the others keep capabilities and files.
    """

    capabilities: tuple[str, ...]
    bounding: int
    no_new_privs: bool
    landlock: int
    seccomp: bool
    threads: int

    def to_text(self) -> str:
        """Return one line for a log."""
        return (
            f"capabilities={','.join(self.capabilities) or 'none'} bounding={self.bounding}"
            f" no_new_privs={self.no_new_privs} landlock={self.landlock or 'none'} seccomp={self.seccomp}"
            f" threads={self.threads}"
        )


def confine(needs: Needs) -> Rights:
    """Drop the rights that a process does not need, irreversibly; return the remaining ones."""
    version = 0
    try:
        prctl(_NO_NEW_PRIVS, 1)
        version = landlock.restrict(needs.writes, needs.reads, needs.tcp_ports, may_execute=needs.starts_programs)
    except OSError as error:
        log.warning("rights kept reason=%s landlock=%d", error.strerror, version)
    try:
        drop_bounding()
    except OSError as error:
        log.debug("bounding set kept reason=%s", error.strerror)
    try:
        keep_only(needs.capabilities)
    except OSError as error:
        log.warning("capabilities kept reason=%s", error.strerror)
    try:
        if needs.only_reads:
            seccomp.allow_only_reading()
        else:
            seccomp.refuse(needs.spared_calls, uses_open_programs=needs.uses_open_programs)
    except OSError as error:
        log.warning("system calls kept reason=%s", error.strerror)
    return _rights(version)


def _rights(version: int) -> Rights:
    lines = (line.partition(":") for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines())
    status = {key: value.strip() for key, _, value in lines}
    return Rights(
        capabilities=tuple(_names(int(status.get("CapEff", "0"), 16))),
        bounding=int(status.get("CapBnd", "0"), 16).bit_count(),
        no_new_privs=status.get("NoNewPrivs") == "1",
        landlock=version,
        seccomp=status.get("Seccomp") == "2",
        threads=sum(1 for _ in _TASKS.iterdir()),
    )


def _names(mask: int) -> Collection[str]:
    known = {each.value: each.name.lower() for each in Capability}
    return [known.get(number, str(number)) for number in range(mask.bit_length()) if mask >> number & 1]
