"""Watch over the tunnels of the switch on this host: to which peers a tunnel over UDP is up.

I/O; a thread asks the switch's control socket, because a busy switch answers late.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path

from gdp.errors import GdpError
from gdp.intervals import ANSWER_S, TICK_S
from gdp.management.control_client import ask_node
from gdp.state.control_protocol import Command


class SwitchWatch:
    """The watch; it begins with ``start``, after the confinement of rights, which applies to threads started later.

    Args:
        path: the switch's control socket.

    Attributes:
        up: names of the peers, in hex, to which a tunnel is up; empty without a running switch.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="switch-watch", daemon=True)
        self.up: frozenset[str] = frozenset()

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def close(self) -> None:
        """Ask no more."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(TICK_S):
            try:
                self.up = peers_up(ask_node(self._path, Command.STATUS, ANSWER_S).result)
            except GdpError:  # no switch runs: there is no tunnel either
                self.up = frozenset()


def peers_up(status: Mapping[str, object]) -> frozenset[str]:
    """Return the peers, in hex, to which a tunnel is up by a switch's status."""
    links = status.get("links")
    rows = links if isinstance(links, list) else []
    return frozenset(str(row.get("peer")) for row in rows if isinstance(row, dict) and row.get("up") is True)
