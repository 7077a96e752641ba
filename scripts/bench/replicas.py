"""Bench of replicas: benefit and cost for a service; real ROS nodes, a proxy at the robot, one at each machine.

    killed    10^5 requests while any two of three replicas are killed (SIGKILL) at random moments and come back; one
              that serves stays, another one each time. Target: none fails, each is answered once
    added     calls of 100 bytes, one at a time, to one server and to two replicas in turn: what replication adds.
              Target: at most 0.2 ms at the median
    hedged    a server that is slow (+200 ms) once in 100 requests: one such server, two that both get each request,
              and two of which the second is called only when the first is late. Target of the last: at most 2 %
              more requests, and a p99.9 five times better

The fourth figure, two replicas against the least of two of the same samples, is ``scripts/experiments/fig5.py``'s.

    sudo .venv/bin/python scripts/bench/replicas.py                     # the whole; writes docs/benchmarks/replicas.*
    sudo .venv/bin/python scripts/bench/replicas.py --quick --no-save   # a few seconds each: does it work?
    sudo .venv/bin/python scripts/bench/replicas.py --only killed --requests 20000 --rate 250 --no-save
"""

from __future__ import annotations

import random
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final

_HERE: Final = Path(__file__).resolve().parent
sys.path.append(str(_HERE.parent / "experiments"))

from asking import Asking  # noqa: E402 - it lies with the experiments
from experiment import field_of, work_of  # noqa: E402
from field import READY_S, Field, Served, Server  # noqa: E402
from plot import panels_of  # noqa: E402
from report import Rounds, Target, percentile, progress  # noqa: E402
from samples import Sample, Series  # noqa: E402
from skeleton import Options, Outcome, command_line, run_bench  # noqa: E402

from lab.process import FailedError  # noqa: E402

KILLED, ADDED, HEDGED = "killed", "added", "hedged"
CASES: Final = {
    KILLED: "any two of three replicas killed again and again",
    ADDED: "100 bytes, one call at a time",
    HEDGED: "slow (+200 ms) once in 100 requests",
}
ONE, TWO, BOTH, LATE = "one server", "two replicas", "two replicas, both asked", "two replicas, the second if late"
THREE: Final = "three replicas"
REQUESTS: Final = {KILLED: 100_000, ADDED: 1_200, HEDGED: 9_000}  # calls of a round
QUICK: Final = {KILLED: 1_000, ADDED: 60, HEDGED: 300}
ROUNDS: Final = {KILLED: 1, ADDED: 7, HEDGED: 3}
RATE: Final = 300  # the load that two cores carry with three replicas, one of them starting
MEDIAN, P99, P999 = "p50, ms", "p99, ms", "p99.9, ms"
COUNT: Final = "requests"
FAILED, WRONG, TWICE = "failed", "answered wrongly", "answers too many"
KILLS: Final = "replicas killed"
EXTRA: Final = "requests too many, %"
ADDED_MS: Final = 0.2
SEED: Final = 7  # of the deaths
GAIN: Final = 5.0
_END: Final = _HERE / "ros_calls.py"
TYPE: Final = "rcl_interfaces/srv/ListParameters"
_MACHINES: Final = ("m1", "m2", "m3")
_LANES: Final = 200
_CALL_S: Final = 20.0
_APART_S: Final = 1.5  # upper limit from one death of a turn to the next
_AWAY_S: Final = 2.0  # upper limit until the next restart
_REST_S: Final = 1.0  # time in which all serve, between two turns
_STEP_S: Final = 0.5
_WARM_UP: Final = 50  # calls of each service
_RESTFUL: Final = 80.0  # calls a second
_BRISK: Final = 200.0
_BUDGET: Final = 0.02
_SLOW: Final = {"slow_in": 100, "slow_s": 0.2, "threads": 8}
Figures = Mapping[str, Mapping[str, float | None]]  # by row and column


@contextmanager
def kills(here: Field, draw: random.Random) -> Iterator[list[float]]:
    """Kill all replicas but one at random moments, and start them again; then another one stays. Yield the deaths."""
    servers, over, deaths_s = list(here.servers.values()), threading.Event(), list[float]()

    def all_serve(servers: Sequence[Server]) -> None:
        """Wait until each node reports a request, or until no more are sent."""
        for server in servers:
            late_s = time.monotonic() + READY_S
            while not over.is_set():
                try:
                    server.hear(_STEP_S)
                    break
                except FailedError:
                    if time.monotonic() > late_s:
                        raise

    def run() -> None:
        """Work until the block ends."""
        all_serve(servers)
        while not over.wait(_REST_S):
            stays = draw.choice(servers)
            others = draw.sample([each for each in servers if each is not stays], len(servers) - 1)
            for server in others:
                over.wait(draw.uniform(0, _APART_S))
                server.kill()
                deaths_s.append(time.monotonic())
            for server in others:
                over.wait(draw.uniform(0, _AWAY_S))
                server.begin()
            for server in others:
                server.wait()
            all_serve(others)

    with ThreadPoolExecutor(1) as pool:
        killing = pool.submit(run)
        try:
            yield deaths_s
        finally:
            over.set()
        killing.result()


def killed(count: int, options: Options, draw: random.Random) -> Figures:
    """Call three replicas while two of them are killed repeatedly."""
    served = [Served("/number", TYPE, _MACHINES, imports={"timeout_s": _CALL_S})]
    with _field(served) as here, kills(here, draw) as deaths_s:
        found, asking = _ask(here, ["/number"], count, lanes=_LANES, rate=options.rate, counts_answers=True)
    samples = found["/number"]
    figures: dict[str, float | None] = {
        FAILED: sum(not each.machine for each in samples),
        WRONG: sum(bool(each.machine) and not each.is_right for each in samples),
        "answers": asking.heard,
        TWICE: asking.twice,
    }
    return {THREE: {**figures, COUNT: count, KILLS: len(deaths_s), **_latencies(samples)}}


def added(count: int, *_: object) -> Figures:
    """Call one server and two replicas in turn; all are idle between two calls."""
    names = {ONE: "/one", TWO: "/two"}
    with _field([Served("/one", TYPE, _MACHINES[:1]), Served("/two", TYPE, _MACHINES[:2])]) as here:
        found = _ask(here, list(names.values()), count, rate=_RESTFUL)[0]
    return {who: _latencies(found[name]) for who, name in names.items()}


def hedged(count: int, *_: object) -> Figures:
    """Call a server that is slow sometimes, two of them, and the second one only if the first is late."""
    names = {ONE: ("/one/m1", "/one/m2"), BOTH: ("/both",), LATE: ("/late",)}
    served = [
        Served("/one/m1", TYPE, _MACHINES[:1]),
        Served("/one/m2", TYPE, _MACHINES[1:2]),
        Served("/both", TYPE, _MACHINES[:2]),
        Served("/late", TYPE, _MACHINES[:2], imports={"replication": {"mode": "hedged", "budget": _BUDGET}}),
    ]
    turns = ["/one/m1", "/both", "/late", "/one/m2", "/both", "/late"]
    with _field(served, **_SLOW) as here:
        found, asking = _ask(here, turns, count, rate=_BRISK)
    figures = {}
    for who, its in names.items():
        had = sum(_had(found[name]) for name in its)
        asked = sum(asking.warm_up[name] + len(found[name]) for name in its)
        samples = [each for name in its for each in found[name]]
        figures[who] = {**_latencies(samples), EXTRA: 100 * (had / asked - 1)}
    return figures


PARTS: Final[Mapping[str, Callable[[int, Options, random.Random], Figures]]] = {
    KILLED: killed,
    ADDED: added,
    HEDGED: hedged,
}


def _field(served: Sequence[Served], **settings: object) -> AbstractContextManager[Field]:
    used = (each for each in _MACHINES if any(each in one.machines for one in served))
    return field_of(served, work_of(served, "replicate", dict.fromkeys(used, settings), _END))


def targets_of(over: Rounds) -> list[Target]:
    """Return the targets of the measured cases."""
    kill, add, hedge = CASES.values()
    targets = [over.target(f"{kill}: {each}", THREE, kill, each, 0.0, at_most=True) for each in (FAILED, WRONG, TWICE)]
    targets += [
        over.difference(f"{add}: {TWO} - {ONE}, ms", TWO, ONE, add, MEDIAN, ADDED_MS),
        over.target(f"{hedge}: {LATE}, {EXTRA}", LATE, hedge, EXTRA, 100 * _BUDGET, at_most=True),
        over.ratio(f"{hedge}: {ONE} / {LATE}, p99.9", ONE, LATE, hedge, P999, GAIN),
        over.ratio(f"{hedge}: {ONE} / {BOTH}, p99.9", ONE, BOTH, hedge, P999, None),
    ]
    return [each for each in targets if each.what.partition(": ")[0] in over.cases()]


def measure(options: Options) -> Outcome:
    """Measure the parts in turn, round by round."""
    over, draw, only = Rounds(), random.Random(SEED), options.only or list(PARTS)
    counts = {each: options.requests or (QUICK if options.quick else REQUESTS)[each] for each in only}
    rounds = {each: 1 if options.quick else options.rounds or ROUNDS[each] for each in only}
    for at in range(1, max(rounds.values()) + 1):
        for each in only:
            if at <= rounds[each]:
                progress(f"round {at}/{rounds[each]}, {each}: {counts[each]} requests")
                for who, figures in PARTS[each](counts[each], options, draw).items():
                    for column, value in figures.items():
                        over.add(who, CASES[each], column, value)
    return Outcome(
        "replicas",
        "Calls of a service with replicas, over two switches",
        over,
        targets_of(over),
        {
            "rounds": _reported(rounds),
            "requests of a round": _reported(counts),
            "requests a second while killed": options.rate,
            "seed": SEED,
        },
        panels_of(over, MEDIAN, (ONE, TWO, BOTH, LATE, THREE), p99=P99),
    )


def _ask(
    here: Field, services: Sequence[str], count: int, *, rate: float, lanes: int = 1, counts_answers: bool = False
) -> tuple[dict[str, list[Sample]], Asking]:
    """Call so many services in turn; return the samples of each, and the series with its counts."""
    warm_up = _WARM_UP * len(set(services))
    series = Series(
        "number", tuple(services), count, (), _CALL_S, lanes, 1 / rate, warm_up, counts_answers=counts_answers
    )
    with Asking(here.client, series) as asking:
        return asking.by_service("    requests"), asking


def _had(samples: Sequence[Sample]) -> float:
    """Return how many requests the machines of a service had, as the answers said."""
    had: dict[str, float] = {}
    for each in samples:
        had[each.machine] = max(had.get(each.machine, 0.0), each.note)
    return sum(had.values())


def _latencies(samples: Sequence[Sample]) -> dict[str, float | None]:
    times_s = [each.latency_s for each in samples if each.machine]
    return {column: 1e3 * percentile(times_s, share) for column, share in ((MEDIAN, 0.5), (P99, 0.99), (P999, 0.999))}


def _reported(numbers: Mapping[str, int]) -> str:
    return ", ".join(f"{each} {number}" for each, number in numbers.items())


if __name__ == "__main__":
    parser = command_line(__doc__, quick={"rounds": 1}, has_record=True, has_plot=True)
    parser.add_argument("--only", action="append", choices=list(CASES), help="this part; may be repeated")
    parser.add_argument("--rounds", type=int, help=f"of each part (default: {_reported(ROUNDS)})")
    parser.add_argument("--requests", type=int, help=f"of a round (default: {_reported(REQUESTS)})")
    parser.add_argument("--rate", type=float, default=RATE, help="of 'killed', a second (default: %(default)s)")
    run_bench(parser, measure)
