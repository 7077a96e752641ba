"""Security bench: time until a revocation closes a flow.

Real processes in namespaces, three tiers of RIBs. A member publishes on many topics, and many members publish on one
topic each; one after the other loses its delegation (``gdp delegate revoke``) or its membership (``gdp cert revoke``).
The file is handed to one switch, of neither end's domain, by SIGHUP. Measured is the time from the signal, and from the
start of the command, to the last message that a reader got.

    sudo .venv/bin/python scripts/bench/security.py              # writes docs/benchmarks/security.json
    sudo .venv/bin/python scripts/bench/security.py --rounds 1 --no-save
"""

from __future__ import annotations

import random
import signal
import time
from typing import Final

from faults.overlay import LOOK_S, Overlay
from faults.plan import Flow, Plan
from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.metadata import Metadata
from gdp.stores.files import read_public
from gdp.stores.keyring import NODE_CERTIFICATE, load_owner
from lab.machine import gdp
from lab.process import new_run, until
from lab.topology import make_topology

TARGET_MS: Final = 1_000.0
CASE: Final = "until the last message of the closed flow"
SIGNAL, COMMAND, P99, OPEN = "from the signal, ms", "from the command, ms", "p99 from the signal, ms", "left open"
HZ: Final = 100.0
TOPICS: Final = 24
VICTIMS: Final = 6
HANDED_IN_AT: Final = "m2"
STEADY_S: Final = 60.0  # limit until every flow is read
AFTER_S: Final = 3.0  # time in which a closed flow must stay silent


def _plan() -> Plan:
    """Return three tiers: t over m and n, m over l, n over r; every domain has a RIB."""
    victims = [f"V{number}" for number in range(VICTIMS)]
    topology, members = make_topology(
        {"t": ("t1",), "m": ("m1", "m2"), "n": ("n1",), "l": ("l1",), "r": ("r1",)},
        {"m": "t", "n": "t", "l": "m", "r": "n"},
        ("m1-t1", "m2-m1", "n1-t1", "l1-m1", "r1-n1"),
        ("t1", "m1", "n1", "l1", "r1"),
        {"P": "l1", "R": "r1", **dict.fromkeys(victims, "l1")},
    )
    flows = [Flow(f"/of/P/{number}", "P", ("R",), hz=HZ) for number in range(TOPICS)]
    flows += [Flow(f"/of/{victim}", victim, ("R",), hz=HZ) for victim in victims]
    return Plan(topology, members, flows=tuple(flows))


def measure(options: Options) -> Outcome:
    """Close the flows of one network in each round."""
    over = Rounds()
    for number in range(options.rounds):
        progress(f"network {number + 1} of {options.rounds}")
        with new_run() as run, Overlay(run, _plan()) as overlay:
            overlay.start_all()
            _Closing(overlay).measure(over)
    targets = []
    for what in over.values:
        seconds = [each for each in over.column(what, CASE, SIGNAL) if each is not None]
        over.add(what, CASE, P99, percentile(seconds, 0.99))
        targets += [
            over.target(f"{what}: {P99}", what, CASE, P99, TARGET_MS, at_most=True),
            over.target(f"{what}: {OPEN}", what, CASE, OPEN, 0.0, at_most=True),
        ]
    settings = {"messages a second and flow": HZ}
    return Outcome("security", "From a revocation to the last message, three tiers", over, targets, settings)


class _Closing:
    """Closes the flows of one network, one after the other."""

    def __init__(self, overlay: Overlay) -> None:
        self._overlay = overlay

    def measure(self, over: Rounds) -> None:
        """Add the measurements. Raises ``FailedError``: the flows did not come up, or a process ended by itself."""
        flows, arrivals_ns = self._overlay.plan.flows, self._overlay.books.arrivals_ns
        until(
            lambda: len(arrivals_ns) == len(flows),
            lambda: f"{len(arrivals_ns)} of {len(flows)} flows are read",
            STEADY_S,
            lambda: self._overlay.watch(LOOK_S, is_strict=True),
        )
        order = list(range(len(flows)))
        random.Random(1).shuffle(order)
        for channel in order:
            what = "delegation" if flows[channel].publisher == "P" else "membership"
            time.sleep(0.2 + random.random() * 0.5)
            begun_ns, signalled_ns = self._revoke(channel)
            self._overlay.watch(AFTER_S, is_strict=True)
            last_ns = arrivals_ns[channel, "R"][-1]
            took_ms = max(last_ns - signalled_ns, 0) / 1e6
            over.add(what, CASE, SIGNAL, took_ms)
            over.add(what, CASE, COMMAND, (last_ns - begun_ns) / 1e6)
            over.add(what, CASE, OPEN, float(last_ns > signalled_ns + round((AFTER_S - 0.5) * 1e9)))
            progress(f"  {flows[channel].topic}: {took_ms:.0f} ms")

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
        gdp(*words)
        read_public(out)
        signalled_ns = time.monotonic_ns()
        self._overlay.processes[f"switch {HANDED_IN_AT}"].send(signal.SIGHUP)
        return begun_ns, signalled_ns


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=3, quick={"rounds": 1}, has_record=True)
    run_bench(parser, measure)
