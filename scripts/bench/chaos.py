"""Chaos bench: faults of every kind in a network of real processes, drawn from a seed; afterwards all flows must work.

A random network of 12 to 20 switches, four domains, three tiers, several RIBs, two services with replicas, reliable and
best-effort topics (``faults/plan.py``). It gets overlapping faults (``faults/schedule.py``). Flows that graph and
policy leave connected (``faults/plan.py``) must continue. docs/how-to/chaos.md lists the promises.

    sudo .venv/bin/python scripts/bench/chaos.py --seed 7                    # one minute
    sudo .venv/bin/python scripts/bench/chaos.py --seed 7 --seconds 300 --switches 20
    sudo .venv/bin/python scripts/bench/chaos.py --hours 3                   # seed after seed
    sudo .venv/bin/python scripts/bench/chaos.py --seed 7 --only cut --only roam
    sudo .venv/bin/python scripts/bench/chaos.py --seed 7 --cluster          # RIBs share a Valkey or Redis Cluster
    sudo .venv/bin/python scripts/bench/chaos.py --seed 7 --thin 4           # all links are thin and full

A run that fails prints its seed, its faults, what broke, and the last lines of the logs, and saves the journals of
its switches and RIBs, which ``gdp incident replay`` runs again; the seed draws the same again.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from faults.accounts import Continuity
from faults.overlay import LOOK_S, Overlay
from faults.plan import VICTIM, Oracle, Plan, random_network
from faults.schedule import make_schedule
from faults.store import NOT_WRITTEN, has_server, snapshot_faults
from report import progress
from skeleton import Options, clean_exit, command_line

from gdp.errors import GdpError
from gdp.host.run_registry import RunRegistry
from lab.faults import Fault, FaultKind, broken_by, moments
from lab.process import FailedError, new_run, until

SECONDS: Final = 60.0
AFTER_S: Final = 8.0  # observation after the last fault
WELL_S: Final = 1.0  # limit after the last fault until all flows work again
WELL_TRIPS: Final = 5  # ... and on full links so many waits in a queue: each exchange of a join and a reader takes one
LIMIT_S: Final = 5.0
REVOKED_S: Final = 3.0
SETTLE_S: Final = 60.0
IMAGE_SHARE: Final = 2.0  # of a thin link, as much as images offer
CALL_S: Final = 5.0
LOG_LINES: Final = 12
_CLUSTER_EVERY: Final = 3  # one in so many seeds gets a cluster
SHORT: Final = {kind.name.lower().replace("_", "-"): kind for kind in FaultKind}


class Chaos:
    """One run: a network, its faults, and the records.

    ``overlay``: of the plan, started. ``faults``: in the order of their starts.
    """

    def __init__(self, overlay: Overlay, faults: list[Fault]) -> None:
        self._overlay, self._plan = overlay, overlay.plan
        self._faults = faults
        self.books = overlay.books
        self._continuity = Continuity(self._plan, self.books)
        self._begun_ns = self._last_ns = 0  # of the first and the last event
        self._revoked_ns: int | None = None

    def settle(self) -> None:
        """Return when every flow is delivered and every service responds. Raises ``FailedError``: not in time."""
        until(
            lambda: not self._unreachable(),
            lambda: f"before any fault: {', '.join(self._unreachable())}",
            SETTLE_S,
            lambda: self._overlay.watch(LOOK_S),
        )

    def run(self) -> None:
        """Apply the faults, each at its time, and observe for a while after the last.

        A delay postpones all later faults, so that their distances stay as drawn.
        """
        begun_s = time.monotonic()
        self._begun_ns = self._note()
        for at_s, fault, begins in moments(self._faults):
            begun_s += max(time.monotonic() - begun_s - at_s, 0.0)
            self._overlay.watch(begun_s + at_s - time.monotonic())
            progress(f"{at_s:7.2f} s  {'+' if begins else '-'} {fault.kind.value}: {', '.join(fault.targets)}")
            (self._overlay.begin if begins else self._overlay.end)(fault)
            if fault.kind is FaultKind.REVOKE:
                self._revoked_ns = time.monotonic_ns()
            self._last_ns = self._note()
        self._overlay.watch(AFTER_S)

    def broken_promises(self, limit_s: float, full_s: float = 0.0) -> list[str]:
        """Return what broke, in words.

        ``limit_s``: longest silence of connected ends during faults. ``full_s``: longest wait in a link's queue, if
        links are kept full.
        """
        last_ns, end_ns = self._last_ns or self._begun_ns, time.monotonic_ns()
        found = [f"{who} ended by itself" for who in self._overlay.died()]
        well_s = WELL_S + WELL_TRIPS * full_s
        found += self._continuity.broken_promises(self._begun_ns, last_ns, end_ns, limit_s, well_s)
        found += sorted(set(self.books.wrong))
        found += self.books.incomplete(self._goes_on, end_ns - round(2e9))
        found += self.books.miscalled(end_ns - round((CALL_S + 1) * 1e9), self._is_last_life)
        if failed := self.books.failed_since(last_ns + round(well_s * 1e9)):
            found.append(f"after the last fault: {failed} calls failed")
        if self._overlay.store is not None:
            found += self._overlay.store.complaints()
        return [*found, *self._after_revocation(), *self._of_snapshots()]

    def noticed(self) -> int:
        """Return how often a RIB logged that its snapshot is not written."""
        logs = (log for node in self._plan.ribs for _, log in self._overlay.logs(f"rib {node}"))
        return sum(log.count(NOT_WRITTEN) for log in logs)

    def _is_last_life(self, member: str, incarnation_id: int) -> bool:
        return incarnation_id == len(self._overlay.lives[f"member {member}"])

    def _goes_on(self, member: str, incarnation_id: int) -> bool:
        """Return whether what this incarnation of a member sends and receives continues to the end of the run."""
        is_revoked = member == VICTIM and self._revoked_ns is not None
        return self._is_last_life(member, incarnation_id) and not is_revoked

    def _unreachable(self) -> list[str]:
        silent = self._continuity.unreached()
        return silent if silent or self.books.answered or not self._plan.services else ["any answer"]

    def _note(self) -> int:
        """Record what must be connected from now on; return the moment."""
        at = {mover: self._overlay.at[mover] for mover in self._plan.homes}
        broken, now_ns = broken_by(self._overlay.active, at), time.monotonic_ns()
        if self._revoked_ns is not None:
            broken.members.add(VICTIM)
        self._continuity.note(now_ns, broken)
        return now_ns

    def _after_revocation(self) -> Iterator[str]:
        if self._revoked_ns is not None:
            late_ns = self._revoked_ns + round(REVOKED_S * 1e9)
            for channel, publisher, reader in Oracle(self._plan).pairs():
                late = sum(at_ns > late_ns for at_ns in self.books.arrivals_ns[channel, reader])
                if late and VICTIM in (publisher, reader):
                    yield f"{late} messages from the revoked {publisher} to {reader}, {REVOKED_S:g} s after"

    def _of_snapshots(self) -> Iterator[str]:
        """Yield the errors of RIBs about their snapshots."""
        if self._overlay.disk is None:
            return
        for name in self._overlay.disk.broken():
            yield f"{name}: a snapshot that its RIB could not make sense of"
        for node in filter(self._overlay.keeps_snapshot, self._plan.ribs):
            who, lives = f"rib {node}", list(self._overlay.logs(f"rib {node}"))
            for number, log in lives:
                is_alive = number == len(lives) and who in self._overlay.processes
                yield from snapshot_faults(f"{who} (life {number})", log, is_alive=is_alive)
        if not self.noticed() and any(fault.kind is FaultKind.DISK_FULL for fault in self._faults):
            yield "no RIB noticed that the disk was full"


def run_seed(seed: int, options: Options) -> list[str]:
    """Run one seed; print what it did; return what broke.

    Raises ``FailedError``: the network did not come up. Raises ``GdpError``: the kernel refuses.
    """
    thin_bits_s = 1e6 * (options.thin or 0.0)
    plan = random_network(
        seed, options.switches, rate=options.rate, one_rib=options.one_rib, image_bits_s=IMAGE_SHARE * thin_bits_s
    )
    kinds = [SHORT[name] for name in options.only] if options.only else None
    in_store = _in_store(plan, seed, is_wanted=options.cluster)
    faults = make_schedule(plan, seed, options.seconds, kinds=kinds, has_store=bool(in_store))
    more = {"switch": {"keepalive_ms": options.keepalive_ms}} if options.keepalive_ms else {}
    begun_s = time.monotonic()
    with (
        new_run() as run,
        Overlay(run, plan, has_clocks=True, has_journals=True, has_disk=True, in_store=in_store, more=more) as overlay,
    ):
        overlay.start_all()
        progress(f"seed {seed}: {len(plan.switches)} switches, {len(plan.ribs)} RIBs, {len(plan.members)} members up")
        chaos = Chaos(overlay, faults)
        chaos.settle()
        if thin_bits_s:
            between = [link for link in plan.topology.links if {link.a, link.b} <= set(plan.switches)]
            for link in between:
                overlay.make_thin(link.a, link.b, thin_bits_s, options.fifo_ms / 1e3)
            progress(f"{len(between)} links have {options.thin:g} Mbit/s and a FIFO of {options.fifo_ms:g} ms")
        progress(f"everything is delivered after {time.monotonic() - begun_s:.1f} s; {len(faults)} faults")
        try:
            chaos.run()
            broke = chaos.broken_promises(options.limit_s, options.fifo_ms / 1e3 if thin_bits_s else 0.0)
        except FailedError as error:
            broke = [str(error)]
        _show(seed, faults, chaos)
        if broke:
            _explain(seed, faults, broke, overlay)
            overlay.save_journals(folder := options.journals / f"seed-{seed}")
            print(f"what came in at each switch and RIB: gdp incident show {folder}/*.incident, or replay")
            if options.logs is not None:
                secret = shutil.ignore_patterns("domains", "nodes", "owner")
                shutil.copytree(run.directory, options.logs / f"seed-{seed}", ignore=secret, dirs_exist_ok=True)
    return broke


def _in_store(plan: Plan, seed: int, *, is_wanted: bool | None) -> list[str]:
    """Return the switches whose RIBs share a cluster: those of the top domain, or none.

    ``is_wanted``: None: for every third seed, where a server is installed. Raises ``FailedError``: it is wanted, and no
    server is installed.
    """
    if is_wanted and not has_server():
        raise FailedError("neither valkey-server nor redis-server is installed")
    if not (has_server() and seed % _CLUSTER_EVERY == 0 if is_wanted is None else is_wanted):
        return []
    return [node for node in plan.ribs if plan.topology.domain_of(node).upper is None]


def _show(seed: int, faults: list[Fault], chaos: Chaos) -> None:
    counts = Counter(fault.kind.value for fault in faults)
    print(f"seed {seed}: {', '.join(f'{what} {count}' for what, count in sorted(counts.items()))}")
    calls, answered, failed = chaos.books.calls()
    delivered = sum(len(each) for each in chaos.books.arrivals_ns.values())
    reported_losses = sum(chaos.books.reported_losses.values())
    called = f"{calls} calls: {answered} answered, {failed} failed"
    print(f"{delivered} messages delivered, {reported_losses} reported lost; {called}")
    print(f"{chaos.noticed()} times a RIB said that its snapshot is not written")


def _explain(seed: int, faults: list[Fault], broke: list[str], overlay: Overlay) -> None:
    print(f"\nseed {seed} broke:", *(f"  {each}" for each in broke), sep="\n")
    print("its faults:", *(f"  {each}" for each in faults), sep="\n")
    touched = {target for fault in faults for target in fault.targets}
    for who in sorted(touched & overlay.lives.keys()):
        print(overlay.lives[who][-1].failed("logged at the end", LOG_LINES))


def main() -> None:
    """Run seeds; exit 1 when one failed."""
    parser = command_line(__doc__, seconds=SECONDS, seconds_of="of faults in each run")
    parser.add_argument("--seed", type=int, action="append", help="a run of this seed; may be repeated (default: 1)")
    parser.add_argument("--only", action="append", choices=list(SHORT), help="this kind of fault; may be repeated")
    parser.add_argument("--one-rib", action="store_true", help="one RIB in each domain")
    text = "RIBs of the top domain share a Valkey or Redis Cluster (default: for every third seed, if installed)"
    parser.add_argument("--cluster", action=argparse.BooleanOptionalAction, help=text)
    for name, value, text in (
        ("--hours", float, "seed after seed, from the first on, for so long"),
        ("--thin", float, "Mbit/s of all links between switches, which images then keep full"),
        ("--keepalive-ms", int, "of switches (default: that of gdp-switch); longer ones suit a slow machine"),
        ("--logs", Path, "a folder to copy the logs of a failed run to"),
    ):
        parser.add_argument(name, type=value, help=text)
    for name, default, text in (
        ("--switches", 14, "12 to 20"),
        ("--rate", 1.0, "factor on all rates of messages"),
        ("--limit-s", LIMIT_S, "longest silence meanwhile"),
        ("--fifo-ms", 200.0, "depth of the FIFO of a thin link"),
        ("--journals", Path(tempfile.gettempdir(), "gdp-chaos"), "a folder for the journals of a failed run"),
    ):
        parser.add_argument(name, type=type(default), default=default, help=f"{text} (default: %(default)s)")
    options = parser.parse_args()
    broken: list[int] = []
    with clean_exit():
        RunRegistry().sweep()  # remains of a killed run
        for seed in _seeds(options.seed or [1], options.hours, time.monotonic):
            try:
                broke = run_seed(seed, options)
            except GdpError as error:
                print(f"seed {seed}: {error}")
                broke = [str(error)]
            broken += [seed] if broke else []
    print(f"broken seeds: {broken}" if broken else "all is well")
    sys.exit(bool(broken))


def _seeds(first: list[int], hours: float | None, now_s: Callable[[], float]) -> Iterator[int]:
    yield from first
    end_s = now_s() + (hours or 0.0) * 3_600
    seed = max(first)
    while now_s() < end_s:
        seed += 1
        yield seed


if __name__ == "__main__":
    main()
