"""Configuration of a relay: every key of ``relay.yaml``, its bounds and its default.

I/O; loading reads files and changes nothing. ``docs/reference/configuration.md`` explains the keys to users.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, IPvAnyAddress, field_validator, model_validator

from gdp.config.config import ServerText
from gdp.config.schema import (
    ControlSocket,
    Directory,
    Domain,
    Identity,
    Metrics,
    NewFile,
    RequiredName,
    Sandbox,
    Section,
    Unique,
    load,
)
from gdp.names import Name
from gdp.relay.framing import MTU_MAX, MTU_MIN

RELAY_PORT: Final = 443
CLIENTS_MAX: Final = 64
MTU_DEFAULT: Final = 1_350  # of a tunnel: a path keeps its MTU when frames change between tunnel and relay
QUEUE_BYTES: Final = 1 << 20
RATE_MIN: Final = 100_000  # bytes/s: pauses of reading stay well below ``dead_ms``
_HEX_NAME_CHARS: Final = 64


class RelayServer(Section):
    """What a border relays, and for whom."""

    port: int = Field(default=RELAY_PORT, ge=1, le=65_535, description="TCP port.")
    address: IPvAnyAddress | None = Field(default=None, description="Numeric address to listen on.")
    allow: Annotated[tuple[str, ...], Unique] | None = Field(
        default=None, description="Labels of the own domain, or names of trusted switches. `null`: all trusted."
    )
    rate: int | None = Field(default=None, ge=RATE_MIN, description="Bytes a second for each member and direction.")
    clients_max: int = Field(
        default=CLIENTS_MAX, ge=1, le=1_000, description="Members at once; half may be of other domains."
    )
    enrolment: NewFile | None = Field(
        default=None, description="Socket of the enrolment server, for connections of `gdp-enrolment/1`."
    )

    @field_validator("allow")
    @classmethod
    def _names_in_lower_case(cls, allow: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if allow is None:
            return None
        return tuple(each.lower() if len(each) == _HEX_NAME_CHARS else each for each in allow)


class RelayBorder(Section):
    """A border that this member dials."""

    peer: RequiredName = Field(description="Its switch, 64 hex digits; another is refused.")
    endpoints: Annotated[tuple[ServerText, ...], Unique] = Field(
        min_length=1, description="`HOST:PORT` in the order of attempts; IPv6 in brackets."
    )
    standby: bool = Field(default=True, description="Dial only while no tunnel to it is up.")


class RelayConfig(Section):
    """``relay.yaml``: ``server`` on a border, ``borders`` on a member."""

    identity: Identity
    domain: Domain = Field(description="The trust domain, and the others whose members are believed.")
    server: RelayServer | None = Field(default=None, description="Of a border: for whom it relays.")
    borders: tuple[RelayBorder, ...] = Field(default=(), description="Borders that this member dials.")
    mtu: int = Field(
        default=MTU_DEFAULT,
        ge=MTU_MIN,
        le=MTU_MAX,
        description="MTU of the devices, of both ends the smaller; 1350 as a tunnel.",
    )
    queue_bytes: int = Field(
        default=QUEUE_BYTES, ge=1 << 16, le=1 << 26, description="Waiting bytes; then the oldest best-effort frames go."
    )
    keepalive_ms: int = Field(default=250, ge=10, le=60_000, description="Pause in its data before a keepalive.")
    dead_ms: int = Field(
        default=1_000, ge=100, le=600_000, description="Silence that ends a connection; at least twice `keepalive_ms`."
    )
    revocations: Directory | None = Field(
        default=None, description="Revocations, read twice a second; a revoked member is disconnected."
    )
    metrics: Metrics | None = Field(default=None, description="Prometheus text and probes.")
    control_socket: ControlSocket = None
    switch_socket: NewFile | None = Field(
        default=None, description="The switch's `control_socket`, which `standby` asks."
    )
    sandbox: Sandbox = True

    @classmethod
    def load(cls, path: Path) -> RelayConfig:
        """Read ``relay.yaml``."""
        return load(cls, path, section="relay")

    @field_validator("borders")
    @classmethod
    def _each_border_once(cls, borders: tuple[RelayBorder, ...]) -> tuple[RelayBorder, ...]:
        seen: set[Name] = set()
        for border in borders:
            if border.peer in seen:
                raise ValueError(f"{border.peer.short} stands twice; give one border several endpoints")
            seen.add(border.peer)
        return borders

    @model_validator(mode="after")
    def _has_a_use(self) -> RelayConfig:
        if self.server is None and not self.borders:
            raise ValueError("give server (on a border) or borders (on a member)")
        if self.dead_ms < 2 * self.keepalive_ms:
            raise ValueError(f"dead_ms: at least twice keepalive_ms ({self.keepalive_ms})")
        return self
