"""Files of a domain's own machine (the border), beyond those of every member (``member_files``).

I/O. In the directory that ``gdp domain create`` makes::

    domain.yaml         what the enrolment server needs
    domain/  owner/     root key and ledger; key and master secret of the owner of names
    enrolment/          registry.sqlite3, and the TLS key of the server
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator, Field

from gdp.config.schema import Directory, ExistingFile, Section, Unique, load
from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.host_port import checked_host_port
from gdp.trust.join_token import SERVERS_MAX, checked_server

DOMAIN_FILE: Final = "domain.yaml"
HANDOVER_SOCKET: Final = "handover.sock"  # in the server's state: the relay gives it connections of its port
MEMBER_DAYS: Final = 30.0  # also of the border's first memberships


def _endpoint(text: str) -> str:
    try:
        Endpoint.from_text(text)
    except LocalError as error:
        raise ValueError(str(error)) from error
    return text


class DomainConfig(Section):
    """``domain.yaml``: keys, folders and addresses of a domain's enrolment server."""

    domain: Directory = Field(description="Directory of the domain's root key.")
    owner: Directory = Field(description="Directory of the owner of names.")
    switch: Directory | None = Field(description="Directory of the border's switch. `null`: no border.")
    state: Directory = Field(description="Private directory of registry and TLS key.")
    peers: Directory = Field(description="Where a record of each member is written.")
    revocations: Directory = Field(description="Where revocations are written.")
    listen: int = Field(ge=0, le=65_535, description="TCP port of the server.")
    servers: Annotated[tuple[Annotated[str, AfterValidator(checked_server)], ...], Unique] = Field(
        min_length=1, max_length=SERVERS_MAX, description="`HOST:PORT` or `unix:PATH` of the server, for tokens."
    )
    public: Annotated[tuple[Annotated[str, AfterValidator(_endpoint)], ...], Unique] = Field(
        default=(), description="Numeric `ADDRESS:PORT` of the border's tunnels."
    )
    relays: Annotated[tuple[Annotated[str, AfterValidator(checked_host_port)], ...], Unique] = Field(
        default=(), description="`HOST:PORT` of its relay, for members without UDP."
    )
    trusts: Annotated[tuple[ExistingFile, ...], Unique] = Field(
        default=(), description="Roots of other domains, for members."
    )
    member_days: float = Field(
        default=MEMBER_DAYS, ge=0.001, le=3_650.0, description="Days of a membership; agents renew it after two thirds."
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DomainFiles:
    """The loaded ``domain.yaml`` of a directory."""

    directory: Path
    config: DomainConfig

    @classmethod
    def load(cls, directory: Path) -> DomainFiles:
        """Read the files of a domain. Raises ``LocalError`` or ``ConfigError``: no domain was created there."""
        path = directory / DOMAIN_FILE
        if not path.exists():
            raise LocalError(f"{directory}: no {DOMAIN_FILE} is here; create the domain with gdp domain create")
        return cls(directory=directory, config=load(DomainConfig, path))
