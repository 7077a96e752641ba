"""Round-trip time to an endpoint: the minimum of several tries, by TCP connect or UDP echo.

I/O. A TCP connect takes one round trip: SYN, SYN-ACK. The echo service is RFC 862; foreign datagrams are ignored.
"""

from __future__ import annotations

import secrets
import socket
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from fog.latency.config import ProbeEndpoint

TRIES: Final = 5
_AT_ONCE_MAX: Final = 16
_NONCE_BYTES: Final = 16


@dataclass(frozen=True, slots=True)
class Probed:
    """Result of a probe; ``ms``: minimum round trip of ``TRIES``; None: no answer."""

    ms: float | None
    reason: str = ""


def probe_all(endpoints: Mapping[str, ProbeEndpoint], timeout_s: float) -> dict[str, Probed]:
    """Probe one endpoint per region in parallel; a batch of 16 takes at most ``TRIES`` times ``timeout_s``."""
    if not endpoints:
        return {}
    with ThreadPoolExecutor(min(len(endpoints), _AT_ONCE_MAX), "probe") as threads:
        found = threads.map(lambda endpoint: probe(endpoint, timeout_s), endpoints.values())
        return dict(zip(endpoints, found, strict=True))


def probe(endpoint: ProbeEndpoint, timeout_s: float) -> Probed:
    """Measure one endpoint; a failed try ends the probe, unless an earlier try succeeded."""
    kind = socket.SOCK_STREAM if endpoint.protocol == "tcp" else socket.SOCK_DGRAM
    try:
        family, _, _, _, address = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)[0]
    except (OSError, UnicodeError) as error:
        return Probed(None, f"{endpoint.host}: {getattr(error, 'strerror', None) or error}")
    measure = _connect if endpoint.protocol == "tcp" else _echo
    times_s: list[float] = []
    reason = ""
    for _ in range(TRIES):
        try:
            with socket.socket(family, kind) as one:
                times_s.append(measure(one, address, timeout_s))
        except OSError as error:
            reason = f"no answer within {timeout_s:g} s" if isinstance(error, TimeoutError) else str(error.strerror)
            break
    return Probed(round(min(times_s) * 1e3, 3)) if times_s else Probed(None, reason)


def _connect(one: socket.socket, address: object, timeout_s: float) -> float:
    one.settimeout(timeout_s)
    begun_s = time.perf_counter()
    one.connect(address)  # type: ignore[arg-type]  # as getaddrinfo returns it
    return time.perf_counter() - begun_s


def _echo(one: socket.socket, address: object, timeout_s: float) -> float:
    nonce = secrets.token_bytes(_NONCE_BYTES)
    one.connect(address)  # type: ignore[arg-type]  # so that a refusal is reported
    begun_s = time.perf_counter()
    one.send(nonce)
    while (left_s := begun_s + timeout_s - time.perf_counter()) > 0:
        one.settimeout(left_s)
        if one.recv(_NONCE_BYTES + 1) == nonce:
            return time.perf_counter() - begun_s
    raise TimeoutError
