"""Attachment of the kernel program to a device: a TCX link on Linux 6.6 and later, else a filter of a clsact qdisc.

I/O. Each device has one attachment and one live switch; a second one is refused, attached by link or by filter.
Programs of other owners at the same hook stay there.
Source: Linux, include/uapi/linux/bpf.h (``BPF_TCX_INGRESS``); tc-bpf(8).

A TCX link is a descriptor: it ends with its process, however that ends. A filter outlives its process, so its name
carries the process that it belongs to. The next run on that device removes the filter of a dead process. Until then the
program forwards nothing, because its lease is not renewed (see ``program.py``).
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from gdp.errors import LocalError
from gdp.ports.kernel.loaded_program import PROGRAM
from gdp.ports.kernel.syscall import TCX_INGRESS, BpfError, attached, create_link, name_of
from gdp.ports.netlink import CLSACT_EGRESS, CLSACT_INGRESS, NetlinkSocket

if TYPE_CHECKING:
    from pyroute2 import IPRoute

_LOOPBACK: Final = 1  # the index of lo in every namespace
_NAME: Final = re.compile(rf"{PROGRAM}:(?P<pid>\d+):(?P<started>\d+)", re.ASCII)
_START_TIME: Final = 19  # field 22 of proc_pid_stat(5), counted after the command


def has_links() -> bool:
    """Return whether this kernel has TCX links. Raises ``BpfError``: the process may not query the kernel."""
    try:
        attached(_LOOPBACK, TCX_INGRESS)
    except BpfError as error:
        if error.number == errno.EINVAL:
            return False
        raise
    return True


class Attachment(Protocol):
    """A program at the ingress of one device."""

    def close(self) -> None:
        """Detach the program; the device may be gone."""


class LinkAttachment:
    """A TCX link.

    Raises:
        BpfError: the kernel refuses it.
        LocalError: a live switch uses the device.
    """

    def __init__(self, program: int, ifindex: int, ask: NetlinkSocket) -> None:
        _refuse_second(ask, ifindex)
        self._link = create_link(program, ifindex, TCX_INGRESS)

    def close(self) -> None:
        """Close the link, which detaches the program."""
        os.close(self._link)


@dataclass(frozen=True, slots=True)
class _Filter:
    handle: int
    priority: int
    protocol: int
    name: str


class FilterAttachment:
    """A bpf filter of a clsact qdisc.

    Raises:
        LocalError: the kernel refuses it, or a live switch uses the device.
    """

    def __init__(self, program: int, ifindex: int, ask_briefly: NetlinkSocket) -> None:
        _refuse_second(ask_briefly, ifindex)
        self._ifindex = ifindex
        self._ask_briefly = ask_briefly
        self._name = f"{PROGRAM}:{os.getpid()}:{_started(os.getpid())}"
        with _asking(ifindex) as ask:
            had_qdisc = any(qdisc.get_attr("TCA_KIND") == "clsact" for qdisc in ask.get_qdiscs(index=ifindex))
            if had_qdisc:
                removed = self._remove_dead(ask)
                self._made_qdisc = removed and self._is_bare(ask)
            else:
                ask.tc("add", "clsact", ifindex)
                self._made_qdisc = True
            place = {"parent": CLSACT_INGRESS, "fd": program, "name": self._name, "direct_action": True}
            ask.tc("add-filter", "bpf", ifindex, **place)

    def close(self) -> None:
        """Remove our filter, and the qdisc if we made it; the device may be gone."""
        try:
            with _asking(self._ifindex) as ask:
                for each in _filters(ask, self._ifindex, CLSACT_INGRESS):
                    if each.name == self._name:
                        _remove(ask, self._ifindex, each)
                if self._made_qdisc and self._is_bare(ask):
                    ask.tc("del", "clsact", self._ifindex)
        except LocalError:
            if self._ask_briefly.link(self._ifindex):
                raise
            # the device is gone with all its filters

    def _remove_dead(self, ask: IPRoute) -> bool:
        """Remove the filters that dead runs left; return whether there were any."""
        removed = False
        for each in _filters(ask, self._ifindex, CLSACT_INGRESS):
            if _NAME.fullmatch(each.name):  # filters of live processes were refused before
                _remove(ask, self._ifindex, each)
                removed = True
        return removed

    def _is_bare(self, ask: IPRoute) -> bool:
        """Return whether the qdisc has no filter in either direction."""
        return not any(_filters(ask, self._ifindex, parent) for parent in (CLSACT_INGRESS, CLSACT_EGRESS))


def _refuse_second(ask: NetlinkSocket, ifindex: int) -> None:
    """Refuse a second switch on one device: each would receive half of the control frames and forward by those.

    A link exists only while its process holds it, so its program belongs to a live process. Opening the programs of
    other owners takes CAP_SYS_ADMIN, which forwarding does not need. Without it, a second switch on a link stays
    undetected.

    Raises:
        LocalError: a live switch uses the device.
    """
    for name in ask.filters(ifindex, CLSACT_INGRESS):
        of_ours = _NAME.fullmatch(name)
        if of_ours and _started(int(of_ours["pid"])) == of_ours["started"]:
            raise LocalError(f"device {ifindex} already serves the live process {of_ours['pid']}")
    if PROGRAM in _linked(ifindex):
        raise LocalError(f"device {ifindex} already serves a live switch")


def _linked(ifindex: int) -> list[str | None]:
    """Return the names of the programs at the hook of links, as far as this process may read them."""
    try:
        return [name_of(program) for program in attached(ifindex, TCX_INGRESS)]
    except BpfError as error:
        if error.number in (errno.EINVAL, errno.EPERM):  # no links before Linux 6.6; no right to open the program
            return []
        raise


def _started(pid: int) -> str:
    """Return when a process began, in ticks since boot; empty if it does not exist."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return text.rpartition(")")[2].split()[_START_TIME]


@contextlib.contextmanager
def _asking(ifindex: int) -> Iterator[IPRoute]:
    from pyroute2 import IPRoute  # a large import, needed for this alone
    from pyroute2.netlink.exceptions import NetlinkError

    try:
        with IPRoute() as ask:
            yield ask
    except (NetlinkError, OSError) as error:
        raise LocalError(f"traffic control of device {ifindex}: {error}") from error


def _filters(ask: IPRoute, ifindex: int, parent: int) -> list[_Filter]:
    found: list[_Filter] = []
    for each in ask.get_filters(index=ifindex, parent=parent):
        if each["handle"]:  # the head of a chain has no handle
            name = each.get_nested("TCA_OPTIONS", "TCA_BPF_NAME") if each.get_attr("TCA_KIND") == "bpf" else None
            found.append(_Filter(each["handle"], each["info"] >> 16, socket.ntohs(each["info"] & 0xFFFF), name or ""))
    return found


def _remove(ask: IPRoute, ifindex: int, which: _Filter) -> None:
    place = {"parent": CLSACT_INGRESS, "handle": which.handle, "prio": which.priority, "protocol": which.protocol}
    ask.tc("del-filter", "bpf", ifindex, **place)
