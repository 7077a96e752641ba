"""Provider of machines on any cloud of SkyPilot: each machine is a SkyPilot cluster of one node.

I/O; queries SkyPilot's API server through the package of PyPI, and starts the server if there is none.
Source: SkyPilot 0.14 (docs.skypilot.co, "Python SDK"); prices are from its catalogue, which it loads on first use.

SkyPilot stores its own records at the API server; the labels of a machine contain the rest. SkyPilot gives no notice
before a preemption: the RIB detects it first, and ``describe`` at the next poll.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from types import ModuleType
from typing import Final

from fog.hardware import Hardware, Offer
from fog.host.bundle import pack
from fog.machine import Machine, MachineBundle, MachineSpec
from fog.providers.cloud_config import SkyPilotConfig
from fog.providers.cloud_init import lines_of, shell_script
from fog.site import Site
from gdp.errors import LocalError, StoreError
from gdp.extras import install_command
from gdp.intervals import HOUR_S
from gdp_extensions.skypilot.record import being_made, cluster_name, labels_of, machine_of

_SERVICE: Final = "fog-machine"
_WRONG: Final = (  # names in sky.exceptions of permanent errors
    "NoCloudAccessError",
    "CloudUserIdentityError",
    "InvalidCloudConfigs",
    "InvalidCloudCredentials",
    "InvalidSkyPilotConfigError",
    "NotSupportedError",
    "PermissionDeniedError",
    "ClusterDoesNotExist",
)


class SkyPilotProvider:
    """Provider ``skypilot``; a region is one of ``places``, an id is SkyPilot's cluster name.

    Raises:
        LocalError: SkyPilot is not installed.
    """

    name: str = "skypilot"
    poll_s: float = 30.0  # each poll queries the cloud

    def __init__(self, config: SkyPilotConfig | None = None, sky: ModuleType | None = None) -> None:
        self._config = config or SkyPilotConfig()
        try:
            self._sky = sky or import_module("sky")
        except ModuleNotFoundError as missing:
            raise LocalError(f"provider skypilot needs SkyPilot: {install_command('skypilot')}") from missing
        if sky is None:  # this process is a client; in a server SkyPilot prints progress as lines of a protocol
            import_module("sky.utils.annotations").client_api(lambda: None)()

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        """Return the best fits in each place by SkyPilot's catalogue: a few types, not all."""
        lines = []
        for place in self._config.places:
            with self._asking(f"prices of {place}"):
                wanted = self._sky.Resources(infra=place, use_spot=spot, **_resources(hardware))
                found = wanted.cloud.get_feasible_launchable_resources(wanted, num_nodes=1)
                for each in found.resources_list:
                    cpus, memory_gib = each.cloud.get_vcpus_mem_from_instance_type(each.instance_type)
                    has = Hardware(int(cpus or 0), float(memory_gib or 0.0), hardware.gpu, hardware.gpus)
                    usd = float(each.get_cost(HOUR_S))
                    lines.append(Offer(self.name, place, each.instance_type, has, is_spot=spot, usd_per_hour=usd))
        return sorted(lines, key=lambda each: each.usd_per_hour)

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        """Request a machine. Missing capacity is detected later: ``describe`` then omits the machine."""
        name = cluster_name(spec)
        with self._asking(f"create {name}"):
            self._sky.launch(self._task(spec, boot), cluster_name=name)
        return name

    def dry_run(self, spec: MachineSpec, boot: MachineBundle) -> None:
        """Run all checks of SkyPilot that need no request to a cloud.

        Raises:
            StoreError, LocalError: as ``create``; also if no cloud has the type.
        """
        name = cluster_name(spec)
        with self._asking(f"dry run of {name}"):
            self._sky.get(self._sky.launch(self._task(spec, boot), cluster_name=name, dryrun=True))

    def describe(self, cluster: str) -> list[Machine]:
        """Return the machines that SkyPilot has recorded or is creating; spot machines are checked in the cloud.

        Raises:
            StoreError: the API server cannot be reached now.
            LocalError: the labels of a machine were changed.
        """
        with self._asking(f"machines of {cluster}"):
            statuses = self._sky.get(self._sky.status(refresh=self._sky.StatusRefreshMode.AUTO))
            requests = self._sky.api_status()  # unfinished requests
        found = [machine for each in statuses if (machine := machine_of(each, cluster))]
        return found + being_made(requests, cluster, [each.id for each in found])

    def terminate(self, ids: Sequence[str]) -> None:
        """Terminate machines in parallel; a launch in progress is cancelled.

        Raises:
            StoreError: the API server or a cloud cannot be reached now; machines may remain.
        """
        with self._asking(f"terminate {', '.join(ids)}"):
            requests = [self._sky.down(name) for name in ids]
            for request in requests:
                with suppress(self._sky.exceptions.ClusterDoesNotExist):  # already gone
                    self._sky.get(request)

    def drain(self, machine: str) -> None:
        """Drain the machine by a SkyPilot job."""
        with self._asking(f"drain {machine}"):
            task = self._sky.Task("drain", run=f"sudo systemctl kill --kill-who=main --signal=USR1 {_SERVICE}")
            self._sky.get(self._sky.exec(task, cluster_name=machine))

    def log(self, machine: str, program: str, lines: int) -> str:
        """Return the last lines of a program in the machine's journal."""
        with self._asking(f"log of {machine}"):
            printed = self._sky.tail_logs(machine, None, follow=False, preload_content=False)
            return lines_of((line for line in printed if line), program, lines)

    def shell(self, machine: str) -> list[str]:
        """Return an ssh command line; SkyPilot writes its configuration to ``~/.ssh`` of the launching user."""
        return ["ssh", machine]

    def close(self) -> None:
        """Do nothing; the API server continues."""

    def _task(self, spec: MachineSpec, boot: MachineBundle) -> object:
        offer = spec.offer
        resources = self._sky.Resources(
            infra=offer.region,
            instance_type=offer.type_name or None,
            use_spot=offer.is_spot,
            disk_size=self._config.disk_gib,
            labels=labels_of(spec),
            **({"accelerators": _accelerators(offer.hardware)} if offer.hardware.gpu else {}),
        )
        setup = shell_script(pack(boot), self._config.setup)
        # makes SkyPilot's job log equal to the machine's log
        run = f"sudo journalctl --follow --unit {_SERVICE} --unit 'fog-log@*'"
        return self._sky.Task(spec.name, setup=setup, run=run, resources=resources)

    @contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        """Translate exceptions of SkyPilot: temporary errors to ``StoreError``, permanent ones to ``LocalError``."""
        known = self._sky.exceptions
        named = (getattr(known, each) for each in _WRONG if hasattr(known, each))
        wrong: tuple[type[Exception], ...] = (ValueError, TypeError, *named)
        try:
            yield
        except (LocalError, StoreError):
            raise
        except wrong as error:
            raise LocalError(f"skypilot: {what}: {error}") from error
        except Exception as error:  # SkyPilot has no base class of errors, and forwards those of its clouds
            raise StoreError(f"skypilot: {what}: {type(error).__name__}: {error}") from error


def _resources(hardware: Hardware) -> dict[str, str]:
    wanted = {"cpus": f"{hardware.cpus}+"} if hardware.cpus else {}
    if hardware.memory_gib:
        wanted["memory"] = f"{hardware.memory_gib:g}+"
    if hardware.gpu:
        wanted["accelerators"] = _accelerators(hardware)
    return wanted


def _accelerators(hardware: Hardware) -> str:
    return f"{hardware.gpu}:{hardware.gpus}"


def open_skypilot(site: Site) -> SkyPilotProvider:
    """Return the provider of a site."""
    return SkyPilotProvider(site.config.skypilot)
