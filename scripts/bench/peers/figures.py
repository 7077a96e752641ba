"""Columns, cases and targets of the message bench.

Sans-I/O. Works on the ``Rounds`` of ``report.py``. A ratio is of medians of one round in one case: same MTU, same
state of the devices.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from report import Rounds, Target

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
_LOADED_RATIOS: Final = ((_SMALL, 1_500, False, 0.8), (_SMALL, 9_000, False, 0.8), (_IMAGE, 9_000, False, 0.6))
_ADDED_MS: Final = 1.5
_SMALL_CPU_MS: Final = 0.12


def case_of(size: int, mtu: int, *, offloads: bool, loaded: bool = False) -> str:
    """Return the name of a case; ``loaded``: another process takes half of each core."""
    return f"{size:,} B, MTU {mtu}, offloads {'on' if offloads else 'off'}{', cores half taken' if loaded else ''}"


def targets_of(
    over: Rounds, ours: Iterable[str], cases: Sequence[tuple[int, int, bool]], loads: Sequence[bool] = (False,)
) -> list[Target]:
    """Return the targets of each of our rows, in the cases that were run.

    Args:
        cases: bytes, MTU, offloads.
        loads: whether other processes took half of each core.
    """
    targets: list[Target] = []
    for label in (label for label in ours if label.endswith(" cdr")):
        for loaded in loads:
            for size, mtu, offloads, asked in _LOADED_RATIOS if loaded else _RATIOS:
                if (size, mtu, offloads) in cases:
                    case = case_of(size, mtu, offloads=offloads, loaded=loaded)
                    what = f"{label} / {_SECURED}, {case}"
                    targets.append(over.ratio(what, label, _SECURED, case, MEDIAN, asked, at_most=True))
        for size, mtu, offloads in cases if False in loads else ():
            case = case_of(size, mtu, offloads=offloads)
            if size == _SMALL and not offloads:
                targets += [
                    over.target(f"{label}, {case}, {CPU[end]}", label, case, CPU[end], _SMALL_CPU_MS, at_most=True)
                    for end in ("sender", "receiver")
                ]
            if size == _IMAGE:
                what = f"{label} - {_UNSECURED}, ms, {case}"
                targets.append(over.difference(what, label, _UNSECURED, case, MEDIAN, _ADDED_MS))
    return targets
