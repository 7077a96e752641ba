"""A machine of a cluster: what is asked of a provider, what it is to run, and what the provider says of it.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from enum import Enum

from fog.offer import Offer

__all__ = ["Machine", "MachineBundle", "MachineSpec", "MachineState", "Program"]


class MachineState(Enum):
    """Where a machine is in its life."""

    BOOTING = "booting"  # asked for; its programs may not be up
    RUNNING = "running"  # its programs said that they are ready
    LEAVING = "leaving"  # the provider gave notice, or it is being drained
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class MachineSpec:
    """What a provider is asked for.

    Args:
        cluster: whose it is; providers tag machines with it, so that ``describe`` finds them without a journal.
        name: unique within the cluster and never used again, such as ``m3``.
        offer: which line of the price list: provider, region, type, spot or not.
    """

    cluster: str
    name: str
    offer: Offer


@dataclass(frozen=True, slots=True)
class Program:
    """A process of a machine.

    Args:
        name: of its log, such as ``switch``.
        argv: ``{home}`` in a word stands for the machine's folder, ``{python}`` for its Python.
        ready: what a line of its output contains when it is up; empty: it is up when it runs.
        environment: beside the machine's own; ``{home}`` as in ``argv``.
        restarts: whether it is started again when it ends; else its end ends the machine.
        is_users: it runs the user's code: where the machine has a user for that, as this one, without a capability and
            without a way to the machine's keys.
    """

    name: str
    argv: tuple[str, ...]
    ready: str = ""
    environment: Mapping[str, str] = field(default_factory=dict)
    _: KW_ONLY
    restarts: bool = True
    is_users: bool = False


@dataclass(frozen=True, slots=True)
class MachineBundle:
    """All that a machine needs to become what it is to be.

    Args:
        files: path below the machine's folder -> content. They hold private keys: mode 0600, folders 0700.
        programs: started all at once, the first first; what one needs of another it waits for. Ended in the reverse
            order.
    """

    files: Mapping[str, bytes]
    programs: tuple[Program, ...]


@dataclass(frozen=True, slots=True)
class Machine:
    """What a provider says of a machine.

    Args:
        id: the provider's own name for it.
        address: where people reach it; empty while there is none.
        leaves_at_unix_s: when the provider will take it, once it has given notice.
        reason: why it is leaving or gone, in a few words.
        since_unix_s: when it came into this state; None: the provider does not say.
        is_gateway: it has the uplink of its replica gateway.
    """

    id: str
    spec: MachineSpec
    state: MachineState
    started_unix_s: float
    _: KW_ONLY
    address: str = ""
    leaves_at_unix_s: float | None = None
    reason: str = ""
    since_unix_s: float | None = None
    is_gateway: bool = False
