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
from pathlib import Path
from typing import Final

from faults.overlay import LOOK_S, Overlay
from faults.plan import Flow, Plan
from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.metadata import Metadata
from gdp.stores.files import read_public
from gdp.stores.keyring import load_owner
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
            _close_flows(overlay, over)
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


def _close_flows(overlay: Overlay, over: Rounds) -> None:
    """Close the flows of one network, one after the other.

    Raises ``FailedError``: the flows did not come up, or a process ended by itself.
    """
    flows, arrivals_ns = overlay.plan.flows, overlay.books.arrivals_ns
    until(
        lambda: len(arrivals_ns) == len(flows),
        lambda: f"{len(arrivals_ns)} of {len(flows)} flows are read",
        STEADY_S,
        lambda: overlay.watch(LOOK_S, is_strict=True),
    )
    order = list(range(len(flows)))
    random.Random(1).shuffle(order)
    for channel in order:
        is_delegation = flows[channel].publisher == "P"
        what = "delegation" if is_delegation else "membership"
        words = _revocation(overlay, flows[channel]) if is_delegation else overlay.revocation(flows[channel].publisher)
        time.sleep(0.2 + random.random() * 0.5)
        begun_ns = time.monotonic_ns()
        gdp(*words)
        read_public(Path(words[-1]))
        signalled_ns = time.monotonic_ns()
        overlay.processes[f"switch {HANDED_IN_AT}"].send(signal.SIGHUP)
        overlay.watch(AFTER_S, is_strict=True)
        last_ns = arrivals_ns[channel, "R"][-1]
        took_ms = max(last_ns - signalled_ns, 0) / 1e6
        over.add(what, CASE, SIGNAL, took_ms)
        over.add(what, CASE, COMMAND, (last_ns - begun_ns) / 1e6)
        over.add(what, CASE, OPEN, float(last_ns > signalled_ns + round((AFTER_S - 0.5) * 1e9)))
        progress(f"  {flows[channel].topic}: {took_ms:.0f} ms")


def _revocation(overlay: Overlay, flow: Flow) -> list[str]:
    """Return the words of ``gdp`` that revoke a delegation, as ``Overlay.revocation``."""
    folder = overlay.directory
    name = load_owner(folder / "owner").subject(Metadata({"kind": "topic", "name": flow.topic})).name
    file = folder / "nodes" / f"proxy-{flow.publisher}" / "delegations" / f"{name.to_text()}.delegation"
    out = folder / "revocations" / f"{name.to_text()}.revoke"
    return ["delegate", "revoke", str(file), "--owner", str(folder / "owner"), "--out", str(out)]


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=3, quick={"rounds": 1}, has_record=True)
    run_bench(parser, measure)
