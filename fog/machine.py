"""Machine of a cluster: the request to a provider, the bootstrap bundle, and the provider's description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from enum import Enum

from fog.hardware import Offer


class MachineState(Enum):
    """State of a machine."""

    BOOTING = "booting"  # requested; its programs may not be up
    RUNNING = "running"  # its programs reported that they are ready
    LEAVING = "leaving"  # the provider gave notice, or it is being drained
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class MachineSpec:
    """Request for one machine.

    Args:
        cluster: its cluster; providers tag machines with it, so ``describe`` finds them without a journal.
        name: unique within the cluster and never used again, such as ``m3``.
        offer: which line of the price list: provider, region, type, spot or not.
    """

    cluster: str
    name: str
    offer: Offer


@dataclass(frozen=True, slots=True)
class Program:
    """Process of a machine.

    Args:
        name: of its log, such as ``switch``.
        argv: ``{home}`` in a word stands for the machine's folder, ``{python}`` for its Python.
        ready: text in a line of its output that reports it is up; empty: it is up when it runs.
        environment: added to the machine's environment; ``{home}`` as in ``argv``.
        restarts: whether it is restarted when it ends; otherwise its end ends the machine.
        is_users: it runs the user's code. If the machine has a user account for that, it runs as that user, without
            capabilities and without access to the machine's keys.
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
    """Bootstrap bundle of a machine.

    Args:
        files: path below the machine's folder -> content. They may contain secrets: mode 0600, folders 0700.
        programs: all start at once, in this order; a program waits for what it needs of others. They end in reverse
            order.
    """

    files: Mapping[str, bytes]
    programs: tuple[Program, ...]


@dataclass(frozen=True, slots=True)
class Machine:
    """Provider's description of a machine.

    Args:
        address: address for users; empty while there is none.
        leaves_at_unix_s: time of the preemption, after the provider gave notice.
        reason: why it is leaving or gone, in a few words.
        since_unix_s: start of this state; None: the provider does not report it.
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
