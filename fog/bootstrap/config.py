"""Section ``enrolment:`` of ``fog.yaml``, and the form of addresses in that file.

Sans-I/O.
"""

from __future__ import annotations

from pydantic import Field

from gdp.config.schema import Section

__all__ = ["EnrolmentConfig", "host_and_port", "listening_place", "reachable_place"]


def host_and_port(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT``; an IPv6 address is written in brackets; an empty host or ``*`` means every address.

    Raises:
        ValueError: the text has another form.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"{text!r}: expected HOST:PORT")
    if host.startswith("[") != host.endswith("]") or (":" in host and not host.startswith("[")):
        raise ValueError(f"{text!r}: an IPv6 address stands in brackets: [HOST]:PORT")
    return ("" if host == "*" else host.strip("[]")), int(port)


def listening_place(text: str) -> str:
    """Return ``HOST:PORT`` unchanged.

    Raises:
        ValueError: the text has another form.
    """
    host_and_port(text)
    return text


def reachable_place(text: str) -> str:
    """Return ``HOST:PORT`` unchanged.

    Raises:
        ValueError: the text has another form, or no host.
    """
    if not host_and_port(text)[0]:
        raise ValueError(f"{text!r}: machines need an address to reach: expected HOST:PORT")
    return text


class EnrolmentConfig(Section):
    """Section ``enrolment:`` of ``fog.yaml``."""

    revoke_misused: bool = Field(
        default=True, description="Revoke and replace a machine whose token was used again with another key."
    )
