"""Owner's end of a keeper: starts the process, reads its reports, and ends it.

I/O. The process is started before the owner confines itself. Afterwards the owner may neither start programs nor send
signals, so it ends the keeper by closing the socket pair.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import STOP_S

log = logging.getLogger(__name__)

_MODULE: Final = "gdp.ports.tunnel.keeper"
_ROOT: Final = Path(__file__).resolve().parents[3]
_START_S: Final = 20.0


@dataclass(frozen=True, slots=True)
class Report:
    """Report of a keeper.

    Args:
        event: ``ready``, ``failed``, ``died``, ``restarted`` or ``warning``; ``lost`` is the end of the keeper itself.
        backend: of ``ready``.
        text: why the device is not the kernel's (``ready``), or what happened.
        is_same: of ``restarted``: the device is still the same, so its addresses and routes stayed.
    """

    event: str
    backend: str = ""
    text: str = ""
    is_same: bool = True


class KeeperProcess:
    """A keeper of one device.

    Args:
        ifname: name of the device.
        alias: of all devices of this switch.
        backend: ``auto``, ``kernel`` or ``wireguard-go``.
        uplink: device that outer packets leave by; empty: routing decides.

    Raises:
        LocalError: the device cannot be made; the text says why and what to do.
    """

    def __init__(self, ifname: str, alias: str, backend: str, uplink: str = "") -> None:
        self._socket, theirs = socket.socketpair()
        self._buffer = b""
        self._is_lost = False
        self._waiting: list[Report] = []
        words = [ifname, alias, backend, str(os.getpid()), *([uplink] if uplink else [])]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _MODULE, *words],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                cwd=_ROOT,  # Python imports from the working directory, which others may be able to write to
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))},
                start_new_session=True,  # Ctrl-C in a terminal goes to the owner only, which ends the keeper in order
            )
        self._socket.settimeout(_START_S)
        first = Report("lost")
        with contextlib.suppress(TimeoutError):
            reports: list[Report] = []
            while not reports:
                reports = self._received()
            first, *self._waiting = reports
        self._socket.setblocking(False)
        if first.event != "ready":
            self.close()
            raise LocalError(first.text or f"tunnel {ifname}: the process that keeps the device did not start")
        self.ready = first

    def fileno(self) -> int:
        """Return the descriptor that is readable when there are reports."""
        return self._socket.fileno()

    @property
    def is_lost(self) -> bool:
        """Return whether the keeper ended; the device does not work then."""
        return self._is_lost

    def reports(self) -> list[Report]:
        """Return the reports since the last call, without waiting."""
        waiting, self._waiting = self._waiting, []
        try:
            return waiting if self._is_lost else waiting + self._received()
        except BlockingIOError:
            return waiting

    def close(self) -> None:
        """End the keeper, and return when the device is gone."""
        self._socket.close()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            log.error("the keeper of a tunnel device does not end pid=%d", self._process.pid)

    def _received(self) -> list[Report]:
        try:
            data = self._socket.recv(1 << 16)
        except ConnectionResetError:
            data = b""
        if not data:
            self._is_lost = True
            self._process.poll()
            return [Report("lost")]
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return [_report(json.loads(line)) for line in lines]


def _report(fields: dict[str, object]) -> Report:
    return Report(
        str(fields["event"]),
        str(fields.get("backend", "")),
        str(fields.get("text", fields.get("reason", ""))),
        bool(fields.get("is_same", True)),
    )
