"""Services of a participant: who serves or calls a name, and messages to one of them alone.

Sans-I/O. A server's responses to one client, and a client's requests to one server, use unicast streams.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import suppress

from gdp.client.publications import Publications
from gdp.client.reader_proxies import ReaderProxies
from gdp.client.request_streams import RequestStreams
from gdp.client.subscription import Subscriptions
from gdp.client.writer_proxy import WriterProxyState
from gdp.errors import LocalError
from gdp.intervals import NEIGHBOUR, NEVER_S
from gdp.limits import COST_UNREACHABLE
from gdp.names import Name
from gdp.service.nearest import ServerPath
from gdp.service.replication import Mode, Replication
from gdp.trust.right import Right


class StallClock:
    """Time of a participant's latest event, and since when it has been scheduled without a stall; monotonic seconds.

    Attributes:
        deaf_s: when it last began to use a switch, or had none.
    """

    def __init__(self) -> None:
        self.now_s = self.awake_s = self.deaf_s = 0.0

    def advance(self, now_s: float) -> None:
        """Set the time; after a stall, frames that the peers sent meanwhile are still to be processed.

        A participant that is called so late, although hellos are due, was not scheduled.
        """
        if now_s - self.now_s > 2 * NEIGHBOUR.refresh_s:
            self.awake_s = now_s
        self.now_s = now_s


class ServicePaths:
    """Paths to the servers of one name that is called."""

    def __init__(self, name: Name, publications: Publications, subscriptions: Subscriptions, clock: StallClock) -> None:
        self._name = name
        self._publications = publications
        self._subscriptions = subscriptions
        self._clock = clock

    def path(self, server: Name) -> ServerPath:
        """Return the present state of the path to a server."""
        subscription = self._subscriptions.get(self._name)
        writer_proxy = None if subscription is None else subscription.writer_proxies.get(server)
        publisher = self._publications.get(self._name)
        path = None if publisher is None else publisher.reader_paths.get(server)
        return ServerPath(
            COST_UNREACHABLE if writer_proxy is None else writer_proxy.cost,
            0.0 if path is None else path.trip_s,
            -NEVER_S if path is None else path.heard_s,
            self._clock.deaf_s,
        )


class Services:
    """The names that one participant serves or calls.

    Args:
        request_costs: has the switch state the costs of the paths to the servers of a name.
    """

    def __init__(
        self,
        publications: Publications,
        subscriptions: Subscriptions,
        clock: StallClock,
        request_costs: Callable[[Name], None],
    ) -> None:
        self._request_costs = request_costs
        self._publications = publications
        self._subscriptions = subscriptions
        self._clock = clock

    def respond(self, service: Name, client: Name, message: bytes) -> None:
        """Send a message to one client of a name that is served here.

        Raises:
            LocalError: that client is not connected (any more), or there are too many; or the message is above the
                limits.
        """
        self._send_to(Right.SERVE, service, client, message)

    def send_request(self, service: Name, server: Name, message: bytes, call: Hashable = None) -> None:
        """Send a request to one server of a name that is called here, apart from the stream to all of them.

        Args:
            call: by which ``end_call`` cancels it; None: it does not.

        Raises:
            LocalError: that server is not connected (any more), or there are too many; or the message is above the
                limits.
        """
        if call is None:
            self._send_to(Right.CALL, service, server, message)
        else:
            self._requests_of(service).send_to(call, server, message, self._clock.now_s)

    def send_requests(self, service: Name, message: bytes, call: Hashable) -> None:
        """Send a request to all servers of a name that is called here; the path to the fastest governs.

        Raises:
            LocalError: the message is above the limits.
        """
        self._requests_of(service).send_to_all(call, message, self._clock.now_s)

    def probe(self, service: Name, server: Name) -> None:
        """Have one server of a name that is called here report soon; one that is not connected does not."""
        with suppress(LocalError):
            self._publications.stream_to(service, server, self._clock.now_s).probe()

    def paths_for(self, service: Name, replication: Replication) -> ServicePaths | None:
        """Return the paths to the servers of a name that is called here, whose costs the switch states from now on.

        None: requests do not go to the nearest server.
        """
        if replication.mode is not Mode.NEAREST:
            return None
        self._request_costs(service)
        return ServicePaths(service, self._publications, self._subscriptions, self._clock)

    def end_call(self, service: Name, call: Hashable) -> None:
        """Cancel what has not left of a call's requests, and their repairs; those of a withdrawn name have ended."""
        if (requests := self._publications.requests.get(service)) is not None:
            requests.cancel(call)

    def peers(self, service: Name) -> list[Name]:
        """Return the servers of a name called here, or the clients of one served here, that are connected and keep up.

        A server that falls behind the others, or is silent for ``SERVER.lease_s``, is excluded until it confirms again.
        """
        publisher = self._publications.get(service)
        if publisher is None:
            return []
        connected = self.connected_peers(service)
        return [party for party in connected if publisher.is_followed_by(party, self._clock.now_s, self._clock.awake_s)]

    def connected_peers(self, service: Name) -> list[Name]:
        """Return all connected peers, those that do not keep up included; ``peers`` returns a subset."""
        return self._peers(service, ReaderProxies.is_read_by)

    def silent_peers(self, service: Name) -> list[Name]:
        """Return the peers that have stopped reporting and may return, such as those behind a dead access point."""
        return self._peers(service, ReaderProxies.is_suspended)

    def _peers(self, service: Name, fits: Callable[[ReaderProxies, Name], bool]) -> list[Name]:
        """Return the peers with a live writer proxy whose state as readers of the service's publisher fits."""
        publisher = self._publications.get(service)
        if publisher is None:
            return []
        return [
            writer_proxy.publisher
            for writer_proxy in self._subscriptions.writer_proxies_of(service)
            if writer_proxy.state is WriterProxyState.LIVE and fits(publisher.matched, writer_proxy.publisher)
        ]

    def _requests_of(self, service: Name) -> RequestStreams:
        requests = self._publications.requests.get(service)
        if requests is None:
            raise LocalError(f"no call of {service.short} here")
        return requests

    def _send_to(self, right: Right, service: Name, party: Name, message: bytes) -> None:
        subscription = self._subscriptions.get(service)
        if subscription is None or subscription.right is not right:
            raise LocalError(f"no {right.value} of {service.short} here")
        self._publications.stream_to(service, party, self._clock.now_s).publish(message)
