"""Protocol between the supervisor and providers of machines.

Sans-I/O: interfaces only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from fog.hardware import Hardware, Offer
from fog.machine import Machine, MachineBundle, MachineSpec


class Provider(Protocol):
    """Provider of machines. All calls may block; none keeps state that a restart would lose.

    A call raises ``StoreError`` if the provider cannot be reached now, and ``LocalError`` if it refuses.

    Attributes:
        name: as in offers and in ``fog.yaml``.
        poll_s: useful interval between calls of ``describe``.
    """

    name: str
    poll_s: float

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        """Return the offers with enough hardware, cheapest first."""
        ...

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        """Request a machine; return its id as soon as the provider has accepted the request.

        Raises:
            StoreError: no capacity now; try again, or elsewhere.
            LocalError: the request can never succeed: wrong credentials, quota, region.
        """
        ...

    def describe(self, cluster: str) -> list[Machine]:
        """Return all machines of a cluster in any state, also those that the journal does not contain.

        A machine that ended is reported as ``GONE`` for a while, or not at all.
        """
        ...

    def terminate(self, ids: Sequence[str]) -> None:
        """Terminate machines; machines that are gone already are ignored."""
        ...

    def drain(self, machine: str) -> None:
        """Let a machine's programs finish calls in progress and accept no new ones."""
        ...

    def log(self, machine: str, program: str, lines: int) -> str:
        """Return the last lines that a program of a machine wrote."""
        ...

    def shell(self, machine: str) -> list[str]:
        """Return the command line that opens a shell on a machine."""
        ...

    def close(self) -> None:
        """Release the adapter's resources; machines continue."""
        ...


@runtime_checkable
class AccountProvider(Protocol):
    """Provider whose machines need something that outlives them in the user's account, such as a firewall's rules."""

    def clear_account(self) -> None:
        """Remove what this provider made in the account, unless machines of another site use it.

        Raises:
            StoreError: the account cannot be reached now, or something is in use by machines that end; try again.
        """
        ...


@runtime_checkable
class GatewayProvider(Protocol):
    """Provider whose machines can be the gateway of their group: FogROS2-FT, Figure 4, right.

    A machine that is the gateway has one additional device, towards the robot. Any machine of the group can receive it
    at any time, and two machines may have one at once.

    Attributes:
        uplink_iface: name of that device in the configuration of the machine's switch.
    """

    uplink_iface: str

    def replica_gateway(self, region: str) -> str:
        """Return the label of the replica gateway of a region's machines; empty: their gateway is dedicated."""
        ...

    def attach_uplink(self, machine: str) -> None:
        """Make a machine the gateway; no effect if it is.

        Raises:
            LocalError: the machine does not exist, or its gateway is dedicated.
        """
        ...

    def detach_uplink(self, machine: str) -> None:
        """End a machine's role as gateway; no effect if it is not the gateway, or is gone."""
        ...
