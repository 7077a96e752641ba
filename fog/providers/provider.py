"""What the supervisor knows of a provider of machines.

Place: interface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from fog.hardware import Hardware
from fog.machine import Machine, MachineBundle, MachineSpec
from fog.offer import Offer

__all__ = ["GatewayProvider", "Provider"]


class Provider(Protocol):
    """Machines to be had somewhere. All calls may block for a while; none keeps state that a restart would miss.

    Attributes:
        name: as in offers and in ``fog.yaml``.
        poll_s: how often ``describe`` is worth asking.
    """

    name: str
    poll_s: float

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        """Return the price list for what has enough, the cheapest first.

        Raises:
            StoreError: the provider cannot be asked now.
        """
        ...

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        """Ask for a machine; return its id as soon as the provider has taken the request.

        Raises:
            StoreError: there is none to be had now; try again, or elsewhere.
            LocalError: it will never be had this way: wrong credentials, quota, region.
        """
        ...

    def describe(self, cluster: str) -> list[Machine]:
        """Return all machines of a cluster that were not gone before, in any state: also those no journal knows.

        A machine that ended is told as ``GONE`` for a while, or not at all.

        Raises:
            StoreError: the provider cannot be asked now.
        """
        ...

    def terminate(self, ids: Sequence[str]) -> None:
        """Give machines back; what is gone already is fine.

        Raises:
            StoreError: the provider cannot be asked now.
        """
        ...

    def drain(self, machine: str) -> None:
        """Let a machine's programs finish what is under way and take on nothing new."""
        ...

    def log(self, machine: str, program: str, lines: int) -> str:
        """Return the last lines that a program of a machine wrote."""
        ...

    def shell(self, machine: str) -> list[str]:
        """Return the command line that opens a shell on a machine."""
        ...

    def close(self) -> None:
        """Let go of what the provider's adapter holds; machines stay."""
        ...


@runtime_checkable
class GatewayProvider(Protocol):
    """Provider whose machines can be the gateway of their group: FogROS2-FT, Figure 4, right.

    A machine that is the gateway has one device more, towards the robot. Any machine of the group can be given it at
    any time, and two may have theirs at once.

    Attributes:
        uplink_iface: that device, as the machine's switch names it.
    """

    uplink_iface: str

    def replica_gateway(self, region: str) -> str:
        """Return the label of the replica gateway of a region's machines; empty: their gateway is no machine."""
        ...

    def attach_uplink(self, machine: str) -> None:
        """Make a machine the gateway. Fine if it is.

        Raises:
            LocalError: there is no such machine, or its gateway is dedicated.
        """
        ...

    def detach_uplink(self, machine: str) -> None:
        """Let a machine be the gateway no longer. Fine if it is not, or is gone."""
        ...
