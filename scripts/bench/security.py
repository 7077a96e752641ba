"""Security bench: time until a revocation closes a flow.

Real processes in namespaces, three tiers of RIBs. A member publishes on many topics, and many members publish on one
topic each; one after the other loses its delegation (``gdp delegate revoke``) or its membership (``gdp cert revoke``).
The file is handed to one switch, of neither end's domain, by SIGHUP. Measured is the time from the signal, and from the
start of the command, to the last message that a reader got.

    sudo .venv/bin/python scripts/bench/security.py revocation                        # docs/benchmarks/security.json
    sudo .venv/bin/python scripts/bench/security.py revocation --rounds 1 --no-save
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any, Final

from faults.overlay import Overlay
from faults.plan import Flow, Plan
from faults.records import Kind
from machine import MachineState, machine_state
from preconditions import require_trust, require_writable
from report import percentile, print_table, progress
from skeleton import OUTPUT, clean_exit, command_line, new_run
from topologies import make_topology

from gdp.host.run_registry import RunRegistry
from gdp.metadata import Metadata
from gdp.stores.files import read_public
from gdp.stores.keyring import NODE_CERTIFICATE, load_owner
from lab.process import FailedError, until

TARGET_S: Final = 1.0  # target at the 99th percentile, from the signal to the last message
HZ: Final = 100.0
TOPICS: Final = 24
VICTIMS: Final = 6
HANDED_IN_AT: Final = "m2"
STEADY_S: Final = 60.0  # limit until every flow is read
AFTER_S: Final = 3.0  # time in which a closed flow must stay silent


def _plan(hz: float) -> Plan:
    """Return three tiers: t over m and n, m over l, n over r; every domain has a RIB."""
    victims = [f"V{number}" for number in range(VICTIMS)]
    topology, members = make_topology(
        {"t": ("t1",), "m": ("m1", "m2"), "n": ("n1",), "l": ("l1",), "r": ("r1",)},
        {"m": "t", "n": "t", "l": "m", "r": "n"},
        ("m1-t1", "m2-m1", "n1-t1", "l1-m1", "r1-n1"),
        ("t1", "m1", "n1", "l1", "r1"),
        {"P": "l1", "R": "r1", **dict.fromkeys(victims, "l1")},
    )
    flows = [Flow(f"/of/P/{number}", "P", ("R",), hz=hz) for number in range(TOPICS)]
    flows += [Flow(f"/of/{victim}", victim, ("R",), hz=hz) for victim in victims]
    return Plan(topology, members, flows=tuple(flows))


def _closed(options: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, list[float]] = {"delegation": [], "delegation_command": [], "membership": []}
    found["membership_command"] = []
    late = 0
    runs = RunRegistry()
    runs.sweep()
    for number in range(options.rounds):
        progress(f"closed: network {number + 1} of {options.rounds}")
        with new_run(runs) as run_, Overlay(run_, _plan(options.hz), plane=options.plane) as overlay:
            overlay.start_all()
            late += _Closing(overlay).measure(found)
    return {"target_s": TARGET_S, "hz": options.hz, "not_closed": late, **found}


class _Closing:
    """Closes the flows of one network, one after the other."""

    def __init__(self, overlay: Overlay) -> None:
        self._overlay = overlay
        self._last_ns: dict[int, int] = {}  # by channel: when R got the last message

    def measure(self, found: dict[str, list[float]]) -> int:
        """Add the measurements; return how many flows were not closed.

        Raises:
            FailedError: the flows did not come up, or a process ended by itself.
        """
        flows = self._overlay.plan.flows
        until(
            lambda: len(self._last_ns) == len(flows),
            lambda: f"{len(self._last_ns)} of {len(flows)} flows are read",
            STEADY_S,
            lambda: self._watch(0.1),
        )
        order = list(range(len(flows)))
        random.Random(1).shuffle(order)
        late = 0
        for channel in order:
            what = "delegation" if flows[channel].publisher == "P" else "membership"
            time.sleep(0.2 + random.random() * 0.5)
            begun_ns, signalled_ns = self._revoke(channel)
            self._watch(AFTER_S)
            last_ns = self._last_ns[channel]
            late += last_ns > signalled_ns + round((AFTER_S - 0.5) * 1e9)
            found[what].append(max(last_ns - signalled_ns, 0) / 1e9)
            found[f"{what}_command"].append((last_ns - begun_ns) / 1e9)
            progress(f"  {flows[channel].topic}: {found[what][-1] * 1e3:.0f} ms")
        return late

    def _revoke(self, channel: int) -> tuple[int, int]:
        """Revoke by the command, and hand the file in; return when each began, in monotonic nanoseconds."""
        flow, folder = self._overlay.plan.flows[channel], self._overlay.directory
        node = folder / "nodes" / f"proxy-{flow.publisher}"
        out = folder / "revocations" / f"{channel}.revoke"
        if flow.publisher == "P":
            name = load_owner(folder / "owner").subject(Metadata({"kind": "topic", "name": flow.topic})).name
            file = node / "delegations" / f"{name.to_text()}.delegation"
            words = ["delegate", "revoke", str(file), "--owner", str(folder / "owner"), "--out", str(out)]
        else:
            label = self._overlay.plan.topology.domain_of(flow.publisher).label
            domain = folder / "domains" / label
            words = ["cert", "revoke", str(node / NODE_CERTIFICATE), "--domain", str(domain), "--out", str(out)]
        begun_ns = time.monotonic_ns()
        done = subprocess.run([sys.executable, "-m", "gdp.cli.gdp", *words], capture_output=True, check=False)
        if done.returncode:
            raise FailedError(f"gdp {' '.join(words)}: {done.stderr.decode(errors='replace')[-200:]}")
        read_public(out)
        signalled_ns = time.monotonic_ns()
        self._overlay.signal(f"switch {HANDED_IN_AT}", signal.SIGHUP)
        return begun_ns, signalled_ns

    def _watch(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            time.sleep(0.1)
            self._look()

    def _look(self) -> None:
        for who in self._overlay.died():
            raise FailedError(f"{who} ended by itself: {self._overlay.log_tail(who)}")
        for each in chain.from_iterable(records for _, records in self._overlay.read("R")):
            if each.kind == Kind.DELIVERED:
                self._last_ns[each.channel] = max(each.at_ns, self._last_ns.get(each.channel, 0))
        for member in self._overlay.plan.members:
            if member != "R":
                for _ in chain.from_iterable(records for _, records in self._overlay.read(member)):
                    continue


def _show_closed(found: dict[str, Any]) -> bool:
    rows = list[tuple[str, ...]]()
    has_met = not found["not_closed"]
    for what in ("delegation", "membership"):
        for since, key, target_s in (("the signal", what, found["target_s"]), ("the command", f"{what}_command", None)):
            seconds = found[key]
            p50, p99 = percentile(seconds, 0.5), percentile(seconds, 0.99)
            is_met = target_s is None or p99 <= target_s
            has_met = has_met and is_met
            figures = (f"{p50 * 1e3:.0f}", f"{p99 * 1e3:.0f}", f"{max(seconds) * 1e3:.0f}")
            asked = "" if target_s is None else f"≤ {target_s * 1e3:g}"
            rows.append((what, since, asked, str(len(seconds)), *figures, "" if target_s is None else _yes(is_met)))
    head = ("revoked", "from", "to reach", "flows", "p50 ms", "p99 ms", "max ms", "met")
    print_table(head, rows, title="From a revocation to the last message of the closed flow, three tiers", words=2)
    print(f"flows that were not closed: {found['not_closed']}")
    return has_met


def _yes(is_met: bool) -> str:
    return "yes" if is_met else "NO"


def save(path: Path, figures: Mapping[str, object], state: MachineState) -> None:
    """Write the figures under the name of the subcommand."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    document |= {"bench": "security", "revocation": {"closed": figures, "machine": asdict(state)}}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command_line(__doc__, rounds=3, has_record=True)
    parser.add_argument("command", choices=["revocation"])
    parser.add_argument("--hz", type=float, default=HZ, help="messages a second and flow (default: %(default)s)")
    parser.add_argument("--plane", default="auto", help="as gdp-switch --data-plane (default: %(default)s)")
    return parser


def main() -> None:
    """Measure, show and save."""
    options, state = arguments().parse_args(), machine_state()
    path = options.json or OUTPUT / "security.json"
    with clean_exit():
        if not options.no_save:
            require_writable(path.parent)
            require_trust(state, allow_load=options.allow_load)
        closed = _closed(options)
    has_met = _show_closed(closed)
    if not options.no_save:
        save(path, closed, state)
    sys.exit(options.strict and not has_met)


if __name__ == "__main__":
    main()
