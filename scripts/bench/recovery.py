"""How soon a cluster is whole again: machines of the provider ``local`` are preempted and killed while a robot calls.

    preempted      a machine is given notice: until that is seen, and until a replacement serves. Asked: at most 5 s
    killed         all its processes at once, its link gone: until that is seen, and until a replacement serves. Asked
                   of the first: at most 1 s
    frozen         all its processes stop and its link stays up; with --gateway replica only
    supervisor     the supervisor is killed (SIGKILL), and while nobody looks a machine as well; then it is started
                   again: until the journal is right and the replacement asked for. Asked: at most 2 s

With --gateway replica one of the machines is the gateway to the others, and it is always this machine that is taken.
Then there are two figures more: until another machine has the role, and the longest time without an answer.

A real ROS node calls ``/echo`` at the robot all the while. Asked: not one request fails. Every machine has a switch, a
proxy and a real ROS node of its own; they, the robot and the supervisor share this machine's cores.

    sudo .venv/bin/python scripts/bench/recovery.py                     # the whole; writes docs/benchmarks/healing.*
    sudo .venv/bin/python scripts/bench/recovery.py --quick --no-save   # one round: does it work?
    sudo .venv/bin/python scripts/bench/recovery.py --only killed --rounds 10 --no-save
    sudo .venv/bin/python scripts/bench/recovery.py --gateway replica   # three machines; writes healing_gateway.*
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Final

from healing_stage import Cluster
from machine import machine_state
from peers.process import FailedError
from plot import Panel, panel_of, require_plot, save_bars
from report import Rounds, Settings, Target, progress, show, write_json

from gdp.errors import GdpError

PREEMPTED, KILLED, FROZEN, SUPERVISOR = "preempted", "killed", "frozen", "supervisor"
DEDICATED, REPLICA = "dedicated", "replica"
CASES: Final = {
    PREEMPTED: "a machine preempted with notice",
    KILLED: "a machine killed",
    FROZEN: "a machine frozen",
    SUPERVISOR: "supervisor and a machine killed",
}
WHO: Final = "fog, local"
DETECTED: Final = "until it is seen, s"
SERVING: Final = "until a replacement serves, s"
RECONCILED: Final = "until the journal is right, s"
MOVED: Final = "until another machine is the gateway, s"
SILENCE: Final = "longest time without an answer, s"
COLUMNS: Final = {
    PREEMPTED: (DETECTED, MOVED, SILENCE, SERVING),
    KILLED: (DETECTED, MOVED, SILENCE, SERVING),
    FROZEN: (DETECTED, MOVED, SILENCE, SERVING),
    SUPERVISOR: (RECONCILED, MOVED, SILENCE, SERVING),
}
TRAFFIC, FAILED = "requests meanwhile", "failed"
ASKED_S: Final = {(PREEMPTED, SERVING): 5.0, (KILLED, DETECTED): 1.0, (SUPERVISOR, RECONCILED): 2.0}
OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"
NOTICE_S: Final = 8.0
ROUNDS: Final = 5
RATE: Final = 50.0


def measure(cluster: Cluster, case: str) -> dict[str, float | None]:
    """Let it happen once; return the figures by column, when all is whole again.

    Raises:
        FailedError: it is not in time.
    """
    victim = cluster.oldest() if cluster.gateway == DEDICATED else cluster.gateway_machine()
    begun_s = time.time()
    if case == SUPERVISOR:
        cluster.kill_supervisor()
        cluster.kill(victim)
        at_s = cluster.start_supervisor()
        served = cluster.await_replacement(at_s)
        asked = cluster.await_event(served.name, {"asked"}, at_s)
        seen = cluster.await_event(victim.name, {"taken"}, at_s)
        first: dict[str, float | None] = {RECONCILED: max(asked, seen) - at_s}
    else:
        at_s = time.time()
        if case == PREEMPTED:
            cluster.notice(victim, NOTICE_S)
        elif case == FROZEN:
            cluster.freeze(victim)
        else:
            cluster.kill(victim)
        served = cluster.await_replacement(at_s)
        signs = {"notice"} if case == PREEMPTED else {"taken", "unheard"}
        first = {DETECTED: cluster.await_event(victim.name, signs, at_s) - at_s}
    cluster.await_whole(victim)
    if cluster.gateway == REPLICA:
        first[MOVED] = cluster.await_event(None, {"gateway"}, at_s) - at_s
        first[SILENCE] = cluster.longest_silence(begun_s)
    return {**first, SERVING: (served.served_unix_s or at_s) - at_s}


def targets_of(over: Rounds) -> list[Target]:
    """Return what was asked for of what was measured."""
    found = []
    for case, columns in COLUMNS.items():
        for column in columns:
            if over.spread(WHO, CASES[case], column) is not None:
                asked_s = ASKED_S.get((case, column))
                found.append(over.target(f"{CASES[case]}: {column}", WHO, CASES[case], column, asked_s, at_most=True))
    return [*found, over.target(f"{TRAFFIC}: {FAILED}", WHO, TRAFFIC, FAILED, 0.0, at_most=True)]


def panels_of(over: Rounds) -> list[Panel]:
    """Return a panel for each figure: medians over the rounds."""
    return [
        panel_of(over, CASES[case], column, [WHO], title=f"{CASES[case]}: {column}")
        for case, columns in COLUMNS.items()
        for column in columns
        if over.spread(WHO, CASES[case], column) is not None
    ]


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=list(CASES), help="this part; may be repeated")
    parser.add_argument("--gateway", choices=[DEDICATED, REPLICA], default=DEDICATED, help="(default: %(default)s)")
    parser.add_argument("--machines", type=int, help="(default: 2, with --gateway replica 3)")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="(default: %(default)s)")
    parser.add_argument("--rate", type=float, default=RATE, help="requests a second (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="one round")
    parser.add_argument("--json", type=Path, help="where the figures go (default: docs/benchmarks)")
    parser.add_argument("--plot", type=Path, help="where the picture goes (default: docs/benchmarks)")
    parser.add_argument("--no-plot", action="store_true", help="no picture")
    parser.add_argument("--no-save", action="store_true", help="print only")
    return parser


def main() -> None:
    """Run the bench, or a part of it."""
    options = arguments().parse_args()
    is_drawn = not (options.no_plot or options.no_save)
    if is_drawn:
        require_plot()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was made is removed
    state, begun_s = machine_state(), time.monotonic()
    is_replica = options.gateway == REPLICA
    cases = options.only or [case for case in CASES if is_replica or case != FROZEN]
    if FROZEN in cases and not is_replica:
        sys.exit("error: --only frozen is measured with --gateway replica")
    over, rounds = Rounds(), 1 if options.quick else options.rounds
    machines = options.machines or (3 if is_replica else 2)
    name = "healing_gateway" if is_replica else "healing"
    try:
        with Cluster(options.rate, machines, options.gateway) as cluster:
            for at in range(1, rounds + 1):
                for case in cases:
                    progress(f"round {at}/{rounds}: {CASES[case]}")
                    got = measure(cluster, case)
                    progress(", ".join(f"{column}: {value:.2f}" for column, value in got.items() if value is not None))
                    for column, value in got.items():
                        over.add(WHO, CASES[case], column, value)
            said = cluster.end_caller()
    except KeyboardInterrupt:
        sys.exit(130)
    except (GdpError, FailedError) as error:
        sys.exit(f"error: {error}")
    for column, value in said.items():
        over.add(WHO, TRAFFIC, column, value)
    settings: Settings = {
        "rounds": rounds,
        "machines": machines,
        "gateway": options.gateway,
        "requests a second": options.rate,
        "notice, s": NOTICE_S,
        "took, s": round(time.monotonic() - begun_s),
    }
    title = f"A cluster of {machines} machines of the provider local heals; gateway: {options.gateway}"
    targets = targets_of(over)
    show(title, state, settings, over, targets)
    if not options.no_save:
        write_json(options.json or OUTPUT / f"{name}.json", name, state, settings, over, targets)
    if is_drawn:
        save_bars(options.plot or OUTPUT / f"{name}.png", title, str(state), panels_of(over))


if __name__ == "__main__":
    main()
