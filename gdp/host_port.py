"""Text form of a host and a TCP or UDP port. Sans-I/O. Source: RFC 3986, section 3.2 (IPv6 stands in brackets)."""

from __future__ import annotations

from typing import Final

from gdp.errors import LocalError

PORT_MAX: Final = 65_535
_TEXT_MAX: Final = 128


def split_host_port(text: str) -> tuple[str, int]:
    """Return host and port of ``host:port``; the brackets of an IPv6 address are removed.

    Raises:
        LocalError: the text has another form.
    """
    host, colon, port = text.rpartition(":")
    is_bracketed = host.startswith("[") and host.endswith("]")
    host = host[1:-1] if is_bracketed else host
    is_host = bool(host) and host.isascii() and host.isprintable() and not any(each in host for each in " []")
    is_number = port.isascii() and port.isdecimal() and 0 < int(port) <= PORT_MAX
    if not (colon and is_host and is_number and len(text) <= _TEXT_MAX) or (":" in host and not is_bracketed):
        raise LocalError(f"expected host:port, with an IPv6 address in brackets, not {text!r}")
    return host, int(port)


def checked_host_port(text: str) -> str:
    """Return ``host:port`` unchanged, as a validator of pydantic. Raises ``ValueError``: another form."""
    try:
        split_host_port(text)
    except LocalError as error:
        raise ValueError(str(error)) from error
    return text
