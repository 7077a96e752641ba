"""Where the program is attached: a TCX link on Linux 6.6 and later, else a filter of a clsact qdisc.

Place: I/O; one attachment a device. Whoever else stands at the same hook stays there.
Source: Linux, include/uapi/linux/bpf.h (``BPF_TCX_INGRESS``); tc-bpf(8).

A TCX link is a descriptor: it ends with its process, whatever ends that. A filter does not, so it carries the process
it belongs to in its name, and the next run on that device takes a dead one's away; until then the program itself
forwards nothing, since nobody renews its lease (see ``program.py``).
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
from gdp.ports.kernel.loaded import PROGRAM
from gdp.ports.kernel.netlink import link
from gdp.ports.kernel.syscall import BpfError, attached, create_link

if TYPE_CHECKING:
    from pyroute2 import IPRoute

__all__ = ["Attachment", "FilterAttachment", "LinkAttachment", "has_links"]

_TCX_INGRESS: Final = 46
_LOOPBACK: Final = 1  # the index of lo in every namespace
_INGRESS, _EGRESS = 0xFFFFFFF2, 0xFFFFFFF3  # TC_H_MAKE(TC_H_CLSACT, TC_H_MIN_INGRESS or TC_H_MIN_EGRESS)
_NAME: Final = re.compile(rf"{PROGRAM}:(?P<pid>\d+):(?P<started>\d+)", re.ASCII)
_START_TIME: Final = 19  # field 22 of proc_pid_stat(5), counted from behind the command


def has_links() -> bool:
    """Whether this kernel has TCX links.

    Raises:
        BpfError: not allowed to ask.
    """
    try:
        attached(_LOOPBACK, _TCX_INGRESS)
    except BpfError as error:
        if error.number == errno.EINVAL:
            return False
        raise
    return True


class Attachment(Protocol):
    """A program at the ingress of one device."""

    def close(self) -> None:
        """Take it away; the device may be gone."""


class LinkAttachment:
    """A TCX link.

    Raises:
        BpfError: refused.
    """

    def __init__(self, program: int, ifindex: int) -> None:
        self._link = create_link(program, ifindex, _TCX_INGRESS)

    def close(self) -> None:
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
        LocalError: refused, or a live process of ours has the device.
    """

    def __init__(self, program: int, ifindex: int) -> None:
        self._ifindex = ifindex
        self._name = f"{PROGRAM}:{os.getpid()}:{_started(os.getpid())}"
        with _asking(ifindex) as ask:
            had_qdisc = any(qdisc.get_attr("TCA_KIND") == "clsact" for qdisc in ask.get_qdiscs(index=ifindex))
            if had_qdisc:
                removed = self._remove_dead(ask)
                self._made_qdisc = removed and self._is_bare(ask)
            else:
                ask.tc("add", "clsact", ifindex)
                self._made_qdisc = True
            place = {"parent": _INGRESS, "fd": program, "name": self._name, "direct_action": True}
            ask.tc("add-filter", "bpf", ifindex, **place)

    def close(self) -> None:
        try:
            with _asking(self._ifindex) as ask:
                for each in _filters(ask, self._ifindex, _INGRESS):
                    if each.name == self._name:
                        _remove(ask, self._ifindex, each)
                if self._made_qdisc and self._is_bare(ask):
                    ask.tc("del", "clsact", self._ifindex)
        except LocalError:
            if link(self._ifindex):
                raise
            # the device is gone, and all that stood there with it

    def _remove_dead(self, ask: IPRoute) -> bool:
        """Take away what dead runs left; return whether there was any."""
        removed = False
        for each in _filters(ask, self._ifindex, _INGRESS):
            name = _NAME.fullmatch(each.name)
            if name is None:
                continue
            if _started(int(name["pid"])) == name["started"]:
                raise LocalError(f"device {self._ifindex} already serves the live process {name['pid']}")
            _remove(ask, self._ifindex, each)
            removed = True
        return removed

    def _is_bare(self, ask: IPRoute) -> bool:
        """Whether no filter stands at the qdisc, either way."""
        return not any(_filters(ask, self._ifindex, parent) for parent in (_INGRESS, _EGRESS))


def _started(pid: int) -> str:
    """Return when a process began, in ticks since boot; empty when it is not there."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return text.rpartition(")")[2].split()[_START_TIME]


@contextlib.contextmanager
def _asking(ifindex: int) -> Iterator[IPRoute]:
    from pyroute2 import IPRoute  # large, and needed for this alone
    from pyroute2.netlink.exceptions import NetlinkError

    with IPRoute() as ask:
        try:
            yield ask
        except NetlinkError as error:
            raise LocalError(f"traffic control of device {ifindex}: {error}") from error


def _filters(ask: IPRoute, ifindex: int, parent: int) -> list[_Filter]:
    found: list[_Filter] = []
    for each in ask.get_filters(index=ifindex, parent=parent):
        if each["handle"]:  # a chain's head has none
            name = each.get_nested("TCA_OPTIONS", "TCA_BPF_NAME") if each.get_attr("TCA_KIND") == "bpf" else None
            found.append(_Filter(each["handle"], each["info"] >> 16, socket.ntohs(each["info"] & 0xFFFF), name or ""))
    return found


def _remove(ask: IPRoute, ifindex: int, which: _Filter) -> None:
    place = {"parent": _INGRESS, "handle": which.handle, "prio": which.priority, "protocol": which.protocol}
    ask.tc("del-filter", "bpf", ifindex, **place)
