"""Remote clients of a local service: their liveness, decoders of their requests, and requests that wait for those."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from gdp.client.participant import Message
from gdp.errors import DropReason, LocalError, RemoteError
from gdp.limits import CALLER_AWAY_S
from gdp.names import Name
from proxy.bridge.core.decoder import MessageDecoder
from proxy.serial.channel import RosVersion
from proxy.serial.schema import DefinitionError
from proxy.wire.service import Exchange

EARLY_MAX: Final = 256  # of one client
EARLY_MAX_BYTES: Final = 64 << 20  # of all clients; one client may use as much as it leaves free for others
REMOTE_CLIENTS_MAX: Final = 1_024  # clients whose decoders are kept; the oldest are dropped


@dataclass(frozen=True, slots=True)
class _Caller:
    """One client by its description; a refusal is kept as well, so that it is computed once."""

    description: bytes
    requests: tuple[MessageDecoder, ...] = ()
    unlike: str = ""
    unread: tuple[DropReason, str] | None = None


class RemoteClients:
    """All clients of one service; ``is_strict``: as ``MessageDecoder.ready``."""

    def __init__(self, ours: Exchange, ros: RosVersion, *, is_strict: bool) -> None:
        self._ours = ours
        self._is_strict = is_strict
        self._ros = ros
        self._known: dict[bytes, _Caller] = {}

    def incoming(self, client: bytes, description: bytes, part: int) -> MessageDecoder:
        """Return the decoder of a client's requests for a part.

        Raises:
            DefinitionError: the service here does not accept them.
            RemoteError: the description cannot be read.
        """
        caller = self._known.get(client)
        if caller is None or caller.description != description:
            self._known.pop(client, None)
            caller = self._known[client] = self._learn(description)
            if len(self._known) > REMOTE_CLIENTS_MAX:
                del self._known[next(iter(self._known))]
        if caller.unread is not None:
            raise RemoteError(*caller.unread)
        if caller.unlike:
            raise DefinitionError(caller.unlike)
        if part >= len(caller.requests):
            raise DefinitionError("the client asks for a part that this service has not")
        return caller.requests[part]

    def _learn(self, description: bytes) -> _Caller:
        try:
            theirs = Exchange.from_cbor(description)
            pairs = zip(theirs.services, self._ours.services, strict=False)
            ready = (
                MessageDecoder.ready(a.request, theirs.encoding, b.request, self._ros, is_strict=self._is_strict)
                for a, b in pairs
            )
            return _Caller(description, tuple(ready))
        except LocalError as error:
            return _Caller(description, unlike=str(error))
        except RemoteError as error:
            return _Caller(description, unread=(error.reason, error.detail))


class ClientLiveness:
    """Time of the last sign of life of each client."""

    def __init__(self) -> None:
        self._heard_s: dict[Name, float] = {}

    def update(
        self, clients: Collection[Name], *, present: Collection[Name], known: Collection[bytes], now_s: float
    ) -> list[Name]:
        """Return the clients that have gone.

        Args:
            clients: those whose calls are under way.
            present: those that are reachable now.
            known: those that may become reachable again.
        """
        self._heard_s = {each: now_s if each in present else self._heard_s.get(each, now_s) for each in clients}
        return [
            client
            for client, heard_s in self._heard_s.items()
            if client not in present and (bytes(client) not in known or now_s - heard_s >= CALLER_AWAY_S)
        ]


class UndescribedRequests:
    """Waiting messages by client, in order."""

    def __init__(self, max_bytes: int = EARLY_MAX_BYTES) -> None:
        self._waiting: dict[bytes, deque[Message]] = {}
        self._bytes: dict[bytes, int] = {}
        self._free_bytes = max_bytes

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, message: Message) -> bool:
        """Add a message; return False where its client has used its quota of messages or bytes."""
        client, size = bytes(message.delivered.publisher), len(message.delivered.message)
        if len(self._waiting.get(client, ())) >= EARLY_MAX or self._bytes.get(client, 0) + size > self._free_bytes:
            return False
        self._waiting.setdefault(client, deque()).append(message)
        self._bytes[client] = self._bytes.get(client, 0) + size
        self._free_bytes -= size
        return True

    def poll_messages(self, client: bytes) -> list[Message]:
        """Remove and return the waiting messages of a client."""
        self._free_bytes += self._bytes.pop(client, 0)
        return list(self._waiting.pop(client, ()))

    def forget_all_but(self, clients: Collection[bytes]) -> int:
        """Drop the messages of clients that are gone; return their number."""
        return sum(len(self.poll_messages(client)) for client in self._waiting.keys() - clients)
