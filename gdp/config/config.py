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
    Directory,
    Domain,
    ExistingFile,
    Ifname,
    Metrics,
    NewFile,
    RequiredName,
    Section,
    Unique,
    load,
)
from gdp.control.endpoint_record import UPLINKS_MAX
from gdp.control.endpoints import Endpoint
from gdp.control.hello import INTERVAL_MAX_MS, Timing
from gdp.control.link_cost import COST_MAX
from gdp.errors import LocalError
from gdp.host_port import checked_host_port, split_host_port
from gdp.limits import (
    ADVERTISEMENT_LEASE_S,
    COST_AUTO,
    COST_DEFAULT,
    DEAD_S,
    DETECT_MULTIPLIER,
    HELLO_S,
    KEEPALIVE_MS,
    LEASE_MAX_S,
    LEASE_MIN_S,
    RELAY_RATE_MAX,
    RELAY_RATE_MIN,
    RIB_NAMES_PER_SENDER,
    RIB_WATCHES_MAX,
    SCAPY_KEEPALIVE_MS,
    TABLE_MAX,
)
from gdp.ports.kernel.abi import ENTRIES_DEFAULT
from gdp.stores.cluster_address import ClusterAddress
from gdp.stores.files import read_private

__all__ = [
    "LISTEN_DEFAULT",
    "DataPlane",
    "LeaseSeconds",
    "LinksConfig",
    "PortConfig",
    "Quotas",
    "RibConfig",
    "SwitchConfig",
    "UplinkPlane",
]


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
    """A layer-2 device towards neighbours; an ``optional`` one may appear later.

    Keepalive settings that are absent here come from the switch. A ``cost`` of ``auto`` is
    ``COST_AUTO``: measured.
    """

    iface: Ifname
    optional: bool = False
    cost: LinkCost = COST_DEFAULT
    keepalive_ms: KeepaliveMs | None = None
    detect_multiplier: DetectMultiplier | None = None


TunnelBackend = Literal["auto", "kernel", "wireguard-go"]


class LinksConfig(Section):
    """Tunnels across IP networks: VXLAN inside WireGuard, one for each peer.

    ``peers`` holds an endpoint record for each peer, in files ``*.endpoints``; files may come and go. ``public`` states
    where this switch can be reached from everywhere: it is a border, and others dial it. A border limits whom it relays
    for to the labels and roles of ``relay_for``, and what it sends into each tunnel to ``relay_rate`` bytes per second.
    """

    listen: int = Field(default=LISTEN_DEFAULT, ge=0, le=65_535)
    public: Annotated[tuple[EndpointText, ...], Unique] = ()
    uplinks: Annotated[tuple[Ifname, ...], Unique] = Field(default=(), max_length=UPLINKS_MAX)
    peers: Directory | None = None
    direct: bool = True
    backend: TunnelBackend = "auto"
    keepalive_s: int = Field(default=25, ge=1, le=65_535)
    relay_for: Annotated[tuple[str, ...], Unique] = ()
    relay_rate: int | None = Field(default=None, ge=RELAY_RATE_MIN, le=RELAY_RATE_MAX)

    def public_endpoints(self) -> tuple[Endpoint, ...]:
        """Return the stated endpoints."""
        return tuple(map(Endpoint.from_text, self.public))


class SwitchConfig(Section):
    """``switch.yaml``.

    For each ``NAME`` of ``attach`` the command makes a veth pair ``NAME``/``NAME-s``; a RIB or proxy on this host uses
    ``NAME`` as its device. The node reads the files in ``revocations`` at start and on SIGHUP. The kernel plane holds
    ``table_max`` entries, and the process forwards by the others.
    """

    identity: Directory
    domain: Domain
    ports: tuple[PortConfig, ...] = ()
    attach: Annotated[tuple[AttachName, ...], Unique] = ()
    links: LinksConfig | None = None
    relay: bool = False
    data_plane: DataPlane = "auto"
    table_max: int = Field(default=ENTRIES_DEFAULT, ge=1, le=TABLE_MAX)
    revocations: Directory | None = None
    state: Directory | None = None
    metrics: Metrics | None = None
    audit: NewFile | None = None
    token_folders: Annotated[tuple[Directory, ...], Unique] = ()
    hello_s: float = Field(default=HELLO_S, ge=0.01, le=60.0)
    dead_s: float = Field(default=DEAD_S, ge=0.02, le=600.0)
    lease_s: LeaseSeconds = ADVERTISEMENT_LEASE_S
    keepalive_ms: KeepaliveMs | None = None
    detect_multiplier: DetectMultiplier = DETECT_MULTIPLIER
    control_socket: NewFile | None = None
    sandbox: bool = True

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
    """Upper bounds on what one RIB does for others."""

    names_per_sender: int = Field(default=RIB_NAMES_PER_SENDER, ge=1)
    watches: int = Field(default=RIB_WATCHES_MAX, ge=1)
    lease_max_s: float = Field(default=LEASE_MAX_S, ge=LEASE_MIN_S, le=LEASE_MAX_S)


class ClusterConfig(Section):
    """A Valkey or Redis Cluster; ``nodes`` are some of its servers, each ``host:port``."""

    nodes: Annotated[tuple[ServerText, ...], Unique] = Field(min_length=1)
    username: str = ""
    password_file: ExistingFile | None = None
    ca: ExistingFile | None = None
    cert: ExistingFile | None = None
    key: ExistingFile | None = None

    def address(self) -> ClusterAddress:
        """Return the address of the cluster; reads the file of the password.

        Raises:
            LocalError: the file of the password is not private.
        """
        file = self.password_file
        password = "" if file is None else read_private(file).decode("utf-8", "replace").strip()
        nodes = tuple(map(split_host_port, self.nodes))
        return ClusterAddress(
            nodes=nodes, username=self.username, password=password, ca=self.ca, cert=self.cert, key=self.key
        )


class SharedStore(Section):
    """A store outside the process, which the RIBs of a domain share."""

    cluster: ClusterConfig


def _as_names(value: object) -> object:
    """Read one name, or ``null`` for none, as a tuple."""
    if value is None or isinstance(value, str):
        return () if value is None else (value,)
    return tuple(value) if isinstance(value, list) else value


class RibConfig(Section):
    """``rib.yaml``.

    ``upper`` names the RIB of the tier above, or several of which the first that answers is used; ``null``: none. Those
    of the tier above that may follow. ``peers`` names other RIBs of this domain, which hold the same routes.
    """

    identity: Directory
    domain: Domain
    iface: Ifname
    upper: Annotated[tuple[RequiredName, ...], Unique, BeforeValidator(_as_names)] = ()
    peers: Annotated[tuple[RequiredName, ...], Unique] = ()
    allow_unowned: bool = False
    lease_s: LeaseSeconds = ADVERTISEMENT_LEASE_S
    store: Literal["memory"] | SharedStore = "memory"
    snapshot: NewFile | None = None
    data_plane: UplinkPlane = "raw"
    state: Directory | None = None
    quotas: Quotas = Quotas()
    metrics: Metrics | None = None
    audit: NewFile | None = None
    token_folders: Annotated[tuple[Directory, ...], Unique] = ()
    control_socket: NewFile | None = None
    sandbox: bool = True

    @model_validator(mode="after")
    def _a_shared_store_needs_no_copies(self) -> RibConfig:
        if self.store != "memory" and (self.peers or self.snapshot is not None):
            raise ValueError("store: a cluster replicates and keeps by itself: leave out peers and snapshot")
        return self

    @classmethod
    def load(cls, path: Path) -> RibConfig:
        """Read ``rib.yaml``, or the section ``rib`` of ``machine.yaml``."""
        return load(cls, path, section="rib")
