"""Survival bench: silence of a steady reliable flow when something fails or moves, and its losses.

Each row has a small network of real processes in namespaces (``survive_rows.py``). P publishes numbered messages of 100
bytes; R writes down when each came. The silence of an event is the longest time between two consecutive messages at R,
from the event until the flow has been steady again. So it includes the time between two messages, and the delay of this
machine's scheduler (the row ``nothing``). Lost and doubled count messages over the whole row, all rounds of it.

``tunnels`` has a robot behind a home NAT and a server behind another, which know one border only and open a direct
tunnel; 100 messages a second. Its silences include the commands of the laboratory that make the event, whose time is a
column of its own: another address is set by one program, another network or public address by several.

    sudo .venv/bin/python scripts/bench/survive.py                      # the whole; writes docs/benchmarks/survive.json
    sudo .venv/bin/python scripts/bench/survive.py --only silent --only cut --rounds 30 --no-save
    sudo .venv/bin/python scripts/bench/survive.py --only tunnels         # a robot's address changes: ten minutes
    sudo .venv/bin/python scripts/bench/survive.py --quick --no-save      # one round of each: does it work?
"""

from __future__ import annotations

import random
import signal
import time
from collections import Counter
from contextlib import ExitStack
from itertools import pairwise
from typing import Final

from faults.overlay import LOOK_S, Overlay
from report import Rounds, Spread, Target, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench
from survive_rows import ADDRESS_CHANGES, NEW_TOPICS, ROWS, Row, roaming_flow

from gdp.errors import GdpError
from lab.process import FailedError, new_run

ROUNDS: Final = 30
HZ: Final = 500.0
CASE: Final = f"a flow of {HZ:g} messages/s"
DEAD_S: Final = 80.0  # longer than three leases of 24 s
SETTLE_S: Final = 11.0  # longer than a link that came and went is left out of routes
STEADY_S: Final = 0.5  # a flow that had no gap above ``STEADY_GAP_S`` for so long is steady
STEADY_GAP_S: Final = 0.1
ROAMS_EVERY_S: Final = 3.0
PATIENCE_S: Final = 40.0  # longer than a lease
PHASE_S: Final = 0.5  # longest random wait before an event
LAST_S: Final = 2.0
SILENCE, RETURN, P99 = "silence, ms", "after undo, ms", "p99, ms"
PUBLISHED, LOST, REPORTED, DOUBLED, NEVER = "published", "lost", "reported", "doubled", "no return"
TUNNELS, TUNNELS_ROW, TUNNELS_S = "tunnels", "through tunnels", 0.3
COMMANDS: Final = "commands, ms"


class Flowing:
    """The steady flow from P to R, while it runs."""

    def __init__(self, overlay: Overlay) -> None:
        self._overlay = overlay
        self._arrivals_ns = overlay.books.arrivals_ns[0, "R"]

    def is_steady(self, since_ns: int) -> bool:
        """Return whether the flow has been steady for ``STEADY_S``, all of it after a moment."""
        begin_ns = time.monotonic_ns() - round(STEADY_S * 1e9)
        if begin_ns < since_ns:
            return False
        late = [at_ns for at_ns in reversed(self._arrivals_ns[-4_000:]) if at_ns >= begin_ns]
        marks = [begin_ns, *reversed(late), time.monotonic_ns()]
        return len(late) > 1 and max(b - a for a, b in pairwise(marks)) < STEADY_GAP_S * 1e9

    def await_steady(self, since_ns: int, patience_s: float = PATIENCE_S) -> bool:
        """Return whether the flow became steady in time."""
        end_s = time.monotonic() + patience_s
        while not (is_steady := self.is_steady(since_ns)) and time.monotonic() < end_s:
            self._overlay.watch(LOOK_S, is_strict=True)
        return is_steady

    def silence_s(self, since_ns: int) -> float:
        """Return the longest time between consecutive arrivals, the last before a moment included; up to now."""
        before = [at_ns for at_ns in self._arrivals_ns if at_ns < since_ns][-1:]
        after = [at_ns for at_ns in self._arrivals_ns if at_ns >= since_ns]
        marks = [*before, *after] if after else [*(before or [since_ns]), time.monotonic_ns()]
        return max((b - a for a, b in pairwise(marks)), default=0) / 1e9


def measure_row(row: Row, rounds: int, options: Options) -> tuple[Rounds, list[Target]]:
    """Make the event of a row happen so often; return its figures and targets.

    Raises ``FailedError``: the network did not come up, or a process ended by itself. Raises ``GdpError``: the kernel
    refuses.
    """
    found, counts = Rounds(), Counter[str]()
    with new_run() as run, Overlay(run, row.plan(HZ)) as overlay:
        overlay.start_all()
        flow = Flowing(overlay)
        if not flow.await_steady(time.monotonic_ns()):
            raise FailedError(f"{row.what}: no steady flow before any event")
        # path computation waits longer in a network that has just started (RFC 8405)
        overlay.watch(options.settle_s, is_strict=True)
        for at in range(rounds):
            counts[NEVER] += _once(overlay, flow, row, at, found, options)
        books = overlay.books
        counts[PUBLISHED] = len(books.published[0, 1])
        overlay.watch(LAST_S, is_strict=True)
        account = books.accounts[0, "R", 1, 1]
        counts[LOST], counts[DOUBLED] = account.missing(counts[PUBLISHED]), account.doubled
        counts[REPORTED] = books.reported_losses[0, "R", 1]
    targets = []
    for what, target_s in ((row.what, row.target_s), (row.new_name, row.new_name_s)):
        if times_ms := [each for each in found.column(what, CASE, SILENCE) if each is not None]:
            found.add(what, CASE, P99, percentile(times_ms, 0.99))
            # A silence of nothing is compared with the row ``nothing``.
            target_ms = 1e3 * target_s if target_s else None
            targets.append(found.target(f"{what}: {P99}", what, CASE, P99, target_ms, at_most=True))
    for column in (PUBLISHED, LOST, REPORTED, DOUBLED, NEVER):
        found.add(row.what, CASE, column, counts[column])
    failed = counts[LOST] + counts[DOUBLED] + counts[NEVER]
    return found, [*targets, Target(f"{row.what}: lost, doubled or without return", 0, True, Spread.of([failed]))]


def _once(overlay: Overlay, flow: Flowing, row: Row, at: int, found: Rounds, options: Options) -> int:
    """Make the event happen once; return how often the flow did not come back, whose silence is that until then."""
    time.sleep(random.random() * PHASE_S)  # events hit any phase of every timer
    since_ns = time.monotonic_ns()
    row.fail(overlay, at)
    if row.new_name_s is not None:
        found.add(row.new_name, CASE, SILENCE, 1e3 * _new_name_s(overlay, at))
    if row.holds:
        overlay.watch(options.dead_s, is_strict=True)
    patience_s = 0.1 if row.holds and options.dead_s >= PATIENCE_S and not flow.is_steady(since_ns) else PATIENCE_S
    never = int(not flow.await_steady(since_ns, patience_s))
    silence_ms = 1e3 * flow.silence_s(since_ns)
    found.add(row.what, CASE, SILENCE, silence_ms)
    progress(f"  {at + 1}: {silence_ms:.1f} ms")
    if not overlay.active:
        return never
    since_ns = time.monotonic_ns()
    for fault in list(overlay.active):
        overlay.end(fault)
    never += not flow.await_steady(time.monotonic_ns())
    found.add(row.what, CASE, RETURN, 1e3 * flow.silence_s(since_ns))
    overlay.watch(options.settle_s, is_strict=True)
    return never


def _new_name_s(overlay: Overlay, at: int) -> float:
    """Make P publish, and R read, an unknown name; return the seconds until its first message."""
    arrivals_ns, begun_ns = overlay.books.arrivals_ns[1 + at, "R"], time.monotonic_ns()
    for who in ("member P", "member R"):
        overlay.processes[who].send(signal.SIGUSR1)
    while not arrivals_ns and time.monotonic_ns() < begun_ns + PATIENCE_S * 1e9:
        overlay.watch(LOOK_S, is_strict=True)
    return ((arrivals_ns or [time.monotonic_ns()])[0] - begun_ns) / 1e9


def measure_tunnels(rounds: int) -> tuple[Rounds, list[Target]]:
    """Change a robot's address in each way so often; return figures and targets, and raise, as ``measure_row``."""
    found, targets = Rounds(), list[Target]()
    with new_run() as run, ExitStack() as stack:
        robot, homes, flow = roaming_flow(run, stack)
        for what, act in ADDRESS_CHANGES.items():
            for at in range(rounds):
                time.sleep(ROAMS_EVERY_S)
                since_s = time.monotonic()
                act(robot, homes)
                found.add(TUNNELS_ROW, what, COMMANDS, 1e3 * (time.monotonic() - since_s))
                silence_ms = flow.silence_until_steady_ms(since_s, PATIENCE_S)
                found.add(TUNNELS_ROW, what, SILENCE, silence_ms)
                progress(f"  {what}, {at + 1}: {silence_ms:.0f} ms")
            times_ms = [each for each in found.column(TUNNELS_ROW, what, SILENCE) if each is not None]
            found.add(TUNNELS_ROW, what, P99, percentile(times_ms, 0.99))
            targets.append(found.target(f"{what}: {P99}", TUNNELS_ROW, what, P99, 1e3 * TUNNELS_S, at_most=True))
        flow.close()
    for column, count in ((PUBLISHED, len(flow.sent_s)), (LOST, flow.lost), (DOUBLED, flow.doubled)):
        found.add(TUNNELS_ROW, "whole run", column, count)
        target = None if column == PUBLISHED else 0.0
        targets.append(found.target(f"messages {column}", TUNNELS_ROW, "whole run", column, target, at_most=True))
    return found, targets


def measure(options: Options) -> Outcome:
    """Measure every row; one that fails is noted."""
    over, targets, notes = Rounds(), list[Target](), list[str]()
    for name in options.only or [*ROWS, TUNNELS]:
        row, rounds = ROWS.get(name), options.rounds
        if row is not None:
            rounds = min(rounds, NEW_TOPICS if row.new_name_s is not None else rounds, 3 if row.holds else rounds)
        progress(f"{name}: {row.what if row else TUNNELS_ROW}, {rounds} times")
        try:
            found, asked = measure_row(row, rounds, options) if row else measure_tunnels(rounds)
            over.values |= found.values
            targets += asked
        except GdpError as error:
            notes.append(f"{name}: {error}")
            progress(f"FAILED {notes[-1]}")
    settings = {"trouble": notes or "none"}
    title = "Silence when something fails or moves"
    return Outcome("survive", title, over, targets, settings, keeps_rows=True, has_failed=bool(notes))


if __name__ == "__main__":
    quick = {"rounds": 1, "dead_s": 3.0, "settle_s": 0.0}
    parser = command_line(__doc__, rounds=ROUNDS, quick=quick, has_record=True)
    parser.add_argument("--only", action="append", choices=[*ROWS, TUNNELS], help="this row; may be repeated")
    parser.set_defaults(dead_s=DEAD_S, settle_s=SETTLE_S)
    run_bench(parser, measure)
