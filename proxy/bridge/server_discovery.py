"""Discovery of the remote servers of one imported service or action.

I/O: it queries the overlay for the servers, and the local endpoint for known types.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

from gdp.errors import GdpError, LocalError
from gdp.names import Name
from gdp.service.dispatch import Dispatch
from gdp.service.sequencer import Sequencer
from proxy.bridge.core.decoder import differences_of
from proxy.bridge.core.goals import Goals
from proxy.bridge.core.remote_server import RemoteServer
from proxy.bridge.faults import Fault
from proxy.bridge.service_flow import ServiceFlow
from proxy.wire.service import Exchange

SERVER_GONE: Final = "the far server is gone"

Response: TypeAlias = "tuple[Name, bytes]"  # the sender, and its body in the local endpoint's wire form
ServerCalls: TypeAlias = "Dispatch[Response] | Sequencer[Response]"


class ServerDiscovery:
    """Reachable remote servers, each as this machine decodes it.

    Args:
        calls: of each part; they get every change of the servers.
        opened: called with this machine's description of the service, when the first server has a valid description.
        closed: called with the reason when the last server is gone.

    Attributes:
        servers: by name.
    """

    def __init__(
        self,
        flow: ServiceFlow,
        calls: Sequence[ServerCalls],
        goals: Goals | None,
        *,
        opened: Callable[[Exchange], None],
        closed: Callable[[str], None],
    ) -> None:
        self._flow = flow
        self._calls = calls
        self._goals = goals
        self._opened = opened
        self._closed = closed
        self.servers: dict[Name, RemoteServer] = {}
        self._is_open = False

    def update(self, now_s: float) -> None:
        """Compare the servers with those that are reachable now, and report each change to the calls."""
        member = self._flow.context.member
        # If no server keeps up, waiting for one that may recover is better than giving up.
        peers = set(member.services.peers(self._flow.name) or member.services.connected_peers(self._flow.name))
        writer_proxies = member.subscriptions.writer_proxies_of(self._flow.name) if peers else []
        heard = {
            writer_proxy.publisher: writer_proxy for writer_proxy in writer_proxies if writer_proxy.publisher in peers
        }
        for name, writer_proxy in heard.items():  # first, so that calls of a server that goes now find them
            if name not in self.servers:
                self._add(name, now_s, writer_proxy.incarnation, writer_proxy.description)
        for name, server in list(self.servers.items()):
            if name not in heard:
                self._remove(name, now_s)
                continue
            incarnation, description = heard[name].incarnation, heard[name].description
            if (incarnation, description) == (server.incarnation, server.description):
                continue
            same = server.described_again(description) if incarnation == server.incarnation else None
            if same is not None:
                self.servers[name] = same
                self._announce(name, same, now_s)
            else:
                self._remove(name, now_s)
                self._add(name, now_s, incarnation, description)
        if not self.servers and self._is_open:
            self._is_open = False
            self._closed(SERVER_GONE)

    def find(self, name: Name, now_s: float) -> RemoteServer | None:
        """Return a server, including one that joined just now, or None."""
        if name not in self.servers:
            self.update(now_s)
        return self.servers.get(name)

    def _remove(self, name: Name, now_s: float) -> None:
        del self.servers[name]
        if self._goals is not None:
            self._goals.remove_server(name)
        for dispatch in self._calls:
            dispatch.replica_lost(name, now_s, SERVER_GONE)

    def _add(self, name: Name, now_s: float, incarnation: int, description: bytes) -> None:
        """Add a server, unless it is quarantined."""
        self._flow.context.contain(
            self._flow.flow_spec.local, name, now_s, self._prepare, name, incarnation, description
        )
        if (server := self.servers.get(name)) is not None and server.exchange is not None:
            self._announce(name, server, now_s)

    def _prepare(self, name: Name, incarnation: int, description: bytes) -> None:
        """Prepare the decoders of a server's responses; an invalid description is reported."""
        rule = self._flow.flow_spec.rule
        self.servers[name] = RemoteServer(incarnation=incarnation, description=description)
        try:
            server = RemoteServer.set_description(
                incarnation, description, self._flow.parts, self._flow.dispatcher.endpoint, rule
            )
            if server.exchange is not None and server.exchange.is_ordered != rule.is_ordered:
                side = "the far side's" if rule.is_ordered else "this side's"
                raise LocalError(f"'state: ordered' is missing in {side} rule")
            if not self._is_open and server.ours is not None:
                self._opened(server.ours)
                self._is_open = True
        except GdpError as error:
            self._flow.report(Fault.OTHER_TYPE, str(error))
            return
        self.servers[name] = server
        if differences := differences_of((*server.answers, *server.news)):
            self._flow.report(Fault.OTHER_TYPE, differences)

    def _announce(self, name: Name, server: RemoteServer, now_s: float) -> None:
        for dispatch in self._calls:
            dispatch.replica_joined(name, now_s)
            if server.is_leaving:
                dispatch.replica_leaving(name)
