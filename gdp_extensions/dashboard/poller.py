"""Poller of control sockets: one snapshot of each running node a poll, over connections that stay open.

I/O. Sockets are found again every few seconds: those of all nodes on this host that this user may ask, and of the
supervisors of ``fog``. A topology takes longer to make, so one switch of each domain is asked every few seconds.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.errors import GdpError
from gdp.intervals import POLL_S, RETRY_S
from gdp.management.control_client import (
    NodeConnection,
    NodeEndedError,
    NotRunningError,
    control_sockets,
    find_control_socket,
)
from gdp.management.control_socket import CONTROL_SOCKET
from gdp.state.control_protocol import Command, Request
from gdp_extensions.dashboard.core.readings import Fields, Reading, text_of

log = logging.getLogger(__name__)

_TIMEOUT_S: Final = 1.0  # a node that hangs delays one poll
_TOPOLOGY_S: Final = 5.0
_SWITCHES: Final = ("switch", "leaf")


def supervisor_state() -> Path:
    """Return the default folder of the state of ``fog``; it may not exist."""
    stated = os.environ.get("FOG_STATE")
    return Path(stated) if stated else Path.home() / ".local" / "state" / "gdp-fog"


def found_sockets(nodes: Sequence[Path] = (), states: Sequence[Path] = ()) -> list[Path]:
    """Return the control sockets of these nodes and states of ``fog``; if both are empty, all of this host.

    Raises:
        LocalError: a directory belongs to no node.
    """
    if nodes or states:
        return [find_control_socket(each) for each in nodes] + [each / CONTROL_SOCKET for each in states]
    supervisor = supervisor_state() / CONTROL_SOCKET
    return [*control_sockets(), *([supervisor] if supervisor.exists() else [])]


@dataclass(slots=True)
class _Socket:
    path: Path
    connection: NodeConnection | None = None
    fields: Fields = field(default_factory=dict)
    topology: Fields = field(default_factory=dict)
    retry_at_s: float = 0.0

    def close(self) -> None:
        """Close the connection."""
        if self.connection is not None:
            self.connection.close()
            self.connection = None

    def ask(self, command: Command) -> Fields:
        """Return a node's answer; it blocks. Raises ``GdpError``: there is no such node, or it refused."""
        if self.connection is None:
            self.connection = NodeConnection(self.path, _TIMEOUT_S)
        self.connection.send_request(Request(command))
        return self.connection.read_result()


class Poller:
    """Reads the nodes of this host, or the given ones.

    Args:
        nodes: directories of nodes; with ``states`` empty too, all nodes of this host.
        states: folders of the state of ``fog``.

    Raises:
        LocalError: a directory belongs to no node.
    """

    def __init__(self, nodes: Sequence[Path] = (), states: Sequence[Path] = ()) -> None:
        # The socket of a given node stays the same when the node ends and starts again.
        self._fixed = found_sockets(nodes, states) if nodes or states else None
        self._sockets: dict[Path, _Socket] = {}
        self._found_at_s = float("-inf")
        self._topology_at_s = float("-inf")

    async def read_nodes(self) -> list[Reading]:
        """Ask every node at once, and return what came within a second."""
        now_s = time.monotonic()
        if now_s - self._found_at_s >= POLL_S:
            self._found_at_s = now_s
            self._follow(found_sockets() if self._fixed is None else self._fixed)
        due = [each for each in self._sockets.values() if each.retry_at_s <= now_s]
        await asyncio.gather(*(self._read(each) for each in due))
        if now_s - self._topology_at_s >= _TOPOLOGY_S:
            self._topology_at_s = now_s
            await self._read_topologies()
        return [Reading(each.fields, each.topology) for each in self._sockets.values() if each.fields]

    def close(self) -> None:
        """Close all connections."""
        for each in self._sockets.values():
            each.close()

    def _follow(self, paths: Iterable[Path]) -> None:
        wanted = set(paths)
        for path in self._sockets.keys() - wanted:
            self._sockets.pop(path).close()
        for path in wanted - self._sockets.keys():
            self._sockets[path] = _Socket(path)

    async def _read(self, each: _Socket) -> None:
        each.fields = await self._answer(each, Command.SNAPSHOT)

    async def _answer(self, each: _Socket, command: Command) -> Fields:
        try:
            return await asyncio.to_thread(each.ask, command)
        except (NotRunningError, NodeEndedError) as error:  # it may start again at any time
            log.info("node gone path=%s reason=%s", each.path, error)
        except GdpError as error:
            log.info("node not read path=%s reason=%s", each.path, error)
            each.retry_at_s = time.monotonic() + RETRY_S
        each.close()
        return {}

    async def _read_topologies(self) -> None:
        chosen: dict[str, _Socket] = {}
        for each in self._sockets.values():
            each.topology = {}
            if text_of(each.fields, "role") in _SWITCHES:
                chosen.setdefault(text_of(each.fields, "domain"), each)
        for each in chosen.values():
            each.topology = await self._answer(each, Command.TOPOLOGY)
