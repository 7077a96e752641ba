"""Choice of the data plane of a switch, with the reason why it is not a better one.

I/O. In order of preference: ``kernel``, ``raw``; ``scapy`` only on request.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from gdp.errors import LocalError
from gdp.extras import require_extra
from gdp.ports.netdev import NetdevPlane
from gdp.ports.raw import RawPlane
from gdp.switch.table import Table

log = logging.getLogger(__name__)

_BEST: Final = "kernel"


@dataclass(frozen=True, slots=True)
class Chosen:
    """An open data plane.

    Attributes:
        name: ``kernel``, ``raw`` or ``scapy``.
        reason: one line: why it is not the best one; empty if it is, or if another was requested.
        entry_counts: frames and bytes by the busiest entries, where the plane counts them.
    """

    plane: NetdevPlane
    name: str
    reason: str = ""
    entry_counts: Callable[[], Mapping[bytes, tuple[int, int]]] | None = None


def choose_plane(wanted: str, ifnames: Sequence[str], table: Table, entries_max: int) -> Chosen:
    """Open the requested data plane; for ``auto``, the best one that this machine allows.

    Args:
        wanted: ``auto``, ``kernel``, ``raw`` or ``scapy``.
        entries_max: most entries that the kernel is to hold.

    Raises:
        MissingExtraError: Scapy is requested and not installed.
        LocalError: a port cannot be opened, or the system refuses the requested plane; the text gives the reason.
    """
    if wanted == "scapy":
        require_extra("scapy", ("scapy",), "data plane scapy")
        from gdp.ports.scapy_plane import ScapyPlane

        return Chosen(ScapyPlane(ifnames, table), "scapy")
    if wanted == "raw":
        return Chosen(RawPlane(ifnames, table), "raw")
    from gdp.ports.kernel.plane import KernelPlane

    try:
        best = KernelPlane(ifnames, table, entries_max=entries_max)
        return Chosen(best, _BEST, entry_counts=best.entry_counts)
    except LocalError as refused:
        if wanted == _BEST:
            raise LocalError(f"data plane kernel: {refused}") from refused
        log.debug("kernel plane refused: %s", refused)
        plane = RawPlane(ifnames, table)  # raises with the right text if the ports are the cause
        return Chosen(plane, "raw", str(refused).partition("\n")[0])
