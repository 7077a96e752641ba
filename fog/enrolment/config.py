"""Section ``enrolment:`` of ``fog.yaml``: the address at which rented machines reach the launcher.

Sans-I/O.
"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import AfterValidator, Field

from gdp.nodes.schema import Section

__all__ = ["ENROLMENT_PORT", "EnrolmentConfig", "host_and_port", "listening_place", "reachable_place"]

ENROLMENT_PORT: Final = 4780


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

    address: Annotated[str, AfterValidator(reachable_place)] | None = Field(
        default=None,
        description="`HOST:PORT` at which a rented machine reaches the supervisor, by TCP. Default: the tunnel's"
        f" `remote`, port {ENROLMENT_PORT}. Machines of `local` use a Unix socket.",
    )
    listen: Annotated[str, AfterValidator(listening_place)] | None = Field(
        default=None,
        description="`HOST:PORT` on which the supervisor listens. Default: every address, with the port of `address`.",
    )
    revoke_misused: bool = Field(
        default=True,
        description="Whether a machine whose token was used again, with another key, is revoked and replaced.",
    )
