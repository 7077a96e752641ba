"""Service bench: calls over three machines; rclpy client, proxy, three kernel switches, proxy, rclpy server.

    one at a time    a client calls, waits for the answer, calls again: how long a call takes
    1,000/s          50 clients in one node call in turn, none waits for the others: whether all are answered

Each is compared with the same two nodes joined by one cable (``direct``), in turn, round by round. Targets: at most 1.5
ms more a call than direct; every one of 1,000 calls a second answered.

    sudo .venv/bin/python scripts/bench/services.py                     # the whole; writes docs/benchmarks/services.*
    sudo .venv/bin/python scripts/bench/services.py --quick --no-save   # a few seconds: does it work?
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from peers.process import FailedError
from plot import Panel, panel_of
from report import Rounds, Target
from ros_row import LEFT, READY_S, RIGHT, Carried, Row
from ros_stage import DIRECT, Bench, Options, Turn, parse, perform

from proxy.config.config import Encoding

MODULE: Final = "ros_calls"
TYPE: Final = "std_srvs/srv/SetBool"
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
SENT: Final = "calls"
LOST: Final = "not answered"
WRONG: Final = "answered wrongly"
CORES: Final = "both proxies, cores"
ONE: Final = "one at a time"
CLIENTS: Final = 50
RATE: Final = 1_000
LOAD: Final = f"{RATE:,} calls/s from {CLIENTS} clients"
ENCODINGS: Final[dict[str, tuple[Encoding, ...]]] = {ONE: ("cdr", "json"), LOAD: ("cdr",)}
ADDED_MS: Final = 1.5
SECONDS: Final = 5.0
QUICK_S: Final = 2.0
MTU: Final = 1_500
_DONE_S: Final = 40.0


@dataclass(frozen=True, slots=True)
class Series:
    """Calls of one kind. ``encoding``: how proxies carry them; None: they go directly."""

    case: str
    encoding: Encoding | None
    seconds: float

    @property
    def contender(self) -> str:
        """Return the row of its figures."""
        return DIRECT if self.encoding is None else f"overlay, {self.encoding}"

    def measure(self, row: Row, round_number: int) -> dict[str, float]:
        """Return the figures of one trial, by column.

        Raises:
            FailedError: a node did not come up, or nothing was answered.
        """
        del round_number
        is_direct, service = self.encoding is None, service_of(self.encoding or "cdr")
        reported = {"service": service, "seconds": self.seconds, "clients": CLIENTS, "rate": RATE}
        reported["count"] = round(RATE * self.seconds)
        with row.node(RIGHT, MODULE, "serve", direct=is_direct, **reported) as server:
            server.read(READY_S)
            role = "call" if self.case == ONE else "load"
            with row.node(LEFT, MODULE, role, direct=is_direct, **reported) as client:
                client.read(READY_S)
                cpu_s = row.proxies_cpu_s()
                said = client.read(self.seconds + _DONE_S)
            cpu_s = row.proxies_cpu_s() - cpu_s
        figures = {key: value for key, value in said.items() if isinstance(value, int | float)}
        if "p50_s" not in figures:
            raise FailedError("no call was answered")
        found = {MEDIAN: 1e3 * figures["p50_s"], P99: 1e3 * figures["p99_s"]}
        found |= {SENT: figures["sent"], LOST: figures["lost"], WRONG: figures["wrong"]}
        return found if is_direct else {**found, CORES: cpu_s / self.seconds}


def service_of(encoding: Encoding) -> str:
    """Return the name of the service that proxies carry so."""
    return f"/lamp_{encoding}"


def turns_of(options: Options) -> Iterator[Turn]:
    """Return the turns of a round."""
    for mtu in options.mtus:
        for case, encodings in ENCODINGS.items():
            for encoding in (None, *encodings):
                series = Series(case, encoding, options.seconds)
                columns = [MEDIAN, P99, SENT, LOST, WRONG, *([] if encoding is None else [CORES])]
                yield Turn(case_of(case, mtu), series.contender, mtu, columns, series.measure)


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


def panels_of(over: Rounds, mtu: int) -> list[Panel]:
    """Return a panel for each case: medians, whiskers to the p99."""
    panels = []
    for case, encodings in ENCODINGS.items():
        ours = [f"overlay, {encoding}" for encoding in encodings]
        panels.append(panel_of(over, case_of(case, mtu), MEDIAN, [*ours, DIRECT], p99=P99, ours=ours))
    return panels


def bench_of(options: Options) -> Bench:
    """Return the bench that the command line selects."""
    encodings: tuple[Encoding, ...] = ("cdr", "json")
    return Bench(
        "services",
        "Calls of a ROS 2 service over three kernel switches",
        [Carried(service_of(encoding), TYPE, encoding, source=RIGHT, kind="service") for encoding in encodings],
        list(turns_of(options)),
        lambda over: [target for mtu in options.mtus for target in targets_of(over, mtu)],
        lambda over: [panel for mtu in options.mtus for panel in panels_of(over, mtu)],
    )


def main() -> None:
    """Run the bench."""
    options = parse(__doc__ or "", rounds=3, seconds=SECONDS, mtus=(MTU,), quick_s=QUICK_S)
    perform(bench_of(options), options)


if __name__ == "__main__":
    main()
