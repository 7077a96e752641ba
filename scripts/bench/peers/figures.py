"""Columns, cases and targets of the message bench.

Sans-I/O. Works on the ``Rounds`` of ``report.py``. A ratio is of medians of one round in one case: same MTU, same
state of the devices.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from report import Rounds, Target

__all__ = ["CPU", "MEDIAN", "P99", "case_of", "targets_of"]

MEDIAN: Final = "RTT median, ms"
P99: Final = "RTT p99, ms"
CPU: Final = {"sender": "sender CPU, ms", "receiver": "receiver CPU, ms", "between": "CPU between, ms"}
_SECURED: Final = "zenoh-mtls"
_UNSECURED: Final = "cyclone"
_SMALL: Final = 100
_IMAGE: Final = 921_600
_RATIOS: Final = (  # bytes, MTU, offloads, at most
    (_SMALL, 1_500, False, 0.4),
    (_SMALL, 9_000, False, 0.4),
    (_IMAGE, 9_000, False, 0.4),
    (_IMAGE, 1_500, False, 0.6),
    (_IMAGE, 1_500, True, 0.8),
)
_ADDED_MS: Final = 1.5


def case_of(size: int, mtu: int, *, offloads: bool) -> str:
    """Return the name of a case."""
    return f"{size:,} B, MTU {mtu}, offloads {'on' if offloads else 'off'}"


def targets_of(over: Rounds, ours: Iterable[str], cases: Sequence[tuple[int, int, bool]]) -> list[Target]:
    """Return the targets of each of our rows, in the cases that were run.

    Args:
        cases: bytes, MTU, offloads.
    """
    targets: list[Target] = []
    for label in (label for label in ours if label.endswith(" cdr")):
        for size, mtu, offloads, asked in _RATIOS:
            if (size, mtu, offloads) in cases:
                case = case_of(size, mtu, offloads=offloads)
                what = f"{label} / {_SECURED}, {case}"
                targets.append(over.ratio(what, label, _SECURED, case, MEDIAN, asked, at_most=True))
        for size, mtu, offloads in cases:
            if size == _IMAGE:
                case = case_of(size, mtu, offloads=offloads)
                what = f"{label} - {_UNSECURED}, ms, {case}"
                targets.append(over.difference(what, label, _UNSECURED, case, MEDIAN, _ADDED_MS))
    return targets
