"""The configuration of a switch and of a RIB: every key, its bounds and its default.

Place: shell; loading reads files and changes nothing. ``docs/configuration.md`` explains the keys to people.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from gdp.limits import DEAD_S, HELLO_S, LEASE_MAX_S, LEASE_MIN_S, RIB_NAMES_PER_SENDER, RIB_WATCHES_MAX, TABLE_MAX
from gdp.nodes.schema import Directory, Domain, Ifname, Metrics, NameText, Section, Unique, load
from gdp.ports.kernel.shapes import ENTRIES_DEFAULT

__all__ = ["DataPlane", "PortConfig", "Quotas", "RibConfig", "SwitchConfig"]

DataPlane = Literal["auto", "kernel", "raw", "scapy"]

COST_DEFAULT: Final = 10
_ATTACH_MAX: Final = 13  # leaves room for the "-s" of the switch's end


def _attach_name(text: str) -> str:
    if len(text) > _ATTACH_MAX:
        raise ValueError(f"at most {_ATTACH_MAX} characters, for the switch's end is {text}-s")
    return text


AttachName = Annotated[Ifname, AfterValidator(_attach_name)]


class PortConfig(Section):
    """A layer-2 device towards neighbours; one that is ``optional`` may appear later."""

    iface: Ifname
    optional: bool = False
    cost: int = Field(default=COST_DEFAULT, ge=1, le=1_000_000)


class SwitchConfig(Section):
    """``switch.yaml``. For each ``NAME`` of ``attach`` the command makes a veth pair ``NAME``/``NAME-s``; a RIB or
    proxy on this host takes ``NAME`` as its device. Files in ``revocations`` are read at start and on SIGHUP. The
    kernel plane holds ``table_max`` entries, and the process forwards by the others.
    """

    identity: Directory
    domain: Domain
    ports: tuple[PortConfig, ...] = ()
    attach: Annotated[tuple[AttachName, ...], Unique] = ()
    data_plane: DataPlane = "auto"
    table_max: int = Field(default=ENTRIES_DEFAULT, ge=1, le=TABLE_MAX)
    revocations: Directory | None = None
    metrics: Metrics | None = None
    hello_s: float = Field(default=HELLO_S, ge=0.01, le=60.0)
    dead_s: float = Field(default=DEAD_S, ge=0.02, le=600.0)

    @classmethod
    def load(cls, path: Path) -> SwitchConfig:
        """Read ``switch.yaml``.

        Raises:
            ConfigError: every error of the file, each with line and column.
        """
        return load(cls, path)

    def with_ifaces(self, ifaces: Iterable[str]) -> SwitchConfig:
        """Return this configuration with a port of default cost for each device that has none yet."""
        known = {port.iface for port in self.ports}
        added = tuple(PortConfig(iface=iface) for iface in dict.fromkeys(ifaces) if iface not in known)
        return self.model_copy(update={"ports": self.ports + added})

    @field_validator("ports")
    @classmethod
    def _each_port_once(cls, ports: tuple[PortConfig, ...]) -> tuple[PortConfig, ...]:
        seen: set[str] = set()
        for port in ports:
            if port.iface in seen:
                raise ValueError(f"{port.iface} stands twice")
            seen.add(port.iface)
        return ports

    @field_validator("dead_s")
    @classmethod
    def _neighbours_outlive_a_lost_hello(cls, dead_s: float, info: object) -> float:
        hello_s = getattr(info, "data", {}).get("hello_s", HELLO_S)
        if dead_s < 2 * hello_s:
            raise ValueError(f"at least twice hello_s ({hello_s:g}), so that one lost hello loses no neighbour")
        return dead_s

    @model_validator(mode="after")
    def _attachments_are_not_ports(self) -> SwitchConfig:
        taken = {port.iface for port in self.ports}
        for name in self.attach:
            if taken & {name, f"{name}-s"}:
                raise ValueError(f"attach: {name} is already the name of a port")
        return self


class Quotas(Section):
    """What one RIB does for others at most."""

    names_per_sender: int = Field(default=RIB_NAMES_PER_SENDER, ge=1)
    watches: int = Field(default=RIB_WATCHES_MAX, ge=1)
    lease_max_s: float = Field(default=LEASE_MAX_S, ge=LEASE_MIN_S, le=LEASE_MAX_S)


class RibConfig(Section):
    """``rib.yaml``. ``upper`` is the name of the RIB of the tier above; ``null`` at the top."""

    identity: Directory
    domain: Domain
    iface: Ifname
    upper: NameText = None
    allow_unowned: bool = False
    quotas: Quotas = Quotas()
    metrics: Metrics | None = None

    @classmethod
    def load(cls, path: Path) -> RibConfig:
        """Read ``rib.yaml``.

        Raises:
            ConfigError: every error of the file, each with line and column.
        """
        return load(cls, path)
