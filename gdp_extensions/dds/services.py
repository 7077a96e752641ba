"""Services of the virtual node: servers and clients that interoperate with Cyclone DDS's peers.

I/O, through the node. rmw_cyclonedds puts the client (8 bytes) and a call's number (8 bytes) before the message. Fast
DDS and others put them into the header of the RTPS sample, which the binding can neither write nor read. Services with
such peers are refused with a reason.
Source: rmw_cyclonedds_cpp, ``cdds_request_header_t`` and ``clientid``/``serviceid`` in user data.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from gdp_extensions.dds import library
from gdp_extensions.dds.naming import CYCLONE, dds_type, identity, identity_in, user_data, vendor
from gdp_extensions.dds.node import EntityContext, Sample
from gdp_extensions.dds.profile import offered, requested
from proxy.endpoints.core.endpoint import CallFailed, EndpointError, RequestReceived, ResponseReceived, Role
from proxy.endpoints.core.qos import default
from proxy.serial.channel import Service
from proxy.serial.empty import NoAnswer

_PREFIX: Final = 4  # CDR encapsulation
_HEADER: Final = 16
_QOS: Final = default(depth=1_000)  # a thousand calls at once without eviction
_WAITING_MAX: Final = 1_000


class _Halves(ABC):
    """The local halves of a service's request and reply topics."""

    def __init__(self, at: EntityContext, role: Role, name: str, type_name: str, type_hash: str) -> None:
        node, self._survey, self._handle, self._tell = at
        self._node = node
        self._name = name
        self._fault = ""
        is_server = role is Role.SERVES
        mark = identity("serviceid" if is_server else "clientid", node.gid, at.handle)
        self.identity = identity_in(mark)
        data = user_data(type_hash, mark)
        halves = [(f"rq{name}Request", f"{type_name}_Request"), (f"rr{name}Reply", f"{type_name}_Response")]
        heard, said = halves if is_server else reversed(halves)
        self.writer = node.write(said[0], dds_type(said[1]), offered(_QOS, data))
        self.writer.tell_matches(self.matched)
        self.reader = node.read(heard[0], dds_type(heard[1]), requested(_QOS, data), self.receive_samples)

    @abstractmethod
    def matched(self) -> None:
        """Process a change of the matched readers."""

    @abstractmethod
    def receive_samples(self, samples: list[Sample]) -> None:
        """Process received samples."""

    def close(self) -> None:
        """Close both halves."""
        self._node.close(self.reader, self.writer)

    def _check_vendors(self, role: Role) -> None:
        """Report once that a peer of another vendor is present."""
        peers = self._survey.peers(role, self._name)
        others = {vendor(peer.gid) for peer in peers if not peer.gid.startswith(CYCLONE)}
        before, self._fault = self._fault, ""
        if others:
            who = "server" if role is Role.SERVES else "client"
            self._fault = (
                f"a {who} speaks {', '.join(sorted(others))}, whose way to mark requests endpoint dds does not have;"
                " use endpoint ros2"
            )
            if self._fault != before:
                self._tell(EndpointError(self._handle, self._fault))


class _Ask(NamedTuple):
    header: bytes
    client: int  # instance handle of the request's writer


class Server(_Halves):
    """Serves a name to local clients."""

    def __init__(self, at: EntityContext, service: Service, type_hash: str, tickets: Callable[[], int]) -> None:
        self._no_answer = NoAnswer.of(service)
        self._tickets = tickets
        self._asks: dict[int, _Ask] = {}
        self._early = deque[Sample](maxlen=_WAITING_MAX)  # of clients that are not discovered yet
        self._late = deque[tuple[_Ask, bytes]](maxlen=_WAITING_MAX)  # whose clients do not match the reply writer yet
        self._matched: frozenset[bytes] = frozenset()
        super().__init__(at, Role.SERVES, service.name, service.type_name, type_hash)
        self.follow()

    def follow(self) -> None:
        """Update the clients."""
        self._check_vendors(Role.CALLS)
        gone = [ticket for ticket, ask in self._asks.items() if self._survey.peer(ask.client) is None]
        for ticket in gone:
            del self._asks[ticket]
        for _ in range(len(self._early)):
            self._ask(self._early.popleft())
        self.matched()

    def receive_samples(self, samples: list[Sample]) -> None:
        """Process requests."""
        for sample in samples:
            self._ask(sample)

    def answer(self, ticket: int, raw: bytes) -> None:
        """Answer a request, as soon as its client matches the reply writer."""
        ask = self._asks.pop(ticket, None)
        if ask is None:
            return
        if self._can_hear(ask):
            self._say(ask, raw)
        else:
            self._late.append((ask, raw))

    def refuse(self, ticket: int, reason: str) -> None:
        """Answer with the reason, if the response has a field for it; else the client's own timeout ends the call."""
        if self._no_answer is not None and self._no_answer.says_reason:
            self.answer(ticket, self._no_answer.to_raw(reason))
        else:
            self._asks.pop(ticket, None)

    def matched(self) -> None:
        """Answer the clients that had no matching reader yet."""
        peers = [self._survey.peer(handle) for handle in library.matched_readers(self.writer.ref)]
        self._matched = frozenset(peer.identity for peer in peers if peer is not None)
        for _ in range(len(self._late)):
            ask, raw = self._late.popleft()
            if self._can_hear(ask):
                self._say(ask, raw)
            elif self._survey.peer(ask.client) is not None:
                self._late.append((ask, raw))

    def _ask(self, sample: Sample) -> None:
        raw, client = sample.raw, self._survey.peer(sample.writer)
        if client is None:
            self._early.append(sample)
        # for other vendors ``follow`` has reported the fault
        elif client.gid.startswith(CYCLONE) and len(raw) >= _PREFIX + _HEADER:
            ticket = self._tickets()
            self._asks[ticket] = _Ask(raw[_PREFIX : _PREFIX + _HEADER], sample.writer)
            self._tell(RequestReceived(self._handle, ticket, raw[:_PREFIX] + raw[_PREFIX + _HEADER :]))

    def _can_hear(self, ask: _Ask) -> bool:
        client = self._survey.peer(ask.client)
        return client is None or not client.identity or client.identity in self._matched

    def _say(self, ask: _Ask, raw: bytes) -> None:
        code = self.writer.write(raw[:_PREFIX] + ask.header + raw[_PREFIX:])
        if code < 0:
            self._tell(EndpointError(self._handle, f"a response could not be sent (code {code})"))


class _Call(NamedTuple):
    number: int
    servers: frozenset[bytes]


class Client(_Halves):
    """Calls a local service."""

    def __init__(self, at: EntityContext, name: str, type_name: str, type_hash: str) -> None:
        self._calls: dict[int, _Call] = {}  # under way, by sequence number
        self._sequence: dict[int, int] = {}  # of each call
        self._early = deque[tuple[int, bytes]]()
        self._last = 0
        super().__init__(at, Role.CALLS, name, type_name, type_hash)
        self._me = self.writer.handle.to_bytes(8, "little")
        self.follow()

    def follow(self) -> None:
        """Update the servers; calls fail when all their servers have left."""
        self._check_vendors(Role.SERVES)
        servers = self._servers()
        for sequence, call in list(self._calls.items()):
            if not call.servers & servers:
                self._forget(sequence)
                self._tell(CallFailed(self._handle, call.number, "the server is gone"))
        self.matched()

    def call(self, number: int, raw: bytes) -> None:
        """Send a request, as soon as there is a server that can answer it.

        Every server of a name receives every request: one of another vendor would misread it.
        """
        servers = self._servers()
        if self._fault or not servers:
            self._tell(CallFailed(self._handle, number, self._fault or "no server"))
            return
        self._last += 1
        self._calls[self._last] = _Call(number, servers)
        self._sequence[number] = self._last
        message = raw[:_PREFIX] + self._me + self._last.to_bytes(8, "little") + raw[_PREFIX:]
        if self._early or not self._is_matched():
            self._early.append((self._last, message))
        else:
            self._send(self._last, message)

    def drop(self, number: int) -> None:
        """Forget a call."""
        sequence = self._sequence.get(number)
        if sequence is not None:
            self._forget(sequence)

    def matched(self) -> None:
        """Send the requests that waited for a server."""
        if self._early and self._is_matched():
            while self._early:
                self._send(*self._early.popleft())

    def receive_samples(self, samples: list[Sample]) -> None:
        """Process responses; those for other clients arrive too."""
        for raw, _, _ in samples:
            if raw[_PREFIX : _PREFIX + 8] != self._me or len(raw) < _PREFIX + _HEADER:
                continue
            call = self._forget(int.from_bytes(raw[_PREFIX + 8 : _PREFIX + _HEADER], "little"))
            if call is not None:
                self._tell(ResponseReceived(self._handle, call.number, raw[:_PREFIX] + raw[_PREFIX + _HEADER :]))

    def _send(self, sequence: int, message: bytes) -> None:
        call = self._calls.get(sequence)
        if call is None:
            return  # dropped, or failed, while it waited
        code = 0 if self._fault else self.writer.write(message)
        if self._fault or code < 0:
            self._forget(sequence)
            reason = self._fault or f"the request could not be sent (code {code})"
            self._tell(CallFailed(self._handle, call.number, reason))

    def _forget(self, sequence: int) -> _Call | None:
        call = self._calls.pop(sequence, None)
        if call is not None:
            self._sequence.pop(call.number, None)
        return call

    def _is_matched(self) -> bool:
        return bool(library.count_readers(self.writer.ref) and library.count_writers(self.reader.ref))

    def _servers(self) -> frozenset[bytes]:
        peers = self._survey.peers(Role.SERVES, self._name)
        return frozenset(peer.gid for peer in peers if peer.gid.startswith(CYCLONE))
