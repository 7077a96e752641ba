"""Message bench: time of a message over three machines and a small answer back, compared with Zenoh and Cyclone DDS.

Five machines in namespaces, A - s1 - s2 - s3 - B, and in turn on them, round by round:

    gdp-kernel           switches, RIB and two members: encrypted, signed, verified, reliable
    gdp-kernel-session   the same as requests and responses under ``sign: session``: a key of the two ends, no signature
    zenoh-mtls           three routers; mutual TLS on every hop
    cyclone              Cyclone DDS, unsecured, reliable; the three forward IPv4 in the kernel

    sudo .venv/bin/python scripts/bench/messages.py                     # the whole; writes docs/benchmarks/messages.*
    sudo .venv/bin/python scripts/bench/messages.py --quick             # one round of few messages: does it work?
    sudo .venv/bin/python scripts/bench/messages.py --only gdp-kernel --only zenoh-mtls --mtu 1500
    sudo .venv/bin/python scripts/bench/messages.py --load half         # other processes take half of each core

Messages are CDR, and go one at a time, as in a control loop; no device has offloads. A figure of a round is the median
(or p99) of its messages. Only the whole bench writes under docs/benchmarks by itself; a part of it writes to the path
of --json.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import product
from typing import Final

from background_load import LOADS, SHARE, load_of
from machine import signature_pair_s
from peers.chain import Chain
from peers.exchange import ANSWER
from peers.systems import BASELINES, Baseline
from plot import panels_of
from report import Rounds, Settings, Target, percentile
from skeleton import Options, Outcome, Recorder, Trial, command_line, run_bench

from gdp.runtime.busy_poll import SPIN_US
from lab.process import new_run

MEDIAN: Final = "RTT median, ms"
P99: Final = "RTT p99, ms"
CPU: Final = {"sender": "sender CPU, ms", "receiver": "receiver CPU, ms", "between": "CPU between, ms"}
UNSIGNED: Final = "less ECDSA, ms"
COLUMNS: Final = (MEDIAN, P99, UNSIGNED, *CPU.values())
SMALL, IMAGE = 100, 921_600
TIMES: Final = {SMALL: 4, IMAGE: 1}  # of ``count`` messages, by size
MTUS: Final = (1_500, 9_000)
OURS: Final = tuple(name for name in BASELINES if name.startswith("gdp"))
_PAIRS: Final = {"gdp-kernel": 2}  # ECDSA signatures and checks of a message and its answer
_SECURED: Final = "zenoh-mtls"
_UNSECURED: Final = "cyclone"
_RATIOS: Final = {  # bytes, MTU, whether the cores are half taken: at most
    (SMALL, 1_500, False): 0.4,
    (SMALL, 9_000, False): 0.4,
    (IMAGE, 9_000, False): 0.4,
    (IMAGE, 1_500, False): 0.6,
    (SMALL, 1_500, True): 0.8,
    (SMALL, 9_000, True): 0.8,
    (IMAGE, 9_000, True): 0.6,
}
_ADDED_MS: Final = 1.5
_SMALL_CPU_MS: Final = 0.12

Case = tuple[int, int, bool]  # bytes, MTU, whether other processes take half of each core


def case_of(size: int, mtu: int, *, loaded: bool) -> str:
    """Return the name of a case."""
    return f"{size:,} B, MTU {mtu}{', cores half taken' if loaded else ''}"


def measure_one(
    baseline: Baseline, chain: Chain, size: int, count: int, loaded: bool, pairs: int, _: int
) -> Mapping[str, float]:
    """Return the figures of one baseline in one case, by column; a round trip has ``pairs`` of signature and check."""
    with load_of(loaded=loaded):
        found = baseline(chain, size=size, count=count)
        signed_s = pairs * signature_pair_s()
    times_s: Sequence[float] = found["rtt_s"]
    figures = {MEDIAN: 1e3 * percentile(times_s, 0.5), P99: 1e3 * percentile(times_s, 0.99)}
    figures[UNSIGNED] = figures[MEDIAN] - 1e3 * signed_s
    return figures | {CPU[place]: 1e3 * float(cpu_s) for place, cpu_s in found["cpu_s"].items()}


def targets_of(over: Rounds, ours: Iterable[str], cases: Sequence[Case]) -> list[Target]:
    """Return the targets of each of our rows, in the cases that were run."""
    targets: list[Target] = []
    for label, each in product(ours, cases):
        size, mtu, loaded = each
        case = case_of(size, mtu, loaded=loaded)
        if each in _RATIOS:
            what = f"{label} / {_SECURED}, {case}"
            targets.append(over.ratio(what, label, _SECURED, case, MEDIAN, _RATIOS[each], at_most=True))
        if size == SMALL and not loaded and label in _PAIRS:
            what = f"{label} less two signatures and checks / {_SECURED}, {case}"
            targets.append(over.ratio(what, label, _SECURED, case, UNSIGNED, _RATIOS[each], at_most=True))
        if size == SMALL and not loaded:
            targets += [
                over.target(f"{label}, {case}, {CPU[end]}", label, case, CPU[end], _SMALL_CPU_MS, at_most=True)
                for end in ("sender", "receiver")
            ]
        if size == IMAGE and not loaded:
            what = f"{label} - {_UNSECURED}, ms, {case}"
            targets.append(over.difference(what, label, _UNSECURED, case, MEDIAN, _ADDED_MS))
    return targets


def measure(options: Options) -> Outcome:
    """Measure every baseline in every case, round by round."""
    names = options.only or list(BASELINES)
    recorder = Recorder()
    cases: list[Case] = list(product(TIMES, options.mtu or MTUS, LOADS[options.load]))
    with ExitStack() as stack:
        chains = {mtu: Chain(mtu, stack.enter_context(new_run())) for mtu in dict.fromkeys(mtu for _, mtu, _ in cases)}
        trials = [
            Trial(
                case_of(size, mtu, loaded=loaded),
                name,
                COLUMNS,
                partial(
                    measure_one,
                    BASELINES[name],
                    chains[mtu],
                    size,
                    TIMES[size] * options.count,
                    loaded,
                    _PAIRS.get(name, 0),
                ),
            )
            for (size, mtu, loaded), name in product(cases, names)
        ]
        recorder.interleave(trials, options.rounds)
    over = recorder.rounds
    settings: Settings = {
        "messages a round": [times * options.count for times in TIMES.values()],
        "answer, B": ANSWER.size,
        "ends of gdp spin, us": SPIN_US,
        "shared memory": "off everywhere",
        "offloads": "off",
        "load": f"{SHARE:.0%} of each core" if True in LOADS[options.load] else "none",
        "trouble": recorder.notes or "none",
    }
    ours = [name for name in names if name in OURS]
    return Outcome(
        "messages",
        "Messages over three machines, an answer back",
        over,
        targets_of(over, ours, cases),
        settings,
        panels_of(over, MEDIAN, names, p99=P99, ours=OURS),
    )


def is_whole(options: Options) -> bool:
    """Return whether all cases are measured, so that the figures are written to ``docs/benchmarks``."""
    return not (options.only or options.mtu) and options.load == "both"


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, quick={"rounds": 1, "count": 10}, has_record=True, has_plot=True)
    parser.set_defaults(count=80, is_whole=is_whole)
    parser.add_argument("--only", action="append", choices=list(BASELINES), help="this baseline; may be repeated")
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    text = "none, or processes that take half of each core, or each in turn (default: %(default)s)"
    parser.add_argument("--load", choices=tuple(LOADS), default="both", help=text)
    run_bench(parser, measure)
