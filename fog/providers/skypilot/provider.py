"""Machines of any cloud that SkyPilot knows: each is a SkyPilot cluster of one node.

I/O; asks SkyPilot's API server, which it starts where there is none, through the package of PyPI.
Source: SkyPilot 0.14 (docs.skypilot.co, "Python SDK"); prices are its catalogue's, which it loads when first asked.

SkyPilot keeps its own records beside the API server; the labels of a machine say the rest. It gives no notice before
a spot machine is taken: that it was, ``describe`` sees at the next look, and the RIB before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from types import ModuleType
from typing import Final

from fog.hardware import Hardware
from fog.host.bundle import pack
from fog.machine import Machine, MachineBundle, MachineSpec
from fog.offer import Offer
from fog.providers.cloud_init import lines_of, shell_script
from fog.providers.skypilot.config import SkyPilotConfig
from fog.providers.skypilot.record import being_made, cluster_name, labels_of, machine_of
from gdp.errors import LocalError, StoreError

__all__ = ["SkyPilotProvider"]

_SERVICE: Final = "fog-machine"
_WRONG: Final = (  # names in sky.exceptions of what asking again does not mend
    "NoCloudAccessError",
    "CloudUserIdentityError",
    "InvalidCloudConfigs",
    "InvalidCloudCredentials",
    "InvalidSkyPilotConfigError",
    "NotSupportedError",
    "PermissionDeniedError",
    "ClusterDoesNotExist",
)
HOUR_S: Final = 3600


class SkyPilotProvider:
    """Provider ``skypilot``; a region is one of ``places``, an id SkyPilot's name of the cluster.

    Raises:
        LocalError: SkyPilot is not installed.
    """

    name: str = "skypilot"
    poll_s: float = 30.0  # it asks the cloud each time

    def __init__(self, config: SkyPilotConfig | None = None, sky: ModuleType | None = None) -> None:
        self._config = config or SkyPilotConfig()
        try:
            self._sky = sky or import_module("sky")
        except ModuleNotFoundError as missing:
            raise LocalError("provider skypilot needs SkyPilot: pip install 'gdp-ros[skypilot]'") from missing

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        """Return what fits best in each place, by SkyPilot's catalogue: few types, not all that fit.

        Raises:
            StoreError: the catalogue is not here and cannot be loaded now.
            LocalError: a place is unknown to SkyPilot.
        """
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
        """Ask for a machine. That there is none to be had is not known yet: it then is not described any more.

        Raises:
            StoreError: the API server cannot be asked now.
            LocalError: credentials, place or type are wrong, as far as SkyPilot sees before it tries.
        """
        name = cluster_name(spec)
        with self._asking(f"create {name}"):
            self._sky.launch(self._task(spec, boot), cluster_name=name)
        return name

    def dry_run(self, spec: MachineSpec, boot: MachineBundle) -> None:
        """Let SkyPilot check all that it checks before it asks a cloud.

        Raises:
            StoreError, LocalError: as ``create``; also that no cloud has it.
        """
        name = cluster_name(spec)
        with self._asking(f"dry run of {name}"):
            self._sky.get(self._sky.launch(self._task(spec, boot), cluster_name=name, dryrun=True))

    def describe(self, cluster: str) -> list[Machine]:
        """Return the machines that SkyPilot has a record of or makes now; spot machines are looked after in the cloud.

        Raises:
            StoreError: the API server cannot be asked now.
            LocalError: somebody changed a machine's labels.
        """
        with self._asking(f"machines of {cluster}"):
            told = self._sky.get(self._sky.status(refresh=self._sky.StatusRefreshMode.AUTO))
            requests = self._sky.api_status()  # those that are not finished
        found = [machine for each in told if (machine := machine_of(each, cluster))]
        return found + being_made(requests, cluster, [each.id for each in found])

    def terminate(self, ids: Sequence[str]) -> None:
        """Take machines down, all at once; a launch that is under way is ended too.

        Raises:
            StoreError: the API server or a cloud cannot be asked now; machines may be left.
        """
        with self._asking(f"terminate {', '.join(ids)}"):
            requests = [self._sky.down(name) for name in ids]
            for request in requests:
                with suppress(self._sky.exceptions.ClusterDoesNotExist):  # it is gone already
                    self._sky.get(request)

    def drain(self, machine: str) -> None:
        """Have the machine drained by a job of SkyPilot's on it.

        Raises:
            StoreError: it cannot be reached now.
            LocalError: there is no such machine.
        """
        with self._asking(f"drain {machine}"):
            task = self._sky.Task("drain", run=f"sudo systemctl kill --kill-who=main --signal=USR1 {_SERVICE}")
            self._sky.get(self._sky.exec(task, cluster_name=machine))

    def log(self, machine: str, program: str, lines: int) -> str:
        """Return the last lines of a program in the machine's journal.

        Raises:
            StoreError: it cannot be reached now.
            LocalError: there is no such machine.
        """
        with self._asking(f"log of {machine}"):
            told = self._sky.tail_logs(machine, None, follow=False, preload_content=False)
            return lines_of((line for line in told if line), program, lines)

    def shell(self, machine: str) -> list[str]:
        """Return an ssh command line; SkyPilot writes what it needs into ``~/.ssh`` of who launched."""
        return ["ssh", machine]

    def close(self) -> None:
        """Nothing is held; the API server goes on."""

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
        # so that SkyPilot's log of the job is the machine's
        run = f"sudo journalctl --follow --unit {_SERVICE} --unit 'fog-log@*'"
        return self._sky.Task(spec.name, setup=setup, run=run, resources=resources)

    @contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        """Translate what SkyPilot raises: its exceptions tell apart what may be mended by asking again."""
        known = self._sky.exceptions
        named = (getattr(known, each) for each in _WRONG if hasattr(known, each))
        wrong: tuple[type[Exception], ...] = (ValueError, TypeError, *named)
        try:
            yield
        except (LocalError, StoreError):
            raise
        except wrong as error:
            raise LocalError(f"skypilot: {what}: {error}") from error
        except Exception as error:  # SkyPilot has no root of its errors, and passes on those of its clouds
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
