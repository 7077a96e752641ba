"""``gdp ping``: round-trip time to where a name is advertised.

I/O; over the control socket of a node of this machine, which sends the requests as the member that it is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import Annotated, Final

import typer

from gdp.cli.local_nodes import Node, connect, find_name
from gdp.cli.places import NOWHERE, find_places
from gdp.errors import LocalError
from gdp.management.control_client import NodeConnection
from gdp.names import Name
from gdp.ports.readiness import readable
from gdp.terminal import echo

_NOTHING_CAME: Final = 1
INTERVAL_MIN_S: Final = 0.05  # 20 requests a second; a node answers 32 of one member

NameText = Annotated[
    str, typer.Argument(metavar="NAME", help="A ROS name that a proxy of this machine carries, or 64 hex digits.")
]
Count = Annotated[
    int | None,
    typer.Option("-c", "--count", min=1, metavar="COUNT", help="Stop after so many requests. Default: until Ctrl-C."),
]
Interval = Annotated[
    float, typer.Option("-i", "--interval", min=INTERVAL_MIN_S, metavar="SECONDS", help="Time between two requests.")
]
JsonLines = Annotated[bool, typer.Option("--json", help="Print a JSON object for each reply, and one at the end.")]
Wait = Annotated[
    float, typer.Option("-W", "--timeout", min=0.01, max=60, metavar="SECONDS", help="How long to wait for a reply.")
]


def ping(
    name: NameText,
    count: Count = None,
    interval: Interval = 1.0,
    timeout: Wait = 2.0,
    node: Node = None,
    as_json: JsonLines = False,
) -> None:
    """Measure the round-trip time to the members that publish or serve a name, by the path of data.

    Each line is one reply, and says how far the clock there is ahead of ours. Ctrl-C ends it and prints loss, minimum,
    median, 99th percentile and maximum.
    The exit code is 1 if nothing came back.

    \b
    Example:
      gdp ping /camera/image
      gdp ping /camera/image -c 5 -i 0.2
      gdp ping 75e0...0fc --node robot/proxy --json
    """
    with connect(node) as connection:
        asked = find_name(name, connection)
        places = find_places(connection, asked)
        if not places:
            raise LocalError(f"{name}: {NOWHERE}")
        targets = list(dict.fromkeys(each.node for each in places))
        run = _Run(connection, asked, targets, timeout, as_json=as_json)
        try:
            run.run(count, interval)
        except KeyboardInterrupt:
            echo("", err=True)
        run.report(name)
    if not run.has_replies:
        raise typer.Exit(_NOTHING_CAME)


class _Run:
    """One run of the command."""

    def __init__(
        self, connection: NodeConnection, name: Name, targets: list[str], timeout_s: float, *, as_json: bool
    ) -> None:
        self._connection = connection
        self._name = name
        self._timeout_s = timeout_s
        self._as_json = as_json
        self._sent: dict[object, tuple[int, str]] = {}  # by id: number and target, while no reply has come
        self._statistics = {target: PingStatistics() for target in targets}
        self._labels: dict[str, str] = {}

    @property
    def has_replies(self) -> bool:
        """Return whether any reply came."""
        return any(each.rtts_ms for each in self._statistics.values())

    def run(self, count: int | None, interval_s: float) -> None:
        """Send until the count is reached, and wait for the last replies."""
        number, due_s = 0, time.monotonic()
        while count is None or number < count:
            number += 1
            for target, statistics in self._statistics.items():
                statistics.sent += 1
                sent = self._connection.send_ask(
                    "ping", target=target, name=self._name.to_text(), timeout_s=self._timeout_s
                )
                self._sent[sent] = number, target
            due_s += interval_s
            self._receive_until(due_s if count is None or number < count else None)
        self._receive_until(None)

    def _receive_until(self, due_s: float | None) -> None:
        """Handle responses until a monotonic second; None: until none is outstanding."""
        while due_s is not None or self._sent:
            left_s = None if due_s is None else max(due_s - time.monotonic(), 0.0)
            if not self._connection.has_received and not readable([self._connection], left_s):
                return
            self._handle(self._connection.read_result())

    def _handle(self, result: Mapping[str, object]) -> None:
        known = self._sent.pop(result.get("id"), None)
        if known is None:
            return
        number, target = known
        rtt_ms = result.get("rtt_ms")
        came = result.get("state") == "answered" and isinstance(rtt_ms, int | float)
        if came and isinstance(rtt_ms, int | float):
            self._statistics[target].rtts_ms.append(float(rtt_ms))
            self._labels[target] = f"{result['label']} ({result['role']}, {_domain(result)})"
        if self._as_json:
            line = {"number": number, "node": target, "rtt_ms": rtt_ms if came else None}
            if came:
                clock = {key: result.get(key) for key in ("clock_offset_ms", "clock_bound_ms")}
                line |= {key: result[key] for key in ("label", "role", "domain", "domain_label", "result")} | clock
            echo(json.dumps(line))
        elif came:
            echo(f"reply {number} from {self._labels[target]}: {rtt_ms:.2f} ms{clock_words(result)}")
        else:
            echo(f"no reply {number} from {self._shown(target)} within {self._timeout_s:g} s")

    def report(self, name: str) -> None:
        """Print the summary."""
        for number, target in self._sent.values():  # Ctrl-C ended the wait: these are neither lost nor answered
            self._statistics[target].sent -= 1
            del number
        if self._as_json:
            members = [{"node": target, **each.to_fields()} for target, each in self._statistics.items()]
            echo(json.dumps({"name": self._name.to_text(), "members": members}))
            return
        echo(f"--- {name} ---")
        for target, each in self._statistics.items():
            echo(f"{self._shown(target)}: {each.to_text()}")

    def _shown(self, target: str) -> str:
        return self._labels.get(target, Name.from_text(target).short)


def clock_words(result: Mapping[str, object]) -> str:
    """Return how far the clock of who replied is ahead, and the bound of the error; empty: not known."""
    offset_ms, bound_ms = result.get("clock_offset_ms"), result.get("clock_bound_ms")
    return "" if offset_ms is None else f", clock {offset_ms:+.2f} ± {bound_ms:.2f} ms"


def _domain(result: Mapping[str, object]) -> str:
    return str(result.get("domain_label") or Name.from_text(str(result["domain"])).short)


@dataclass(slots=True)
class PingStatistics:
    """Requests to one member, and their round-trip times in milliseconds."""

    sent: int = 0
    rtts_ms: list[float] = field(default_factory=list)

    @property
    def loss(self) -> float:
        """Return the share of requests without a reply, 0 to 1."""
        return 1 - len(self.rtts_ms) / self.sent if self.sent else 0.0

    def to_fields(self) -> dict[str, object]:
        """Return the JSON fields; round-trip times are None where nothing came back."""
        times = sorted(self.rtts_ms)
        return {
            "sent": self.sent,
            "received": len(times),
            "loss": round(self.loss, 4),
            "min_ms": times[0] if times else None,
            "median_ms": quantile(times, 0.5),
            "p99_ms": quantile(times, 0.99),
            "max_ms": times[-1] if times else None,
        }

    def to_text(self) -> str:
        """Return the summary for people."""
        times = sorted(self.rtts_ms)
        counts = f"{self.sent} sent, {len(times)} received, {100 * self.loss:.3g} % lost"
        if not times:
            return counts
        median, p99 = quantile(times, 0.5), quantile(times, 0.99)
        return f"{counts}, min/median/p99/max {times[0]:.2f}/{median:.2f}/{p99:.2f}/{times[-1]:.2f} ms"


def quantile(times: list[float], share: float) -> float | None:
    """Return the smallest value that at least this share of the sorted values does not exceed; None: there are none."""
    return times[max(ceil(share * len(times)) - 1, 0)] if times else None
