"""Survival bench: silence of a steady reliable flow when something fails or moves, and its losses.

Each row has a small network of real processes in namespaces (``survive_rows.py``). P publishes numbered messages of 100
bytes; R writes down when each came. The silence of an event is the longest time between two consecutive messages at R,
from the event until the flow has been steady again. So it includes the time between two messages, and the delay of this
machine's scheduler (the row ``nothing``). Lost and doubled count messages over the whole row, all rounds of it.

    sudo .venv/bin/python scripts/bench/survive.py                      # the whole; writes docs/benchmarks/survive.json
    sudo .venv/bin/python scripts/bench/survive.py --only silent --only cut --rounds 30 --no-save
    sudo .venv/bin/python scripts/bench/survive.py --only ribs --rounds 1 --dead-s 600 --no-save     # ten minutes
    sudo .venv/bin/python scripts/bench/survive.py --quick --no-save      # one round of each: does it work?
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import Final

from faults.overlay import Overlay
from faults.records import Kind, Record
from machine import machine_state
from peers.process import FailedError
from report import percentile, progress
from rich.console import Console
from rich.table import Table
from survive_rows import NEW_TOPICS, ROWS, Row

from gdp.errors import GdpError
from gdp.host.run_registry import Run, RunRegistry

OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks" / "survive.json"
ROUNDS: Final = 30
HZ: Final = 500.0
DEAD_S: Final = 80.0  # longer than three leases of 24 s
SETTLE_S: Final = 11.0  # longer than a link that came and went is left out of routes
STEADY_S: Final = 0.5  # a flow that had no gap above ``STEADY_GAP_S`` for so long is steady
STEADY_GAP_S: Final = 0.1
PATIENCE_S: Final = 40.0  # longer than a lease
LOOK_S: Final = 0.05
LAST_S: Final = 2.0
COLUMNS: Final = 170


@dataclass(slots=True)
class Measured:
    """Result of a row: seconds, one figure an event.

    Attributes:
        silence_s: from the event on.
        return_s: the same after the event is undone.
        new_name_s: until a name that is new after the event was read.
        reported_lost: losses of the steady flow that R got a report of.
        never: events after which the flow did not come back in time; their silence is at least the patience.
    """

    silence_s: list[float] = field(default_factory=list)
    return_s: list[float] = field(default_factory=list)
    new_name_s: list[float] = field(default_factory=list)
    published: int = 0
    lost: int = 0
    reported_lost: int = 0
    doubled: int = 0
    never: int = 0


class Flowing:
    """R's side of the flow while it runs: arrivals as they are recorded."""

    def __init__(self, overlay: Overlay) -> None:
        self._overlay = overlay
        self.arrivals_ns: list[int] = []
        self.numbers: Counter[tuple[int, int]] = Counter()  # (incarnation, number) of the steady flow
        self.published: set[tuple[int, int]] = set()
        self.reported_lost = 0
        self.first_of: dict[int, int] = {}  # channel -> when its first message came

    def look(self) -> None:
        """Read new records; end with an error if a process ended by itself.

        Raises:
            FailedError: one did.
        """
        for who in self._overlay.died():
            raise FailedError(f"{who} ended by itself: {self._overlay.log_tail(who)}")
        for each in self._records("R"):
            if each.kind == Kind.DELIVERED:
                self.first_of.setdefault(each.channel, each.at_ns)
                if each.channel == 0:
                    self.arrivals_ns.append(each.at_ns)
                    self.numbers[each.incarnation_id, each.number] += 1
            elif each.kind == Kind.LOST and each.channel == 0:
                self.reported_lost += each.number
            elif each.kind == Kind.WRONG:
                raise FailedError(f"R had a message of channel {each.other} on channel {each.channel}")
        for each in self._records("P"):
            if each.kind == Kind.PUBLISHED and each.channel == 0:
                self.published.add((each.incarnation_id, each.number))

    def _records(self, member: str) -> Iterator[Record]:
        return chain.from_iterable(records for _, records in self._overlay.read(member))

    def is_steady(self, since_ns: int) -> bool:
        """Return whether the flow has been steady for ``STEADY_S``, all of it after a moment."""
        begin_ns = time.monotonic_ns() - round(STEADY_S * 1e9)
        if begin_ns < since_ns:
            return False
        late = [at_ns for at_ns in reversed(self.arrivals_ns[-4_000:]) if at_ns >= begin_ns]
        marks = [begin_ns, *reversed(late), time.monotonic_ns()]
        return len(late) > 1 and max(b - a for a, b in pairwise(marks)) < STEADY_GAP_S * 1e9

    def await_steady(self, since_ns: int, patience_s: float = PATIENCE_S) -> bool:
        """Return whether the flow became steady in time."""
        end_s = time.monotonic() + patience_s
        while time.monotonic() < end_s:
            self.look()
            if self.is_steady(since_ns):
                return True
            time.sleep(LOOK_S)
        return False

    def silence_s(self, since_ns: int) -> float:
        """Return the longest time between consecutive arrivals, the last before a moment included; up to now."""
        before = [at_ns for at_ns in self.arrivals_ns if at_ns < since_ns][-1:]
        after = [at_ns for at_ns in self.arrivals_ns if at_ns >= since_ns]
        marks = [*before, *after] if after else [*(before or [since_ns]), time.monotonic_ns()]
        return max((b - a for a, b in pairwise(marks)), default=0) / 1e9

    def count(self, sent: set[tuple[int, int]]) -> tuple[int, int]:
        """Return how many of these are missing, from the first that arrived on, and the surplus deliveries of any."""
        first = min(self.numbers, default=(0, 0))
        missing = {each for each in sent if each >= first} - self.numbers.keys()
        return len(missing), sum(number - 1 for number in self.numbers.values())


def measure(runs: RunRegistry, row: Row, rounds: int, options: argparse.Namespace) -> Measured:
    """Make the event of a row happen so often.

    Raises:
        FailedError: the network did not come up, or a process ended by itself.
        GdpError: the kernel refuses.
    """
    found = Measured()
    with ExitStack() as undo:
        run: Run = runs.start()
        undo.callback(run.end)
        overlay = undo.enter_context(Overlay(run, row.plan(options.hz), plane=options.plane, more=options.more))
        overlay.start_all()
        flow = Flowing(overlay)
        if not flow.await_steady(time.monotonic_ns()):
            raise FailedError(f"{row.what}: no steady flow before any event")
        _watch(flow, options.settle_s)  # path computation waits longer in a network that has just started (RFC 8405)
        for at in range(rounds):
            _once(overlay, flow, row, at, found, options)
        flow.look()
        sent = set(flow.published)
        _watch(flow, LAST_S)
        found.lost, found.doubled = flow.count(sent)
        found.published, found.reported_lost = len(sent), flow.reported_lost
    return found


def _once(overlay: Overlay, flow: Flowing, row: Row, at: int, found: Measured, options: argparse.Namespace) -> None:
    time.sleep(random.random() * options.phase_s)  # events hit any phase of every timer
    since_ns = time.monotonic_ns()
    row.fail(overlay, at)
    if row.new_name_s is not None:
        found.new_name_s.append(_new_name_s(overlay, flow, at))
    if row.holds:
        _watch(flow, options.dead_s)
    patience_s = 0.1 if row.holds and options.dead_s >= PATIENCE_S and not flow.is_steady(since_ns) else PATIENCE_S
    found.never += not flow.await_steady(since_ns, patience_s)
    found.silence_s.append(flow.silence_s(since_ns))
    progress(f"  {at + 1}: {found.silence_s[-1] * 1e3:.1f} ms")
    if row.undo is not None:
        since_ns = time.monotonic_ns()
        row.undo(overlay, at)
        found.never += not flow.await_steady(max(since_ns, time.monotonic_ns()))
        found.return_s.append(flow.silence_s(since_ns))
        _watch(flow, options.settle_s)


def _watch(flow: Flowing, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        flow.look()
        time.sleep(LOOK_S)


def _new_name_s(overlay: Overlay, flow: Flowing, at: int) -> float:
    """Make P publish, and R read, an unknown name; return the seconds until its first message."""
    channel = len(overlay.plan.flows) + len(overlay.plan.services) + at
    begun_ns = time.monotonic_ns()
    for who in ("member P", "member R"):
        overlay.signal(who, signal.SIGUSR1)
    end_s = time.monotonic() + PATIENCE_S
    while channel not in flow.first_of and time.monotonic() < end_s:
        flow.look()
        time.sleep(LOOK_S)
    return (flow.first_of.get(channel, time.monotonic_ns()) - begun_ns) / 1e9


def show(measured: dict[str, Measured], options: argparse.Namespace) -> None:
    """Print the table."""
    table = Table(title=f"Silence of a flow of {options.hz:g} messages/s, ms", title_justify="left")
    counts = ("lost", "reported", "doubled", "no return")
    for heading in ("event", "to reach", "events", "p50", "p99", "max", "met", "undone: max", *counts):
        table.add_column(heading, justify="left" if heading == "event" else "right")
    for name, each in measured.items():
        row = ROWS[name]
        table.add_row(row.what, *_figures(each.silence_s, row.target_s, _max_text(each.return_s)), *_counts(each))
        if each.new_name_s:
            table.add_row("  until a new name is read", *_figures(each.new_name_s, row.new_name_s, ""))
    console = Console(width=COLUMNS)
    console.print(f"{machine_state()}", highlight=False)
    console.print(table)


def _figures(seconds: list[float], target_s: float | None, undone: str) -> list[str]:
    asked = "" if target_s is None else f"≤ {target_s * 1e3:g}"
    p50, p99 = (f"{percentile(seconds, share) * 1e3:.1f}" for share in (0.5, 0.99))
    return [asked, str(len(seconds)), p50, p99, _max_text(seconds), _met(seconds, target_s), undone]


def _counts(each: Measured) -> list[str]:
    return [str(each.lost), str(each.reported_lost), str(each.doubled), str(each.never)]


def _max_text(seconds: list[float]) -> str:
    return f"{max(seconds) * 1e3:.1f}" if seconds else ""


def _met(seconds: list[float], target_s: float | None) -> str:
    if not target_s:  # a silence of nothing is compared with the row ``nothing``
        return ""
    return "yes" if percentile(seconds, 0.99) <= target_s else "NO"


def save(path: Path, measured: dict[str, Measured], options: argparse.Namespace) -> None:
    """Write every figure; rows of an earlier run that were not measured now are kept."""
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else {}
    for name, each in measured.items():
        row = ROWS[name]
        rows[name] = {
            "what": row.what, "target_s": row.target_s, "new_name_target_s": row.new_name_s,
            "hz": options.hz, "data_plane": options.plane, **asdict(each),
        }  # fmt: skip
    answer = {"bench": "survive", "machine": asdict(machine_state()), "rows": rows}
    path.write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=list(ROWS), help="this row; may be repeated")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="events a row (default: %(default)s)")
    parser.add_argument("--hz", type=float, default=HZ, help="messages a second (default: %(default)s)")
    parser.add_argument("--plane", default="auto", help="as gdp-switch --data-plane (default: %(default)s)")
    parser.add_argument("--dead-s", type=float, default=DEAD_S, help="how long no RIB lives (default: %(default)s)")
    parser.add_argument("--phase-s", type=float, default=0.5, help="random wait before an event (default: %(default)s)")
    parser.add_argument("--settle-s", type=float, default=SETTLE_S, help="after it is undone (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="one round of each, RIBs dead for 3 s")
    parser.add_argument("--json", type=Path, default=OUTPUT, help="where the figures go (default: docs/benchmarks)")
    parser.add_argument("--no-save", action="store_true", help="print only")
    parser.add_argument("--strict", action="store_true", help="exit 1 when a target was missed or a message")
    parser.set_defaults(more={})
    return parser


def main() -> None:
    """Run the bench, or a part of it."""
    options = arguments().parse_args()
    if options.quick:
        options.rounds, options.dead_s, options.settle_s = 1, 3.0, 0.0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # SIGTERM must remove everything that was made
    runs = RunRegistry()
    runs.sweep()  # remains of a killed run
    measured: dict[str, Measured] = {}
    failures: list[str] = []
    for name in options.only or list(ROWS):
        row = ROWS[name]
        rounds = min(options.rounds, NEW_TOPICS) if row.new_name_s is not None else options.rounds
        rounds = min(rounds, 3) if row.holds else rounds
        progress(f"{name}: {row.what}, {rounds} times")
        try:
            measured[name] = measure(runs, row, rounds, options)
            if not options.no_save:
                save(options.json, measured, options)
        except KeyboardInterrupt:
            sys.exit(130)
        except (GdpError, FailedError) as error:
            failures.append(f"{name}: {error}")
            progress(f"FAILED {failures[-1]}")
    show(measured, options)
    is_bad = any(each.lost or each.doubled or each.never for each in measured.values())
    missed = any("NO" in (_met(each.silence_s, ROWS[name].target_s),) for name, each in measured.items())
    sys.exit(bool(failures) or (options.strict and (is_bad or missed)))


if __name__ == "__main__":
    main()
