"""Configuration of a relay: every key of ``relay.yaml``, its bounds and its default.

I/O; loading reads files and changes nothing. ``docs/reference/configuration.md`` explains the keys to users.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, IPvAnyAddress, field_validator, model_validator

from gdp.config.config import ServerText
from gdp.config.schema import Directory, Domain, Metrics, NewFile, RequiredName, Section, Unique, load
from gdp.names import Name
from gdp.relay.framing import MTU_MAX, MTU_MIN

__all__ = ["RelayBorder", "RelayConfig", "RelayServer"]

RELAY_PORT: Final = 443
CLIENTS_MAX: Final = 64
MTU_DEFAULT: Final = 1_350  # of a tunnel: a path keeps its MTU when frames change between tunnel and relay
QUEUE_BYTES: Final = 1 << 20
RATE_MIN: Final = 100_000  # bytes/s: pauses of reading stay well below ``dead_ms``
_HEX_NAME_CHARS: Final = 64


class RelayServer(Section):
    """What a border relays, and for whom.

    ``allow`` holds labels of members of the own domain, or names of any trusted switch; ``null``: all trusted
    switches. ``address: null`` listens on all of them. ``rate`` is in bytes a second for each client and direction.
    ``enrolment`` is the socket at which the enrolment server of this host takes connections that come to this port.
    """

    port: int = Field(default=RELAY_PORT, ge=1, le=65_535)
    address: IPvAnyAddress | None = None
    allow: Annotated[tuple[str, ...], Unique] | None = None
    rate: int | None = Field(default=None, ge=RATE_MIN)
    clients_max: int = Field(default=CLIENTS_MAX, ge=1, le=1_000)
    enrolment: NewFile | None = None

    @field_validator("allow")
    @classmethod
    def _names_in_lower_case(cls, allow: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if allow is None:
            return None
        return tuple(each.lower() if len(each) == _HEX_NAME_CHARS else each for each in allow)


class RelayBorder(Section):
    """A border that this member dials: the name of its switch, and its endpoints in the order of attempts.

    With ``standby`` it is dialled only while the switch on this host has no tunnel to it that is up.
    """

    peer: RequiredName
    endpoints: Annotated[tuple[ServerText, ...], Unique] = Field(min_length=1)
    standby: bool = True


class RelayConfig(Section):
    """``relay.yaml``: ``server`` on a border, ``borders`` on a member.

    ``identity`` is that of the switch whose frames are relayed. ``switch_socket`` is its ``control_socket``, where that
    is configured.
    """

    identity: Directory
    domain: Domain
    server: RelayServer | None = None
    borders: tuple[RelayBorder, ...] = ()
    mtu: int = Field(default=MTU_DEFAULT, ge=MTU_MIN, le=MTU_MAX)
    queue_bytes: int = Field(default=QUEUE_BYTES, ge=1 << 16, le=1 << 26)
    keepalive_ms: int = Field(default=250, ge=10, le=60_000)
    dead_ms: int = Field(default=1_000, ge=100, le=600_000)
    revocations: Directory | None = None
    metrics: Metrics | None = None
    control_socket: NewFile | None = None
    switch_socket: NewFile | None = None
    sandbox: bool = True

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
