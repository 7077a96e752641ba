"""Discovery of the remote servers of one imported service or action.

I/O: the overlay is asked who is there, the local endpoint what it knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

from gdp.errors import GdpError, LocalError
from gdp.names import Name
from gdp.service.dispatch import Dispatch
from gdp.service.keeper import Keeper
from proxy.bridge.far_server import FarServer
from proxy.bridge.goals import Goals
from proxy.bridge.parts import Parts
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Wish
from proxy.exchange import Exchange
from proxy.faults import Fault

__all__ = ["Response", "ServerCalls", "ServerDiscovery"]

_SERVER_GONE: Final = "the far server is gone"

Response: TypeAlias = "tuple[Name, bytes]"  # who sent it, and its body as the local endpoint has it
ServerCalls: TypeAlias = "Dispatch[Response] | Keeper[Response]"


class ServerDiscovery:
    """The remote servers that can be heard, each as this machine understands it.

    Args:
        service: name of the service.
        calls: of each part; they learn which servers there are.
        goals: of an action.
        opened: called with the service as this machine knows it, when the first server is understood.
        closed: called with the reason when the last server is gone.

    Attributes:
        servers: by name.
    """

    def __init__(
        self,
        *,
        site: Site,
        seat: Seat,
        wish: Wish,
        service: Name,
        parts: Parts,
        calls: Sequence[ServerCalls],
        goals: Goals | None,
        opened: Callable[[Exchange], None],
        closed: Callable[[str], None],
    ) -> None:
        self._site = site
        self._endpoint = seat.endpoint
        self._wish = wish
        self._service = service
        self._parts = parts
        self._calls = calls
        self._goals = goals
        self._opened = opened
        self._closed = closed
        self.servers: dict[Name, FarServer] = {}
        self._is_open = False

    def update(self, now_s: float) -> None:
        """Compare the servers with those that are heard now, and report each change to the calls."""
        member = self._site.member
        # Where nobody keeps up, to wait for who may do so again is better than to give up.
        peers = set(member.peers(self._service) or member.heard(self._service))
        feeds = member.feeds_of(self._service) if peers else []
        heard = {feed.publisher: feed for feed in feeds if feed.publisher in peers}
        for name, server in list(self.servers.items()):
            feed = heard.get(name)
            if feed is not None and (feed.incarnation, feed.description) == (server.incarnation, server.description):
                continue
            same = server.said_anew(feed.description) if feed and feed.incarnation == server.incarnation else None
            if same is not None:
                self.servers[name] = same
                self._announce(name, same, now_s)
            else:
                self._remove(name, now_s)
        for name, feed in heard.items():
            if name not in self.servers:
                self._add(name, feed.incarnation, feed.description, now_s)
        if not self.servers and self._is_open:
            self._is_open = False
            self._closed(_SERVER_GONE)

    def find(self, name: Name, now_s: float) -> FarServer | None:
        """Return a server that may have come just now, or None."""
        if name not in self.servers:
            self.update(now_s)
        return self.servers.get(name)

    def _remove(self, name: Name, now_s: float) -> None:
        del self.servers[name]
        if self._goals is not None:
            self._goals.gone(name)
        for dispatch in self._calls:
            dispatch.gone(name, now_s, _SERVER_GONE)

    def _add(self, name: Name, incarnation: int, description: bytes, now_s: float) -> None:
        """Prepare for a server's responses; one that cannot be understood is reported."""
        rule = self._wish.rule
        try:
            server = FarServer.learn(incarnation, description, self._parts, self._endpoint, rule.encoding)
            if server.exchange is not None and server.exchange.is_ordered != rule.is_ordered:
                side = "the far side's" if rule.is_ordered else "this side's"
                raise LocalError(f"'state: ordered' is missing in {side} rule")
            if not self._is_open and server.ours is not None:
                self._opened(server.ours)
                self._is_open = True
        except GdpError as error:
            self._site.faults.tell(self._wish.local, Fault.OTHER_TYPE, str(error))
            self.servers[name] = FarServer(incarnation, description)
            return
        self.servers[name] = server
        self._announce(name, server, now_s)

    def _announce(self, name: Name, server: FarServer, now_s: float) -> None:
        for dispatch in self._calls:
            dispatch.came(name, now_s)
            if server.is_leaving:
                dispatch.leaves(name)
