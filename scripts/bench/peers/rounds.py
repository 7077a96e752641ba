"""Schedule of the message bench: in every round, on every row, each baseline once.

I/O. Makes the rows and removes them.

A baseline that fails the first time is reported as absent, with its reason. One that fails later has no figures in
that round, and the results list the failure.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

from background_load import load_of
from report import Rounds, Target, percentile, progress

from gdp.host.run_registry import RunRegistry
from lab.process import FailedError
from peers.chain import Chain
from peers.exchange import Load
from peers.systems import Baseline, Measured

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


@dataclass(frozen=True, slots=True)
class Plan:
    """Combinations to measure in every round.

    ``loads``: whether other processes take half of each core; one value, or both.
    """

    mtus: tuple[int, ...]
    offloads: tuple[bool, ...]
    baselines: tuple[Baseline, ...]
    load: Load
    rounds: int
    loads: tuple[bool, ...] = (False,)

    @property
    def cases(self) -> list[tuple[int, int, bool]]:
        """Return bytes, MTU and offloads of every case."""
        return [(size, mtu, on) for size in self.load.sizes for mtu in self.mtus for on in self.offloads]

    @property
    def labels(self) -> list[str]:
        """Return all rows."""
        return [label for baseline in self.baselines for label in baseline.labels]


class Turns:
    """Rounds in progress.

    ``over``: the figures. ``notes``: failures, and retransmissions. ``offload_states``: states that the devices report,
    by the requested setting.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.over = Rounds()
        self.notes: list[str] = []
        self.offload_states: dict[bool, str] = {}
        self._seen: set[str] = set()
        self._absent: set[str] = set()

    def run(self, runs: RunRegistry) -> None:
        """Make a row for each MTU, run all rounds, remove the rows."""
        with ExitStack() as stack:
            chains = []
            for mtu in self.plan.mtus:
                run = runs.start()
                stack.callback(run.end)
                chains.append(Chain(mtu, run))
            for number in range(1, self.plan.rounds + 1):
                for chain in chains:
                    for on in self.plan.offloads:
                        self.offload_states[on] = chain.set_offloads(on=on)
                        for loaded in self.plan.loads:
                            with load_of(loaded):
                                self._round(number, chain, on, loaded)

    def _round(self, number: int, chain: Chain, on: bool, loaded: bool) -> None:
        load = ", cores half taken" if loaded else ""
        for baseline in self.plan.baselines:
            if baseline.name in self._absent:
                continue
            where = f"round {number}/{self.plan.rounds}, MTU {chain.mtu}, offloads {_word(on)}{load}: {baseline.name}"
            begun_s = time.monotonic()
            try:
                measured = baseline.measure(chain, self.plan.load)
            except FailedError as error:
                progress(f"{where} FAILED: {error}")
                self._miss(baseline, chain.mtu, on, loaded, where, str(error))
                continue
            self._seen.add(baseline.name)
            self._add(measured, chain.mtu, on, loaded)
            resent = sum({each.label: each.resent for each in measured}.values())
            if resent:
                self.notes.append(f"{where}: {resent} parts sent again")
            progress(f"{where}, {time.monotonic() - begun_s:.1f} s")

    def _add(self, measured: Sequence[Measured], mtu: int, on: bool, loaded: bool) -> None:
        for each in measured:
            case = case_of(each.size, mtu, offloads=on, loaded=loaded)
            self.over.add(each.label, case, MEDIAN, 1e3 * percentile(each.rtt_s, 0.5))
            self.over.add(each.label, case, P99, 1e3 * percentile(each.rtt_s, 0.99))
            for place, column in CPU.items():
                if place in each.cpu_s:
                    self.over.add(each.label, case, column, 1e3 * each.cpu_s[place])

    def _miss(self, baseline: Baseline, mtu: int, on: bool, loaded: bool, where: str, reason: str) -> None:
        """Record a failure: a baseline that never came up is absent, any other has no figures in this round."""
        if baseline.name not in self._seen:
            self._absent.add(baseline.name)
            for label in baseline.labels:
                self.over.absent(label, reason)
            return
        self.notes.append(f"{where}: {reason}")
        for label in baseline.labels:
            for size in self.plan.load.sizes:
                for column in (MEDIAN, P99, *CPU.values()):
                    self.over.add(label, case_of(size, mtu, offloads=on, loaded=loaded), column, None)


def _word(on: bool) -> str:
    return "on" if on else "off"


def case_of(size: int, mtu: int, *, offloads: bool, loaded: bool = False) -> str:
    """Return the name of a case; ``loaded``: another process takes half of each core."""
    return f"{size:,} B, MTU {mtu}, offloads {'on' if offloads else 'off'}{', cores half taken' if loaded else ''}"


def targets_of(
    over: Rounds, ours: Iterable[str], cases: Sequence[tuple[int, int, bool]], loads: Sequence[bool] = (False,)
) -> list[Target]:
    """Return the targets of each of our rows, in the cases that were run.

    ``cases``: bytes, MTU, offloads. ``loads``: whether other processes took half of each core.
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
