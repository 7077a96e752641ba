"""Interface of the baselines of the message bench.

I/O. Starts processes on the row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from testbed import Lab
from topologies import LEFT

from peers.chain import Chain
from peers.exchange import Load
from peers.jsonl import EndSettings
from peers.process import FailedError, Started

READY_S = 20.0
_MEASURED_S = 180.0


@dataclass(frozen=True, slots=True)
class Measured:
    """One size by one baseline: seconds of every message, CPU seconds a message by machine.

    Attributes:
        resent: retransmitted parts, over all sizes; known of GDP only.
    """

    label: str
    size: int
    rtt_s: tuple[float, ...]
    cpu_s: dict[str, float]
    resent: int = 0


class Baseline(Protocol):
    """One way to carry messages. ``labels`` are its rows: an encoding each, where it has several."""

    @property
    def name(self) -> str:
        """Name in ``--only``."""

    @property
    def labels(self) -> tuple[str, ...]:
        """The rows that it fills."""

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start its processes, measure, end them.

        Raises:
            FailedError: it is not installed, or did not come up, or lost a message.
        """


def start_end(
    chain: Lab, module: str, node: str, load: Load, own: Mapping[str, str], pids: Mapping[str, Sequence[int]]
) -> Started:
    """Start an endpoint, ``ping`` at A or ``pong`` at B."""
    settings = EndSettings(
        "ping" if node == LEFT else "pong", load, {place: list(each) for place, each in pids.items()}, dict(own)
    )
    return chain.start(node, module.rpartition(".")[2], ["-m", module, settings.to_argument()])


def ask_end(ping: Started, labels: Mapping[str, str], patience_s: float = _MEASURED_S) -> list[Measured]:
    """Return the figures of A.

    Args:
        labels: row by the name that the endpoint uses.

    Raises:
        FailedError: it failed.
    """
    found: list[Measured] = []
    for series, label in labels.items():
        said = ping.read(patience_s)
        sizes, resent = said.get("sizes"), said.get("resent", 0)
        if said.get("series") != series or not isinstance(sizes, list) or not isinstance(resent, int):
            raise FailedError(f"figures of {series} were expected, not {said}")
        for each in sizes:
            found.append(Measured(label, each["size"], tuple(each["rtt_s"]), dict(each["cpu_s"]), resent))
    return found
