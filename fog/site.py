"""Site: domain and owner of its clusters, the robots that use them, and the provider of the machines.

I/O. ``fog.yaml`` describes it; without this file a self-contained site is created in the state folder::

    state/  site.json                 its id, which devices and runs carry
            domain/ owner/            keys, as of ``gdp lab``
            robot/                    bundle of the robot's side: switch, RIB, proxy; keys of the supervisor's watch
            enrolment/                registry and socket of the enrolment server for machines of this host
            journal.sqlite3  supervisor.*  site.lock
"""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from fog.bootstrap.bundles import RobotDevices, robot_boot
from fog.bootstrap.members import Authority
from fog.host.bundle import install
from fog.latency.config import LatencyConfig
from fog.latency.known import Latencies
from fog.providers.cloud_config import AwsConfig, SkyPilotConfig
from fog.providers.cloud_init import Setup
from fog.software.config import SOFTWARE_PORT, SoftwareConfig, listening_host_port
from fog.topology import AUTOMATIC, AUTOMATIC_REPLICA, Gateway, Topology
from gdp.config.config import LeaseSeconds, SwitchConfig
from gdp.config.schema import Directory, ExistingFile, Ifname, Section, Unique, load, relative
from gdp.crypto.certificates import Role
from gdp.enrolment.domain_files import DomainConfig, DomainFiles
from gdp.enrolment.member_setup import WATCH_IFACE
from gdp.errors import LocalError
from gdp.host_port import split_host_port
from gdp.intervals import ADVERTISEMENT
from gdp.stores.files import ignore_folder, private, read_private, write_all
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.ownership import refuse_foreign_folder

ProviderName = Literal["local", "aws", "skypilot"]

_ID_BYTES: Final = 3
_OWN_DAYS: Final = 3_650.0
_SITE: Final = "site.json"
SCRATCH: Final = "scratch"
_FILE: Final = "fog.yaml"


class EnrolmentConfig(Section):
    """Section ``enrolment:`` of ``fog.yaml``."""

    revoke_misused: bool = Field(
        default=True, description="Revoke and replace a machine whose token was used again with another key."
    )


class SiteConfig(Section):
    """``fog.yaml``."""

    renamed: ClassVar[Mapping[str, str]] = {"papers_days": "credential_days"}

    border: Directory | None = Field(
        default=None, description="What `gdp domain create` made on this host; rented machines need it."
    )
    domain: Directory | None = Field(
        default=None, description="Without `border`: directory of the trust domain with its root key."
    )
    owner: Directory | None = Field(
        default=None, description="Without `border`: directory of the owner of the served names."
    )
    robots: Annotated[tuple[ExistingFile, ...], Unique] = Field(
        default=(), description="`proxy.yaml` of each robot that uses clusters; missing rules are added."
    )
    switch: ExistingFile | None = Field(
        default=None, description="The robot's `switch.yaml`: its `revocations` learn which machines are gone."
    )
    watch: Ifname | None = Field(
        default=None, description="Name of that switch's `attach` for the watch. `null`: a machine that is up serves."
    )
    provider: ProviderName = Field(default="local", description="Where machines come from.")
    aws: AwsConfig = Field(default=AwsConfig(), description="Provider `aws`.")
    skypilot: SkyPilotConfig = Field(default=SkyPilotConfig(), description="Provider `skypilot`.")
    machine_iface: Ifname | None = Field(
        default=None, description="`local`: a machine's device towards the overlay. `null`: eth0."
    )
    uplink: Ifname | None = Field(
        default=None, description="`local`: the robot's end of the link to the gateway. `null`: `fog<site>-up`."
    )
    topology: Topology = Field(
        default=AUTOMATIC, description="`local`: tree of gateways, or `replica`: one of the machines is the gateway."
    )
    state: Annotated[Path, AfterValidator(relative)] | None = Field(
        default=None, description="Folder of journal, lock and logs. `null`: $FOG_STATE, else ~/.local/state/gdp-fog."
    )
    credential_days: float = Field(default=7.0, gt=0, le=3_650, description="Days for which a machine's keys hold.")
    lease_s: LeaseSeconds = Field(
        default=ADVERTISEMENT.lease_s, description="Lease of the machines' advertisements, in seconds."
    )
    enrolment: EnrolmentConfig = Field(default=EnrolmentConfig(), description="Enrolment of machines.")
    software: SoftwareConfig = Field(
        default=SoftwareConfig(), description="What rented machines fetch from the supervisor."
    )
    idle_s: float | None = Field(default=None, gt=0, description="Idle limit of clusters that state none, in seconds.")
    budget_usd: float | None = Field(default=None, gt=0, description="Budget of clusters that state none.")
    latency_ms: Mapping[str, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict, description="Region: round trip from the robot in ms, in place of a measurement."
    )
    latency: LatencyConfig = Field(default=LatencyConfig(), description="How round trips are measured.")

    @property
    def device(self) -> str:
        """Return a machine's device towards the overlay."""
        return self.machine_iface or "eth0"

    @property
    def software_address(self) -> str:
        """Return where a rented machine fetches its software, ``HOST:PORT``; empty: machines run on this host.

        Raises:
            ConfigError: ``domain.yaml`` of the border is not valid.
        """
        if self.software.address is not None or self.provider == "local" or self.border is None:
            return self.software.address or ""
        server = DomainFiles.load(self.border).config.servers[0]
        return f"{server.rpartition(':')[0]}:{SOFTWARE_PORT}"

    @property
    def _setup(self) -> Setup | None:
        return {"aws": self.aws.setup, "skypilot": self.skypilot.setup}.get(self.provider)

    @model_validator(mode="after")
    def _is_one_domain(self) -> SiteConfig:
        """Reject a site without a domain, or with two."""
        stated = [key for key in ("domain", "owner", "switch", "watch") if getattr(self, key) is not None]
        if self.border is not None and stated:
            raise ValueError(f"{', '.join(stated)}: those of the border are used: remove them, or remove border")
        if self.border is None and (self.domain is None or self.owner is None):
            raise ValueError("name domain and owner, or border: the directory that gdp domain create made on this host")
        return self

    @model_validator(mode="after")
    def _can_join(self) -> SiteConfig:
        """Reject a machine that cannot reach the robot: it would cost money and never serve."""
        if self.provider == "local" and self.border is not None:
            raise ValueError("machines of local enrol on this host: name domain and owner instead of border")
        if self.provider != "local" and self.border is None:
            raise ValueError(
                f"machines of {self.provider} have no way to the robot: run gdp domain create on this host, and name in"
                " border the directory that it makes"
            )
        return self

    @model_validator(mode="after")
    def _has_something_to_install(self) -> SiteConfig:
        """Reject a machine that installs nothing: it would cost money and never serve."""
        has_image = bool(self.aws.images) if self.provider == "aws" else False
        installs = self.software.wheels is not None or has_image
        if self._setup is not None and not self._setup.has_requirements and not installs:
            raise ValueError(
                f"machines of {self.provider} have nothing to install: fill a folder with `fog wheels` and name it in"
                " software.wheels, or name the wheels of this package and of the nodes, each with its hash, in"
                f" {self.provider}.setup.requirements or requirements_file"
            )
        return self

    @model_validator(mode="after")
    def _gateways_can_be_made(self) -> SiteConfig:
        if self.provider != "local" and self.topology != AUTOMATIC:
            raise ValueError(
                f"topology is for the provider local: {self.provider} makes no gateways, its machines reach the robot"
                " through their tunnels; remove topology"
            )
        return self

    @classmethod
    def load(cls, path: Path) -> SiteConfig:
        """Read ``fog.yaml``. Raises ``ConfigError``: all errors of the file, each with line and column."""
        return load(cls, path)


NO_FILE: Final = SiteConfig.model_construct()  # settings of a self-contained site: the defaults


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Site for the commands and the supervisor.

    Args:
        id: six hex digits.
        file: its ``fog.yaml``; None: self-contained.
        config: the content of the file.
        topology: the tree of gateways in use.
        revocations: folder, and the switch's file that names it; None: revocations are not published.
        watch: directory of keys, and device; None: only the provider reports on machines.
        border: what ``gdp domain create`` made, whose domain rented machines join; None: machines run on this host.
    """

    id: str
    state: Path
    file: Path | None
    authority: Authority
    robots: tuple[Path, ...]
    revocations: tuple[Path, Path] | None
    watch: tuple[Path, str] | None
    uplink: str
    devices: RobotDevices | None = None
    config: SiteConfig = NO_FILE
    topology: Gateway = AUTOMATIC
    border: Path | None = None

    @property
    def software_listens(self) -> tuple[str, int]:
        """Return host and port on which the supervisor serves software; an empty host: every address."""
        if self.config.software.listen is not None:
            return listening_host_port(self.config.software.listen)
        return "", split_host_port(self.config.software_address)[1]

    @property
    def enrolment_socket(self) -> Path:
        """Return the socket of the enrolment server for machines of this host."""
        return self.state / "enrolment" / "socket"

    @property
    def domain_files(self) -> DomainFiles:
        """Return the files of the domain that machines join: the border's, or those of a server for this host.

        Raises:
            ConfigError, LocalError: there is no border's domain, or a folder cannot be made.
        """
        if self.border is not None:
            return DomainFiles.load(self.border)
        folder = self.enrolment_socket.parent
        write_all(folder, {})
        config = DomainConfig.model_construct(  # its paths were checked as those of the site
            domain=self.authority.domain,
            owner=self.authority.owner,
            switch=None,
            state=folder,
            peers=folder,
            revocations=folder / "revocations" if self.revocations is None else self.revocations[0],
            listen=0,
            servers=(f"unix:{self.enrolment_socket}",),
            member_days=self.config.credential_days,
        )
        return DomainFiles(directory=folder, config=config)

    @property
    def latencies(self) -> Latencies:
        """Return the known latencies of regions."""
        latency = self.config.latency
        latency = latency.for_aws() if self.config.provider == "aws" else latency
        return Latencies(self.state, latency, self.config.latency_ms)

    @property
    def robot(self) -> Path | None:
        """Return the folder of the robot's side; None: the site is not self-contained."""
        return None if self.file is not None else self.state / "robot"

    @property
    def journal(self) -> Path:
        """Return the path of the journal."""
        return self.state / "journal.sqlite3"

    @contextmanager
    def locked(self, what: str = "site") -> Iterator[None]:
        """Hold an exclusive lock of the site; other processes wait."""
        with (self.state / f"{what}.lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def state_folder() -> Path:
    """Return the default state folder."""
    if given := os.environ.get("FOG_STATE"):
        return Path(given).expanduser().absolute()
    base = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(base).expanduser() / "gdp-fog"


def open_site(file: Path | None, state: Path | None = None) -> Site:
    """Return the site of a file or of ``./fog.yaml``; otherwise the self-contained site, created if needed.

    Raises:
        ConfigError, LocalError: the file, the keys or the folders are invalid.
    """
    file, config, folder = _stands_where(file, state)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        refuse_foreign_folder(folder, "its keys admit machines and let them serve")
    except OSError as error:
        raise LocalError(f"{folder}: {error.strerror}") from error
    with (folder / "site.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        identifier, is_replica = _identifier(folder)
        (folder / SCRATCH).mkdir(mode=0o700, exist_ok=True)
        if config is None or file is None:
            own = _own(folder, identifier)
            return with_gateway(own, is_replica=is_replica)
        return _stated(config, file.absolute(), folder, identifier)


@contextmanager
def peek_site(file: Path | None, state: Path | None = None) -> Iterator[Site]:
    """Yield the same site read-only: no file or key is created. A site that does not exist yet is empty."""
    file, config, folder = _stands_where(file, state)
    if (folder / _SITE).exists():
        yield open_site(file, state)
        return
    with tempfile.TemporaryDirectory(prefix="gdp-fog-") as empty:
        authority = Authority(folder / "domain", folder / "owner")
        yield Site(
            id="000000",
            state=Path(empty),
            file=None if config is None else file,
            authority=authority,
            robots=(),
            revocations=None,
            watch=None,
            uplink="",
            config=NO_FILE if config is None else config,
            topology=AUTOMATIC if config is None else config.topology,
        )


def _stands_where(file: Path | None, state: Path | None) -> tuple[Path | None, SiteConfig | None, Path]:
    """Return the site's file, its configuration, and its folder."""
    if file is None and state is None and Path(_FILE).is_file():
        file = Path(_FILE)
    config = SiteConfig.load(file) if file is not None else None
    return file, config, (state or (config.state if config is not None else None) or state_folder()).absolute()


def with_gateway(site: Site, *, is_replica: bool) -> Site:
    """Return a self-contained site with another kind of gateway; ``save_topology`` stores it.

    Raises:
        LocalError: the site has a ``fog.yaml``.
    """
    if site.file is not None:
        raise LocalError(f"{site.file} states the site: set 'topology' there instead of --gateway")
    return replace(site, topology=AUTOMATIC_REPLICA if is_replica else AUTOMATIC)


def topology_now(site: Site) -> Gateway:
    """Return a site's topology of the last launch. Raises ``LocalError``: the site's file cannot be read."""
    if site.file is not None:
        return site.topology
    return AUTOMATIC_REPLICA if _identifier(site.state)[1] else AUTOMATIC


def save_topology(site: Site) -> None:
    """Store the topology of a self-contained site for later commands; other sites have it in their file."""
    if site.file is None:
        with site.locked():
            said = {"id": site.id, "replica_gateway": site.topology.replica}
            write_all(site.state, {_SITE: private(json.dumps(said).encode())}, force=True)


def _identifier(folder: Path) -> tuple[str, bool]:
    """Return a site's id, and whether the gateway of a self-contained site is a replica."""
    path = folder / _SITE
    if not path.exists():
        write_all(folder, {_SITE: private(json.dumps({"id": secrets.token_hex(_ID_BYTES)}).encode())})
        ignore_folder(folder)
    try:
        said = json.loads(read_private(path))
        return str(said["id"]), bool(said.get("replica_gateway", False))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise LocalError(f"{path}: not what fog wrote; with no cluster left, the folder may be deleted") from error


def _own(folder: Path, identifier: str) -> Site:
    authority = Authority(folder / "domain", folder / "owner", folder / SCRATCH)
    name = f"fog{identifier}"
    devices = RobotDevices(f"{name}-up", f"{name}p", f"{name}r", f"{name}w")
    if not authority.domain.exists():
        make_domain(authority.domain, name)
    if not authority.owner.exists():
        make_owner(authority.owner, is_salted=True)
    robot = folder / "robot"
    if not (robot / "boot.json").exists():  # this file is written last
        _install_again(robot, authority, devices)
    return Site(
        id=identifier,
        state=folder,
        file=None,
        authority=authority,
        robots=(robot / "proxy.yaml",),
        revocations=(robot / "revocations", robot / "switch.yaml"),
        watch=(robot / "watch", devices.watch),
        uplink=devices.uplink,
        devices=devices,
    )


def _install_again(robot: Path, authority: Authority, devices: RobotDevices) -> None:
    """Write the files of the robot's side, and overwrite those of an interrupted attempt."""
    shutil.rmtree(robot, ignore_errors=True)
    for folder in ("proxy/delegations", "watch/delegations", "revocations"):
        (robot / folder).mkdir(mode=0o700, parents=True)
    install(robot, robot_boot(authority, devices, days=_OWN_DAYS))


def _stated(config: SiteConfig, file: Path, folder: Path, identifier: str) -> Site:
    places = _places(config)
    authority = Authority(places.domain.absolute(), places.owner.absolute(), folder / SCRATCH)
    revocations = None
    if places.switch is not None:
        directory = SwitchConfig.load(places.switch).revocations
        revocations = None if directory is None else (directory.absolute(), places.switch.absolute())
    watch = None
    if places.watch is not None:
        keys = folder / "watch"
        if not (keys / "node.card").exists():
            make_node(keys, Role.PROXY, "supervisor", authority.domain, force=True)
        (keys / "delegations").mkdir(mode=0o700, exist_ok=True)
        watch = (keys, places.watch)
    return Site(
        id=identifier,
        state=folder,
        file=file,
        authority=authority,
        robots=tuple(path.absolute() for path in places.robots),
        revocations=revocations,
        watch=watch,
        uplink=config.uplink or f"fog{identifier}-up",
        border=None if config.border is None else config.border.absolute(),
        config=config,
        topology=config.topology,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Places:
    """Files of a site's domain and robots."""

    domain: Path
    owner: Path
    robots: tuple[Path, ...]
    switch: Path | None
    watch: str | None


def _places(config: SiteConfig) -> _Places:
    """Return the places that the file names, or those of its border; its proxy is the robot, unless robots are named.

    Raises:
        ConfigError: a file of the border is not valid.
    """
    if config.domain is not None and config.owner is not None:
        return _Places(
            domain=config.domain, owner=config.owner, robots=config.robots, switch=config.switch, watch=config.watch
        )
    if config.border is None:
        raise LocalError("the site has no domain")
    files, switch = DomainFiles.load(config.border).config, config.border / "switch.yaml"
    proxy = config.border / "proxy.yaml"
    return _Places(
        domain=files.domain,
        owner=files.owner,
        robots=config.robots or ((proxy,) if proxy.exists() else ()),
        switch=switch,
        watch=WATCH_IFACE if WATCH_IFACE in SwitchConfig.load(switch).attach else None,
    )
