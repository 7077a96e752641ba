"""Recovery bench: time until a cluster is complete after machines of the provider ``local`` are preempted or killed.

    preempted      a machine gets a notice: until that is seen, and until a replacement serves. Target: at most 5 s
    killed         all its processes at once, its link gone: until that is seen, and until a replacement serves. Target
                   of the first: at most 1 s
    frozen         all its processes stop and its link stays up; with --gateway replica only
    supervisor     the supervisor is killed (SIGKILL), and a machine while it is down; then the supervisor starts
                   again: until the journal is right and the replacement requested. Target: at most 2 s

With --gateway replica one of the machines is the gateway to the others, and the event always hits this machine.
Then there are two further figures: until another machine has the role, and the longest time without an answer.

A real ROS node calls ``/echo`` at the robot all the while. Target: no request fails. Every machine has a switch, a
proxy and a real ROS node of its own; they, the robot and the supervisor share this machine's cores.

    sudo .venv/bin/python scripts/bench/recovery.py                     # the whole; writes docs/benchmarks/recovery.*
    sudo .venv/bin/python scripts/bench/recovery.py --quick --no-save   # one round: does it work?
    sudo .venv/bin/python scripts/bench/recovery.py --only killed --rounds 10 --no-save
    sudo .venv/bin/python scripts/bench/recovery.py --gateway replica   # three machines; writes recovery_gateway.*
"""

from __future__ import annotations

import time
from typing import Final

from plot import panels_of
from report import Rounds, Target, progress
from skeleton import Options, Outcome, command_line, run_bench

from fog_demo.cluster import DEDICATED, ECHO, REPLICA, Cluster, requests_in
from lab.process import FailedError

PREEMPTED, KILLED, FROZEN, SUPERVISOR = "preempted", "killed", "frozen", "supervisor"
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
FIGURES: Final = (DETECTED, RECONCILED, MOVED, SILENCE, SERVING)
TRAFFIC, FAILED = "requests meanwhile", "failed"
ASKED_S: Final = {(PREEMPTED, SERVING): 5.0, (KILLED, DETECTED): 1.0, (SUPERVISOR, RECONCILED): 2.0}
NOTICE_S: Final = 8.0
ROUNDS: Final = 5
RATE: Final = 50.0


def measure_case(cluster: Cluster, case: str) -> dict[str, float | None]:
    """Make the event happen once; return the figures by column, when the cluster is complete again.

    Raises ``FailedError``: it is not in time.
    """
    victim = cluster.oldest() if cluster.gateway == DEDICATED else cluster.gateway_machine()
    begun_s = time.time()
    if case == SUPERVISOR:
        cluster.kill_supervisor()
        cluster.kill(victim)
        at_s = cluster.start_supervisor()
        served = cluster.await_replacement(at_s)
        asked = cluster.await_event(served.name, {"requested"}, at_s)
        seen = cluster.await_event(victim.name, {"preempted"}, at_s)
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
        signs = {"notice"} if case == PREEMPTED else {"preempted", "unreachable"}
        first = {DETECTED: cluster.await_event(victim.name, signs, at_s) - at_s}
    cluster.await_whole(victim)
    if cluster.gateway == REPLICA:
        first[MOVED] = cluster.await_event(None, {"gateway"}, at_s) - at_s
        first[SILENCE] = cluster.longest_silence(begun_s)
    return {**first, SERVING: (served.served_unix_s or at_s) - at_s}


def targets_of(over: Rounds) -> list[Target]:
    """Return the targets of the measured cases."""
    found = [
        over.target(f"{what}: {column}", WHO, what, column, ASKED_S.get((case, column)), at_most=True)
        for case, what in CASES.items()
        for column in FIGURES
        if over.spread(WHO, what, column)
    ]
    return [*found, over.target(f"{TRAFFIC}: {FAILED}", WHO, TRAFFIC, FAILED, 0.0, at_most=True)]


def measure(options: Options) -> Outcome:
    """Measure every case, round by round."""
    is_replica = options.gateway == REPLICA
    cases = options.only or [case for case in CASES if is_replica or case != FROZEN]
    if FROZEN in cases and not is_replica:
        raise FailedError("--only frozen is measured with --gateway replica")
    over, machines = Rounds(), 3 if is_replica else 2
    with Cluster([ECHO.read_text(encoding="utf-8")], machines, options.gateway) as cluster:
        cluster.call(RATE)
        for at in range(1, options.rounds + 1):
            for case in cases:
                progress(f"round {at}/{options.rounds}: {CASES[case]}")
                found = measure_case(cluster, case)
                progress(", ".join(f"{column}: {value:.2f}" for column, value in found.items() if value is not None))
                for column, value in found.items():
                    over.add(WHO, CASES[case], column, value)
        requests, failed = requests_in(cluster.end_caller())
        over.add(WHO, TRAFFIC, "requests", requests)
        over.add(WHO, TRAFFIC, FAILED, failed)
    return Outcome(
        "recovery_gateway" if is_replica else "recovery",
        f"A cluster of {machines} machines of the provider local heals; gateway: {options.gateway}",
        over,
        targets_of(over),
        {
            "machines": machines,
            "gateway": options.gateway,
            "requests a second": RATE,
            "notice, s": NOTICE_S,
        },
        [panel for column in FIGURES for panel in panels_of(over, column, [WHO])],
    )


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=ROUNDS, quick={"rounds": 1}, has_record=True, has_plot=True)
    parser.add_argument("--only", action="append", choices=list(CASES), help="this part; may be repeated")
    parser.add_argument("--gateway", choices=[DEDICATED, REPLICA], default=DEDICATED, help="(default: %(default)s)")
    run_bench(parser, measure)
