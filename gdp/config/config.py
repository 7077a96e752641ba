"""Configuration of a switch and of a RIB: every key, its bounds and its default.

I/O; loading reads files and changes nothing. ``docs/reference/configuration.md`` explains the keys to users.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_validator,
)

from gdp.config.schema import (
    AuditFolder,
    ControlSocket,
    Directory,
    Domain,
    ExistingFile,
    Identity,
    Ifname,
    JournalMib,
    Metrics,
    NewFile,
    RequiredName,
    Sandbox,
    Section,
    StateFolder,
    TokenFolders,
    Unique,
    load,
)
from gdp.control.endpoints import UPLINKS_MAX, Endpoint
from gdp.control.hello import INTERVAL_MAX_MS, Timing
from gdp.control.link_cost import COST_MAX
from gdp.errors import LocalError
from gdp.host_port import checked_host_port
from gdp.intervals import (
    ADVERTISEMENT,
    DETECT_MULTIPLIER,
    KEEPALIVE_MS,
    LEASE_MAX_S,
    LEASE_MIN_S,
    NEIGHBOUR,
    SCAPY_KEEPALIVE_MS,
)
from gdp.limits import (
    COST_AUTO,
    COST_DEFAULT,
    RELAY_RATE_MAX,
    RELAY_RATE_MIN,
    RIB_NAMES_PER_SENDER,
    RIB_WATCHES_MAX,
    TABLE_MAX,
)
from gdp.ports.kernel.abi import ENTRIES_DEFAULT
from gdp.stores.files import read_private


def _endpoint(text: str) -> str:
    try:
        return Endpoint.from_text(text).to_text()
    except LocalError as error:
        raise ValueError(f"{error}; the address is numeric") from error


EndpointText = Annotated[str, AfterValidator(_endpoint)]
ServerText = Annotated[str, AfterValidator(checked_host_port)]
DataPlane = Literal["auto", "kernel", "raw", "scapy"]
UplinkPlane = Literal["raw", "scapy"]  # of a RIB or proxy

LISTEN_DEFAULT: Final = 51_820  # UDP; the usual port of WireGuard
_KEEPALIVE_MIN_MS: Final = 10
_ATTACH_MAX: Final = 13  # leaves space for the "-s" of the switch's end


def _attach_name(text: str) -> str:
    if len(text) > _ATTACH_MAX:
        raise ValueError(f"at most {_ATTACH_MAX} characters, for the switch's end is {text}-s")
    return text


LeaseSeconds = Annotated[float, Field(ge=LEASE_MIN_S, le=LEASE_MAX_S)]
AttachName = Annotated[Ifname, AfterValidator(_attach_name)]


def _interval(milliseconds: int) -> int:
    if 0 < milliseconds < _KEEPALIVE_MIN_MS:
        raise ValueError(f"0 for none, or at least {_KEEPALIVE_MIN_MS}")
    return milliseconds


KeepaliveMs = Annotated[int, Field(ge=0, le=INTERVAL_MAX_MS), AfterValidator(_interval)]
DetectMultiplier = Annotated[int, Field(ge=2, le=50)]


def _cost(value: object, number: ValidatorFunctionWrapHandler) -> int:
    return COST_AUTO if value == "auto" else int(number(value))


LinkCost = Annotated[int, Field(ge=1, le=COST_MAX), WrapValidator(_cost)]


class PortConfig(Section):
    """A layer-2 device towards neighbours; a ``cost`` of ``auto`` is ``COST_AUTO``."""

    iface: Ifname = Field(description="Device towards neighbours.")
    optional: bool = Field(default=False, description="The device may be absent; the port opens when it appears.")
    cost: LinkCost = Field(default=COST_DEFAULT, description="What a path pays for this link; `auto`: measured.")
    keepalive_ms: KeepaliveMs | None = Field(default=None, description="`null`: the switch's.")
    detect_multiplier: DetectMultiplier | None = Field(default=None, description="`null`: the switch's.")


TunnelBackend = Literal["auto", "kernel", "wireguard-go"]


class LinksConfig(Section):
    """Tunnels across IP networks: VXLAN inside WireGuard, one for each peer."""

    listen: int = Field(
        default=LISTEN_DEFAULT,
        ge=0,
        le=65_535,
        description="UDP port of WireGuard; each further uplink takes the next. 0: any free one.",
    )
    public: Annotated[tuple[EndpointText, ...], Unique] = Field(
        default=(), description="Numeric `ADDRESS:PORT` at which all reach it: a border."
    )
    uplinks: Annotated[tuple[Ifname, ...], Unique] = Field(
        default=(), max_length=UPLINKS_MAX, description="Devices with a tunnel each. Empty: one, by the host's routes."
    )
    peers: Directory | None = Field(
        default=None, description="Directory of records, `*.endpoints`; each file is a tunnel, without a restart."
    )
    direct: bool = Field(default=True, description="Open direct tunnels to other members where both NATs allow it.")
    backend: TunnelBackend = Field(default="auto", description="`auto`: the kernel's WireGuard, else `wireguard-go`.")
    keepalive_s: int = Field(
        default=25, ge=1, le=65_535, description="Seconds between WireGuard's keepalives to dialled peers."
    )
    relay_for: Annotated[tuple[str, ...], Unique] = Field(
        default=(), description="Labels or roles with tunnels here. Empty: all of `peers`."
    )
    relay_rate: int | None = Field(
        default=None, ge=RELAY_RATE_MIN, le=RELAY_RATE_MAX, description="Bytes a second into each tunnel."
    )

    def public_endpoints(self) -> tuple[Endpoint, ...]:
        """Return the stated endpoints."""
        return tuple(map(Endpoint.from_text, self.public))


class SwitchConfig(Section):
    """``switch.yaml``."""

    identity: Identity
    domain: Domain = Field(description="The trust domain, and the others whose members are believed.")
    ports: tuple[PortConfig, ...] = Field(default=(), description="Devices towards neighbours; `--iface` adds to them.")
    attach: Annotated[tuple[AttachName, ...], Unique] = Field(
        default=(), description="Veth pairs `NAME`, `NAME-s`; a RIB or proxy here takes `NAME`."
    )
    links: LinksConfig | None = Field(default=None, description="Tunnels.")
    relay: bool = Field(default=False, description="Devices of the relay are ports.")
    data_plane: DataPlane = Field(default="auto", description="`auto`: `kernel` (eBPF), else `raw` (AF_PACKET).")
    table_max: int = Field(
        default=ENTRIES_DEFAULT,
        ge=1,
        le=TABLE_MAX,
        description="Entries in the kernel, 16 bytes each and on every processor; others are in the process.",
    )
    revocations: Directory | None = Field(
        default=None, description="Revocations to spread, read at the start and on SIGHUP."
    )
    state: StateFolder = None
    metrics: Metrics | None = Field(default=None, description="Prometheus text and probes.")
    audit: AuditFolder = None
    token_folders: TokenFolders = ()
    hello_s: float = Field(default=NEIGHBOUR.refresh_s, ge=0.01, le=60.0, description="Seconds between hellos.")
    dead_s: float = Field(
        default=NEIGHBOUR.lease_s,
        ge=0.02,
        le=600.0,
        description="Silence that ends a neighbour without keepalives; at least twice `hello_s`.",
    )
    lease_s: LeaseSeconds = Field(
        default=ADVERTISEMENT.lease_s, description="Lease of its watches, seconds; renewed after a quarter."
    )
    keepalive_ms: KeepaliveMs | None = Field(
        default=None, description="0: none. `null`: 70, or 500 with `scapy`. The slower end decides."
    )
    detect_multiplier: DetectMultiplier = Field(
        default=DETECT_MULTIPLIER, description="Missed keepalives after which the other end gives up."
    )
    journal: JournalMib = None
    control_socket: ControlSocket = None
    sandbox: Sandbox = True

    @property
    def keepalive_or_default_ms(self) -> int:
        """Return the milliseconds between keepalives, which depend on the data plane where they are not set."""
        if self.keepalive_ms is not None:
            return self.keepalive_ms
        return SCAPY_KEEPALIVE_MS if self.data_plane == "scapy" else KEEPALIVE_MS

    def timing_of(self, port: PortConfig) -> Timing:
        """Return the keepalive settings of a port."""
        every_ms = self.keepalive_or_default_ms if port.keepalive_ms is None else port.keepalive_ms
        return Timing(every_ms, every_ms, port.detect_multiplier or self.detect_multiplier)

    @classmethod
    def load(cls, path: Path) -> SwitchConfig:
        """Read ``switch.yaml``, or the section ``switch`` of ``machine.yaml``."""
        return load(cls, path, section="switch")

    def with_ifaces(self, ifaces: Iterable[str]) -> SwitchConfig:
        """Return this configuration with a port of default cost for each device that has no port."""
        known = {port.iface for port in self.ports}
        added = tuple(PortConfig(iface=iface) for iface in dict.fromkeys(ifaces) if iface not in known)
        return self.model_copy(update={"ports": self.ports + added})

    def only_ifaces(self, ifaces: Iterable[str]) -> SwitchConfig:
        """Return this configuration with these ports alone, each as it is here if it is."""
        known = {port.iface: port for port in self.ports}
        ports = tuple(known.get(iface, PortConfig(iface=iface)) for iface in dict.fromkeys(ifaces))
        return self.model_copy(update={"ports": ports})

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
        hello_s = getattr(info, "data", {}).get("hello_s", NEIGHBOUR.refresh_s)
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
    """Upper bounds on what one RIB does for others."""

    names_per_sender: int = Field(
        default=RIB_NAMES_PER_SENDER, ge=1, description="Names of one switch, or one RIB below."
    )
    watches: int = Field(default=RIB_WATCHES_MAX, ge=1, description="Watches at once.")
    lease_max_s: float = Field(
        default=LEASE_MAX_S, ge=LEASE_MIN_S, le=LEASE_MAX_S, description="Longest lease accepted, in seconds."
    )


class ClusterConfig(Section):
    """A Valkey or Redis Cluster."""

    nodes: Annotated[tuple[ServerText, ...], Unique] = Field(
        min_length=1, description="Servers of a Valkey or Redis Cluster for the routes, `host:port`."
    )
    username: str = Field(default="", description="ACL user.")
    password_file: ExistingFile | None = Field(default=None, description="Private file with its password.")
    ca: ExistingFile | None = Field(default=None, description="Their certificate authority, PEM; without it no TLS.")
    cert: ExistingFile | None = Field(default=None, description="Client certificate, PEM.")
    key: ExistingFile | None = Field(default=None, description="Its key, PEM.")

    def password(self) -> str:
        """Return the password in its file; empty: none. Raises ``LocalError``: the file is not private."""
        file = self.password_file
        return "" if file is None else read_private(file).decode("utf-8", "replace").strip()


class SharedStore(Section):
    """A store outside the process, which the RIBs of a domain share."""

    cluster: ClusterConfig = Field(description="A Valkey or Redis Cluster, in place of `peers` and `snapshot`.")


def _as_names(value: object) -> object:
    """Read one name, or ``null`` for none, as a tuple."""
    if value is None or isinstance(value, str):
        return () if value is None else (value,)
    return tuple(value) if isinstance(value, list) else value


class RibConfig(Section):
    """``rib.yaml``."""

    identity: Identity
    domain: Domain = Field(description="The trust domain, and the others whose members are believed.")
    iface: Ifname = Field(description="Device towards its switch: a name of `attach`, or a NIC.")
    upper: Annotated[tuple[RequiredName, ...], Unique, BeforeValidator(_as_names)] = Field(
        default=(), description="RIBs above, the next tier first; the first that answers is used."
    )
    peers: Annotated[tuple[RequiredName, ...], Unique] = Field(
        default=(), description="Other RIBs of this domain, with the same routes."
    )
    allow_unowned: bool = Field(default=False, description="Any member may advertise names without an owner.")
    lease_s: LeaseSeconds = Field(
        default=ADVERTISEMENT.lease_s, description="Lease of its advertisement, seconds; renewed after a third."
    )
    store: Literal["memory"] | SharedStore = Field(default="memory", description="Where routes are kept.")
    snapshot: NewFile | None = Field(
        default=None, description="SQLite file for a warm restart; a broken one becomes `FILE.broken`."
    )
    data_plane: UplinkPlane = Field(default="raw", description="`scapy` is slow, for learning.")
    state: StateFolder = None
    quotas: Quotas = Field(default=Quotas(), description="Bounds on what the RIB does for others.")
    metrics: Metrics | None = Field(default=None, description="Prometheus text and probes.")
    audit: AuditFolder = None
    token_folders: TokenFolders = ()
    journal: JournalMib = None
    control_socket: ControlSocket = None
    sandbox: Sandbox = True

    @model_validator(mode="after")
    def _a_shared_store_needs_no_copies(self) -> RibConfig:
        if self.store != "memory" and (self.peers or self.snapshot is not None):
            raise ValueError("store: a cluster replicates and keeps by itself: leave out peers and snapshot")
        return self

    @classmethod
    def load(cls, path: Path) -> RibConfig:
        """Read ``rib.yaml``, or the section ``rib`` of ``machine.yaml``."""
        return load(cls, path, section="rib")
