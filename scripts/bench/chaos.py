"""Chaos bench: faults of every kind in a network of real processes, drawn from a seed; afterwards all flows must work.

A random network of 12 to 20 switches, four domains, three tiers, several RIBs, two services with replicas, reliable and
best-effort topics (``faults/plan.py``). It gets overlapping faults (``faults/schedule.py``). Flows that graph and
policy leave connected (``faults/plan.py``) must continue. Promises:

    after the last fault    every flow that must be connected delivers again within a second, and stays so; with
                            --thin within two, if a queue holds 200 ms
    meanwhile               no silence above --limit-s where both ends were connected all the time
    nothing                 reaches a wrong reader, or comes twice; nothing of the revoked member after three seconds
    reliable flows          are complete from the first message that came, or the reader got a report of each loss
    requests                each has one answer, or one error
    snapshots               a RIB logs once that its disk is full, and when it writes again; it still starts
    the cluster             no server logs that it lost data

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
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from faults.accounts import Continuity, Silence
from faults.overlay import KILLS, LOOK_S, Overlay
from faults.plan import VICTIM, Oracle, Plan, random_network
from faults.schedule import make_schedule
from faults.store import NOT_WRITTEN, has_server, snapshot_faults
from report import percentile, print_table, progress
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
REPORTED_S: Final = 0.25  # shorter silences are not reported
SPARSE: Final = 1.5  # nor those of a flow that are shorter than so many of its periods
CALL_S: Final = 5.0
LOG_LINES: Final = 12
_CLUSTER_EVERY: Final = 3  # one in so many seeds gets a cluster
_PRESSURE: Final = Path("/proc/pressure/cpu")
SHORT: Final = {kind.name.lower().replace("_", "-"): kind for kind in FaultKind}


class Chaos:
    """One run: a network, its faults, and the records.

    ``overlay``: of the plan, started. ``faults``: in the order of their starts.
    """

    def __init__(self, overlay: Overlay, faults: list[Fault]) -> None:
        self._overlay, self._plan = overlay, overlay.plan
        self._faults = faults
        self._oracle = Oracle(self._plan)
        self.books = overlay.books
        self._under_way: list[Fault] = []
        self._ended_lives: set[tuple[str, int]] = set()
        self._continuity = Continuity(self._plan, self.books)
        self.moments: list[tuple[int, Fault, bool]] = []  # time, fault, whether it began
        self.begun_ns = 0
        self.late_s = 0.0  # total delay of faults and restarts against the schedule
        self.waited_share = 0.0  # share of the run in which a process was ready and had no processor
        self.revoked_ns: int | None = None

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
        begun_s, waited_s = time.monotonic(), _waited_s()
        self.begun_ns = time.monotonic_ns()
        self._note()
        for at_s, fault, begins in moments(self._faults):
            due_s = begun_s + at_s + self.late_s
            self.late_s += max(time.monotonic() - due_s, 0.0)
            self._overlay.watch(due_s - time.monotonic())
            progress(f"{at_s:7.2f} s  {'+' if begins else '-'} {fault.kind.value}: {', '.join(fault.targets)}")
            if begins:
                self._under_way.append(fault)
                if fault.kind in KILLS:
                    who = fault.targets[0]
                    self._ended_lives.add((who.removeprefix("member "), self._overlay.incarnation_ids[who]))
                self._overlay.begin(fault)
                if fault.kind is FaultKind.REVOKE:
                    self.revoked_ns = time.monotonic_ns()
            else:
                self._overlay.end(fault)
                self._under_way.remove(fault)
            self.moments.append((time.monotonic_ns(), fault, begins))
            self._note()
        self._overlay.watch(AFTER_S)
        self.waited_share = (_waited_s() - waited_s) / (time.monotonic() - begun_s)

    def broken_promises(self, limit_s: float, full_s: float = 0.0) -> list[str]:
        """Return what broke, in words.

        ``limit_s``: longest silence of connected ends during faults. ``full_s``: longest wait in a link's queue, if
        links are kept full.
        """
        last_ns, end_ns = self.moments[-1][0] if self.moments else self.begun_ns, time.monotonic_ns()
        found = [f"{who} ended by itself" for who in self._overlay.died()]
        well_s = WELL_S + WELL_TRIPS * full_s
        well_ns = last_ns + round(well_s * 1e9)
        found += self._continuity.broken_promises(self.begun_ns, last_ns, end_ns, limit_s, well_s)
        found += sorted(set(self.books.wrong))
        found += self.books.incomplete(self._is_last_life, end_ns - round(2e9))
        over_ns = end_ns - round((CALL_S + 1) * 1e9)
        found += self.books.miscalled(
            over_ns, lambda member, incarnation_id: (member, incarnation_id) in self._ended_lives
        )
        if failed := self.books.failed_since(well_ns):
            found.append(f"after the last fault: {failed} calls failed")
        if self._overlay.store is not None:
            found += self._overlay.store.complaints()
        return [*found, *self._after_revocation(), *self._of_snapshots()]

    def noticed(self) -> int:
        """Return how often a RIB logged that its snapshot is not written."""
        logs = (log for node in self._plan.ribs for _, log in self._overlay.logs(f"rib {node}"))
        return sum(log.count(NOT_WRITTEN) for log in logs)

    def silences(self) -> list[tuple[str, Silence]]:
        """Return the silences of the run, each with the last event before it."""
        found = []
        for silence in self._continuity.silences(self.begun_ns, time.monotonic_ns(), REPORTED_S):
            if silence.seconds < SPARSE / self._plan.flows[silence.channel].hz:
                continue
            before = [each for each in self.moments if each[0] <= silence.begin_ns + round(1e9)]
            _, fault, begins = before[-1] if before else (0, None, True)
            over = "" if begins else ", over"
            found.append(("before any" if fault is None else fault.kind.value + over, silence))
        return found

    def _is_last_life(self, member: str, incarnation_id: int) -> bool:
        """Return whether what this incarnation of a member sends and receives continues to the end of the run."""
        is_revoked = member == VICTIM and self.revoked_ns is not None
        return incarnation_id == self._overlay.incarnation_ids[f"member {member}"] and not is_revoked

    def _unreachable(self) -> list[str]:
        silent = self._continuity.unreached()
        return silent if silent or self.books.answered or not self._plan.services else ["any answer"]

    def _note(self) -> None:
        """Record what must be connected from now on."""
        at = {mover: self._overlay.at[mover] for mover in self._plan.homes}
        broken = broken_by(self._under_way, at)
        if self.revoked_ns is not None:
            broken.members.add(VICTIM)
        self._continuity.note(time.monotonic_ns(), broken)

    def _after_revocation(self) -> list[str]:
        if self.revoked_ns is None:
            return []
        late_ns = self.revoked_ns + round(REVOKED_S * 1e9)
        found = []
        for channel, publisher, reader in self._oracle.pairs():
            if VICTIM in (publisher, reader):
                late = sum(at_ns > late_ns for at_ns in self.books.arrivals_ns[channel, reader])
                if late:
                    found.append(f"{late} messages from the revoked {publisher} to {reader}, {REVOKED_S:g} s after")
        return found

    def _of_snapshots(self) -> list[str]:
        """Return the errors of RIBs about their snapshots."""
        if self._overlay.disk is None:
            return []
        found = [f"{name}: a snapshot that its RIB could not make sense of" for name in self._overlay.disk.broken()]
        for node in self._plan.ribs:
            who = f"rib {node}"
            for incarnation_id, log in self._overlay.logs(who):
                if self._overlay.keeps_snapshot(node):
                    is_alive = incarnation_id == self._overlay.incarnation_ids[who] and who in self._overlay.processes
                    found += snapshot_faults(f"{who} (life {incarnation_id})", log, is_alive=is_alive)
        if not self.noticed() and any(fault.kind is FaultKind.DISK_FULL for fault in self._faults):
            found.append("no RIB noticed that the disk was full")
        return found


def run_seed(seed: int, options: Options) -> list[str]:
    """Run one seed; print its table; return what broke.

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
        _show(seed, chaos)
        if broke:
            _explain(seed, faults, broke, overlay)
            overlay.save_journals(folder := options.journals / f"seed-{seed}")
            print(f"what came in at each switch and RIB: gdp incident show {folder}/*.incident, or replay")
            if options.logs is not None:
                secret = shutil.ignore_patterns("domains", "nodes", "owner")
                shutil.copytree(run.directory, options.logs / f"seed-{seed}", ignore=secret, dirs_exist_ok=True)
    return broke


def _waited_s() -> float:
    """Return the seconds since boot in which some process waited for a processor; 0 if unknown.

    Source: Linux, Documentation/accounting/psi.rst.
    """
    with suppress(OSError):
        some = _PRESSURE.read_text(encoding="ascii").splitlines()[0]
        return int(some.rpartition("total=")[2]) / 1e6
    return 0.0


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


def _show(seed: int, chaos: Chaos) -> None:
    by: defaultdict[str, list[float]] = defaultdict(list)
    for what, silence in chaos.silences():
        by[what].append(silence.seconds)
    counts: defaultdict[str, int] = defaultdict(int)
    for _, fault, begins in chaos.moments:
        counts[fault.kind.value + ("" if begins else ", over")] += 1
    rows = []
    for what in sorted(counts | dict.fromkeys(by, 0)):
        seconds = by.get(what, [])
        if seconds or not what.endswith("over"):
            figures = [f"{percentile(seconds, 0.5):.2f}", f"{max(seconds):.2f}"] if seconds else ["", ""]
            rows.append((what, str(counts[what]), str(len(seconds)), *figures))
    calls, answered, failed = chaos.books.calls()
    delivered = sum(len(each) for each in chaos.books.arrivals_ns.values())
    reported_losses = sum(chaos.books.reported_losses.values())
    title = f"seed {seed}: silences above {REPORTED_S:g} s while connected, s"
    print_table(("last event before", "events", "silences", "p50", "max"), rows, title=title)
    called = f"{calls} calls: {answered} answered, {failed} failed"
    print(f"{delivered} messages delivered, {reported_losses} reported lost; {called}")
    waited = f"{chaos.waited_share:.0%} of the time some process on this machine waited for a processor"
    print(f"the schedule was {chaos.late_s:.1f} s late in the end; {waited}")
    print(f"{chaos.noticed()} times a RIB said that its snapshot is not written")


def _explain(seed: int, faults: list[Fault], broke: list[str], overlay: Overlay) -> None:
    print(f"\nseed {seed} broke:", *(f"  {each}" for each in broke), sep="\n")
    print("its faults:", *(f"  {each}" for each in faults), sep="\n")
    touched = {target for fault in faults for target in fault.targets if " " in target}
    for who in sorted(touched & set(overlay.everybody())):
        tail = overlay.log_tail(who, LOG_LINES)
        if tail:
            print(f"{who}:", *(f"    {line}" for line in tail.splitlines()), sep="\n")


def main() -> None:
    """Run seeds; exit 1 when one failed."""
    parser = command_line(__doc__, seconds=SECONDS, seconds_of="of faults in each run")
    parser.add_argument("--seed", type=int, action="append", help="a run of this seed; may be repeated (default: 1)")
    parser.add_argument("--hours", type=float, help="seed after seed, from the first on, for so long")
    parser.add_argument("--switches", type=int, default=14, help="12 to 20 (default: %(default)s)")
    parser.add_argument(
        "--rate", type=float, default=1.0, help="factor on all rates of messages (default: %(default)s)"
    )
    parser.add_argument(
        "--limit-s", type=float, default=LIMIT_S, help="longest silence meanwhile (default: %(default)s)"
    )
    parser.add_argument("--only", action="append", choices=list(SHORT), help="this kind of fault; may be repeated")
    parser.add_argument(
        "--cluster",
        action=argparse.BooleanOptionalAction,
        help="RIBs of the top domain share a Valkey or Redis Cluster (default: for every third seed, if installed)",
    )
    parser.add_argument(
        "--thin", type=float, metavar="MBIT_S", help="rate of all links between switches, which images then keep full"
    )
    parser.add_argument(
        "--fifo-ms", type=float, default=200.0, help="depth of the FIFO of such a link (default: %(default)s)"
    )
    parser.add_argument("--one-rib", action="store_true", help="one RIB in each domain")
    parser.add_argument(
        "--keepalive-ms",
        type=int,
        help="of switches; longer ones leave a slow machine more time (default: that of gdp-switch)",
    )
    parser.add_argument(
        "--journals",
        type=Path,
        default=Path(tempfile.gettempdir(), "gdp-chaos"),
        help="a folder for the journals of a failed run (default: %(default)s)",
    )
    parser.add_argument("--logs", type=Path, help="a folder to copy the logs of a failed run to")
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
