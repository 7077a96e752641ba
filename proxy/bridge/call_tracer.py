"""Tracing of service calls: what a bridge reports, and how both sides of a call know the same trace.

Sans-I/O. Nothing about a trace crosses the overlay. Client and server derive the ids from what the sealed request
holds: the service, the client, the part and the call's number, whose start is random in 64 bits. So an eavesdropper
cannot link a frame to a trace, and a client that traces needs no consent of its servers.
Source of the sizes: W3C Trace Context, section 3.2.2: 16 bytes of trace id, 8 bytes of parent id, neither zero.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Final, NamedTuple

from gdp.names import Name

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


class CallTracer:
    """Receiver of what happens to calls, which ignores it; the bridge's thread calls each method, and none raises."""

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
