"""ClientHello of TLS: which application protocols a client offers, read before any TLS library has the connection.

Sans-I/O. Source: RFC 8446, section 4.1.2, for the message; RFC 7301 for ALPN. Two programs share one TCP port by it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

ENROLMENT_ALPN: Final = "gdp-enrolment/1"
HELLO_MAX_BYTES: Final = 5 + (1 << 14)  # one record; a longer hello counts as one without protocols
_HANDSHAKE, _CLIENT_HELLO, _ALPN_EXTENSION = 22, 1, 16
_RECORD_BYTES: Final = 5
_FIXED_BYTES: Final = 4 + 2 + 32  # handshake header, version, random


class ClientHello(NamedTuple):
    """What the first bytes of a connection say.

    Attributes:
        needed_bytes: how many are necessary to read it; 0: it was read.
        protocols: as the client offers them; empty also where the bytes are no ClientHello.
    """

    needed_bytes: int
    protocols: tuple[bytes, ...] = ()


def read_client_hello(data: bytes) -> ClientHello:
    """Read the first bytes of a connection; arbitrary bytes are no error."""
    if data[:1] and data[0] != _HANDSHAKE:
        return ClientHello(0)
    if len(data) < _RECORD_BYTES:
        return ClientHello(_RECORD_BYTES)
    whole = _RECORD_BYTES + int.from_bytes(data[3:5], "big")
    if whole > HELLO_MAX_BYTES:
        return ClientHello(0)
    if len(data) < whole:
        return ClientHello(whole)
    try:
        return ClientHello(0, _protocols(data[_RECORD_BYTES:whole]))
    except (IndexError, ValueError):
        return ClientHello(0)


def _protocols(message: bytes) -> tuple[bytes, ...]:
    if message[0] != _CLIENT_HELLO:
        return ()
    at = _FIXED_BYTES
    for length_bytes in (1, 2, 1):  # session id, cipher suites, compression methods
        _, at = _vector(message, at, length_bytes)
    extensions, _ = _vector(message, at, 2)
    at = 0
    while at < len(extensions):
        kind = int.from_bytes(extensions[at : at + 2], "big")
        body, at = _vector(extensions, at + 2, 2)
        if kind == _ALPN_EXTENSION:
            return _names(_vector(body, 0, 2)[0])
    return ()


def _names(listed: bytes) -> tuple[bytes, ...]:
    found, at = list[bytes](), 0
    while at < len(listed):
        name, at = _vector(listed, at, 1)
        found.append(name)
    return tuple(found)


def _vector(data: bytes, at: int, length_bytes: int) -> tuple[bytes, int]:
    """Return a vector with a length in front, and where it ends. Raises ``ValueError``: it is cut."""
    begin = at + length_bytes
    end = begin + int.from_bytes(data[at:begin], "big")
    if begin > len(data) or end > len(data):
        raise ValueError("cut")
    return data[begin:end], end
