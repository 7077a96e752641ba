"""Tracing of service calls: what a bridge reports, and how both sides of a call know the same trace.

Sans-I/O. Nothing about a trace crosses the overlay. Client and server derive the ids from what the sealed request
holds: the service, the client, the part and the call's number, whose start is random in 64 bits. So an eavesdropper
cannot link a frame to a trace, and a client that traces needs no consent of its servers.
Source of the sizes: W3C Trace Context, section 3.2.2: 16 bytes of trace id, 8 bytes of parent id, neither zero.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Final, NamedTuple, Protocol

from gdp.names import Name

__all__ = ["CallKey", "CallTracer", "NoTracer", "TraceIds", "trace_ids"]

_CONTEXT: Final = b"gdp trace of a call, version 1"


class CallKey(NamedTuple):
    """One call: ``client`` is the node that made it, ``part`` as in ``proxy.wire.service``."""

    service: Name
    client: Name
    part: int
    call: int


class TraceIds(NamedTuple):
    """Trace id, and the span id of the client's call, which is the parent of every other span of the trace."""

    trace: int
    span: int


def trace_ids(key: CallKey) -> TraceIds:
    """Return the ids that client and server give to a call; never zero."""
    numbers = key.part.to_bytes(1, "big") + key.call.to_bytes(8, "big")
    digest = hashlib.sha256(_CONTEXT + bytes(key.service) + bytes(key.client) + numbers).digest()
    return TraceIds(int.from_bytes(digest[:16], "big") or 1, int.from_bytes(digest[16:24], "big") or 1)


class CallTracer(Protocol):
    """What happened to a call; each method is called in the bridge's thread and never raises."""

    def begun(self, key: CallKey, local: str) -> None:
        """Record that a local client calls the service that is ``local`` here."""

    def asked(self, key: CallKey, servers: Iterable[Name]) -> None:
        """Record that the request left for these servers."""

    def responded(self, key: CallKey, server: Name, error: str = "") -> None:
        """Record a server's response, the first or a later one; ``error``: why it refused."""

    def answered(self, key: CallKey, server: Name) -> None:
        """Record that the local client got the response of this server, the first one."""

    def failed(self, key: CallKey, reason: str) -> None:
        """Record that the local client got no response."""

    def serving(self, key: CallKey, local: str) -> None:
        """Record that a remote client's request reached the local server."""

    def served(self, key: CallKey, error: str = "") -> None:
        """Record that the response, or the reason of a failure, left for the client."""

    def close(self) -> None:
        """End all spans, and send what is left of them."""


class NoTracer:
    """Tracing is off."""

    def begun(self, key: CallKey, local: str) -> None:
        """Do nothing."""

    def asked(self, key: CallKey, servers: Iterable[Name]) -> None:
        """Do nothing."""

    def responded(self, key: CallKey, server: Name, error: str = "") -> None:
        """Do nothing."""

    def answered(self, key: CallKey, server: Name) -> None:
        """Do nothing."""

    def failed(self, key: CallKey, reason: str) -> None:
        """Do nothing."""

    def serving(self, key: CallKey, local: str) -> None:
        """Do nothing."""

    def served(self, key: CallKey, error: str = "") -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
