"""Machines of a launch description, and extension of the list to the wanted number of replicas.

Sans-I/O.
Source: FogROS2-FT, Listing 1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final

from fog.cluster import MachineRequest
from fog.hardware import Hardware
from gdp.errors import LocalError

REPLICAS: Final = 2


@dataclass(frozen=True, slots=True)
class CloudMachine:
    """Machine that runs until it is released.

    Args:
        region: in the provider's notation; empty: chosen by the supervisor.
        hardware: minimum hardware, such as ``cpu:16``, ``T4``, ``mem:64`` or ``cpu:8,mem:32,gpu:T4:2``.

    Raises:
        LocalError: the hardware is unknown; the text states what is expected.
    """

    is_spot: ClassVar[bool] = False
    region: str = ""
    hardware: str = "cpu:1"
    _read: Hardware = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_read", Hardware.from_text(self.hardware))

    def wanted(self) -> MachineRequest:
        """Return the request for a plan."""
        return MachineRequest(self._read, self.region, self.is_spot)


@dataclass(frozen=True, slots=True)
class SpotMachine(CloudMachine):
    """Cheaper machine that its provider may preempt; another machine then replaces it.

    Args:
        on_demand: while no spot machine is to be had, one on demand takes its place.
    """

    is_spot: ClassVar[bool] = True
    on_demand: bool = False

    def wanted(self) -> MachineRequest:
        """Return the request for a plan."""
        return MachineRequest(self._read, self.region, self.is_spot, self.on_demand)


def filled(
    deployments: Sequence[CloudMachine], replicas: int | None
) -> tuple[tuple[MachineRequest, ...], tuple[str, ...]]:
    """Return the machines of a cluster, and messages about them for the user.

    A list that is too short is extended with copies of its machines in other regions.

    Args:
        replicas: required number; None: the length of the list, and at least ``REPLICAS``.
    """
    for each in deployments:
        if not isinstance(each, CloudMachine):
            raise LocalError(f"deployments: expected CloudMachine or SpotMachine, not {type(each).__name__}")
    if not deployments:
        raise LocalError("deployments is empty: expected at least one CloudMachine or SpotMachine")
    if replicas is not None and replicas < 1:
        raise LocalError(f"replicas={replicas}: expected at least 1")
    if replicas is not None and replicas < len(deployments):
        raise LocalError(f"replicas={replicas}, but {len(deployments)} deployments: leave out what is not wanted")
    wanted = [each.wanted() for each in deployments]
    notes = []
    missing = (replicas or max(REPLICAS, len(wanted))) - len(wanted)
    if missing:
        wanted += [replace(wanted[place % len(deployments)], region="") for place in range(missing)]
        notes.append(
            f"{len(deployments)} of {len(wanted)} replicas are listed: {missing} more like "
            f"{'it' if len(deployments) == 1 else 'them'} in other regions (replicas={len(deployments)}: no more)"
        )
    regions = Counter(each.region for each in wanted if each.region)
    notes += [
        f"{count} replicas are in {region}: they may fail together" for region, count in regions.items() if count > 1
    ]
    return tuple(wanted), tuple(notes)
