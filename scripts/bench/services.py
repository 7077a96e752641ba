"""Service bench: calls over three machines; rclpy client, proxy, three kernel switches, proxy, rclpy server.

    one at a time    a client calls, waits for the answer, calls again: how long a call takes
    1,000/s          50 clients in one node call in turn, none waits for the others: whether all are answered

The row ``overlay, cdr, session`` has ``sign: session`` in its rules: a key of the two proxies, no signature.

Each is compared with the same two nodes joined by one cable (``direct``), in turn, round by round. Targets: at most 1.5
ms more a call than direct; every one of 1,000 calls a second answered.

    sudo .venv/bin/python scripts/bench/services.py                     # the whole; writes docs/benchmarks/services.*
    sudo .venv/bin/python scripts/bench/services.py --quick --no-save   # a few seconds: does it work?
"""

from __future__ import annotations

from functools import partial
from typing import Final

from report import Rounds, Target
from ros_row import READY_S, Carried, Row
from ros_stage import DIRECT, MEDIAN, Bench, Measured, Turn, main
from skeleton import Options

from lab.topology import LEFT, RIGHT
from proxy.config.config import Encoding

MODULE: Final = "ros_calls"
TYPE: Final = "std_srvs/srv/SetBool"
LOST: Final = "not answered"
WRONG: Final = "answered wrongly"
COUNTS: Final = {"calls": "sent", LOST: "lost", WRONG: "wrong"}
ONE: Final = "one at a time"
CLIENTS: Final = 50
RATE: Final = 1_000
LOAD: Final = f"{RATE:,} calls/s from {CLIENTS} clients"
ENCODINGS: Final[dict[str, tuple[Encoding, ...]]] = {ONE: ("cdr", "json"), LOAD: ("cdr",)}
ADDED_MS: Final = 1.5
SESSION: Final = ", session"
MTU: Final = 1_500
_DONE_S: Final = 40.0


def measure(
    case: str, seconds: float, row: Row, encoding: Encoding | None, number: int, *, variant: str = ""
) -> Measured:
    """Return the client's report, and the cores that the proxies used.

    Raises ``FailedError``: a node did not come up.
    """
    del number
    service, role, is_direct = (
        service_of(encoding or "cdr", variant),
        "call" if case == ONE else "load",
        encoding is None,
    )
    settings = {
        "service": service,
        "clients": CLIENTS,
        "rate": RATE,
        "count": round(RATE * seconds),
        "seconds": seconds,
    }
    with row.node(RIGHT, MODULE, "serve", direct=is_direct, **settings) as server:
        server.read(READY_S)
        with row.node(LEFT, MODULE, role, direct=is_direct, **settings) as client:
            client.read(READY_S)
            cpu_s = row.proxies_cpu_s()
            said = client.read(seconds + _DONE_S)
            return said, (row.proxies_cpu_s() - cpu_s) / seconds


def service_of(encoding: Encoding, variant: str = "") -> str:
    """Return the name of the service that proxies carry so."""
    return f"/lamp_{encoding}{'_session' if variant else ''}"


def case_of(case: str, mtu: int) -> str:
    """Return the name of a case."""
    return f"{case}, MTU {mtu}"


def targets_of(over: Rounds, mtu: int) -> list[Target]:
    """Return the targets."""
    one, load = case_of(ONE, mtu), case_of(LOAD, mtu)
    targets = []
    for encoding in ENCODINGS[ONE]:
        who = f"overlay, {encoding}"
        targets.append(over.difference(f"{one}: {who} - {DIRECT}, ms", who, DIRECT, one, MEDIAN, ADDED_MS))
    for encoding in ENCODINGS[LOAD]:
        who = f"overlay, {encoding}"
        for column in (LOST, WRONG):
            targets.append(over.target(f"{load}: {who}, {column}", who, load, column, 0.0, at_most=True))
    return targets


def bench_of(options: Options) -> Bench:
    """Return the bench that the command line selects."""
    encodings: tuple[Encoding, ...] = ("cdr", "json")
    turns = [
        Turn(
            case_of(case, mtu), mtu, encoding, COUNTS,
            partial(measure, case, options.seconds, variant=variant), variant=variant,
        )
        for mtu in options.mtus
        for case, own in ENCODINGS.items()
        for encoding, variant in ((None, ""), *((each, "") for each in own), ("cdr", SESSION))
    ]  # fmt: skip
    carried = [Carried(service_of(encoding), TYPE, encoding, source=RIGHT, kind="service") for encoding in encodings]
    carried.append(Carried(service_of("cdr", SESSION), TYPE, "cdr", source=RIGHT, kind="service", sign="session"))
    return Bench("services", "Calls of a ROS 2 service over three kernel switches", carried, turns, targets_of)


if __name__ == "__main__":
    main(bench_of, __doc__, seconds=5.0, mtus=(MTU,), quick_s=2.0)
