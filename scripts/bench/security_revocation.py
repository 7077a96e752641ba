"""Revocation bench: cost of 10^5 revocations for a node, and time until one closes a flow.

kept      One process. A domain's root revokes 100,000 memberships: memory, time to accept one, to find one, to read
          all back from disk, and to bring a neighbour that knows none to the same state.
closed    Real processes in namespaces, three tiers of RIBs. A member publishes on many topics, or many members publish
          on one topic each; one after the other loses its delegation (``gdp delegate revoke``) or its membership
          (``gdp cert revoke``). The file is handed to one switch, of neither end's domain, by SIGHUP. Measured is the
          time from the signal, and from the start of the command, to the last message that a reader got.
"""

from __future__ import annotations

import argparse
import gc
import random
import signal
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Final

from faults.overlay import Overlay
from faults.plan import Flow, Plan
from faults.records import Kind
from machine import resident_bytes
from peers.process import FailedError
from report import percentile, print_table, progress
from skeleton import new_run
from topologies import make_topology

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import Statement, parse
from gdp.crypto.validity import Validity
from gdp.errors import StatementError
from gdp.frame.codec import ETHER_BYTES, decode
from gdp.frame.kinds import Kind as FrameKind
from gdp.host.run_registry import RunRegistry
from gdp.metadata import Metadata
from gdp.nodes.revocation_upkeep import RevocationUpkeep
from gdp.sansio import Timestamps
from gdp.simulation.simulation import Simulation
from gdp.simulation.topology import DomainPlan, Link, Topology
from gdp.stores.files import read_public
from gdp.stores.keyring import NODE_CERTIFICATE, load_owner
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import Revocations

__all__ = ["add_arguments", "run"]

COUNT: Final = 100_000
TARGET_S: Final = 1.0  # target at the 99th percentile, from the signal to the last message
HZ: Final = 100.0
TOPICS: Final = 24
VICTIMS: Final = 6
HANDED_IN_AT: Final = "m2"
STEADY_S: Final = 60.0  # limit until every flow is read
AFTER_S: Final = 3.0  # time in which a closed flow must stay silent
_YEAR_S: Final = 365 * 86_400


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--part", action="append", choices=["kept", "closed"], help="this part only; may be repeated")
    parser.add_argument("--count", type=int, default=COUNT, help="revocations kept (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="networks built for closed (default: %(default)s)")
    parser.add_argument("--hz", type=float, default=HZ, help="messages a second and flow (default: %(default)s)")
    parser.add_argument("--plane", default="auto", help="as gdp-switch --data-plane (default: %(default)s)")


def run(options: argparse.Namespace, _: object) -> tuple[dict[str, object], bool]:
    """Measure; return the figures, and whether the targets were met."""
    parts = options.part or ["kept", "closed"]
    figures: dict[str, object] = {}
    has_met = True
    if "kept" in parts:
        figures["kept"] = kept = _kept(options.count)
        _show_kept(kept)
    if "closed" in parts:
        closed = _closed(options)
        figures["closed"] = closed
        has_met = _show_closed(closed)
    return figures, has_met


# -- kept


def _statements(authority: CertificateAuthority, count: int, unix_s: float) -> Iterator[bytes]:
    """Yield revocations of memberships that a domain never issued: fingerprints are hashes, so they have one form."""
    chance = random.Random(1)
    for _ in range(count):
        until = int(unix_s) + chance.randrange(86_400, _YEAR_S)
        yield Revocation.make(authority.key, authority.root.subject, chance.randbytes(32), until)


def _kept(count: int) -> dict[str, float]:
    unix_s = time.time()
    authority = CertificateAuthority.create("lab", SigningKey.generate(), Validity.lasting(unix_s, _YEAR_S))
    key = authority.root.key.compressed
    progress(f"kept: signing {count}")
    wires = list(_statements(authority, count, unix_s))
    found: dict[str, float] = {"count": count, "statement_bytes": len(wires[0])}
    revoked = Revocations({key: authority.root.domain})
    gc.collect()
    before = resident_bytes()
    took = array("d", bytes(8 * count))
    for at, wire in enumerate(wires):
        statement = parse(wire)
        origin, now = at.to_bytes(8, "big"), Timestamps(at / 1_000, unix_s)
        begun_ns = time.perf_counter_ns()
        revoked.receive_revocation(statement, origin, now, _nothing)
        took[at] = (time.perf_counter_ns() - begun_ns) / 1e3
    gc.collect()
    found["kept_bytes_each"] = (resident_bytes() - before) / count
    found["take_us_p50"], found["take_us_p99"] = percentile(took, 0.5), percentile(took, 0.99)
    found["known_us"] = _each_us(
        lambda s: revoked.receive_revocation(s, b"a", Timestamps(1e6, unix_s), _nothing), wires[:5_000]
    )
    found["unconcerned_us"] = _unconcerned_us(revoked, unix_s)
    prints = [parse(wire).fields.bytes_("cert") for wire in wires[:20_000]]
    begun_ns = time.perf_counter_ns()
    for fingerprint in prints:
        revoked.has(fingerprint, key)
    found["look_up_us"] = (time.perf_counter_ns() - begun_ns) / 1e3 / len(prints)
    found |= _on_disk(revoked, authority, unix_s)
    found |= _newcomer(count)
    return found


def _nothing(_: bytes) -> bool:
    return False


def _each_us(call: Any, wires: list[bytes]) -> float:
    statements = [parse(wire) for wire in wires]
    begun_ns = time.perf_counter_ns()
    for statement in statements:
        call(statement)
    return (time.perf_counter_ns() - begun_ns) / 1e3 / len(statements)


def _unconcerned_us(revoked: Revocations, unix_s: float) -> float:
    """Return the cost of a junk revocation in microseconds, its parsing included."""
    stranger = CertificateAuthority.create("none", SigningKey.generate(), Validity.lasting(unix_s, _YEAR_S))
    wires = list(_statements(stranger, 5_000, unix_s))

    def take(statement: Statement) -> None:
        try:
            revoked.receive_revocation(
                parse(statement.wire), statement.signature[:8], Timestamps(1e6, unix_s), _nothing
            )
        except StatementError:
            return

    return _each_us(take, wires)


def _on_disk(revoked: Revocations, authority: CertificateAuthority, unix_s: float) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        upkeep, now = RevocationUpkeep(Path(folder), revoked), Timestamps(0.0, unix_s)
        upkeep.restore(now)
        revoked.changes = set(revoked.keys())
        upkeep.start()
        begun_s = time.perf_counter()
        while revoked.changes:
            upkeep.work(now)
            time.sleep(0.001)
        upkeep.close()
        written_s = time.perf_counter() - begun_s
        size = sum(path.stat().st_size for path in Path(folder).iterdir())
        again = Revocations({authority.root.key.compressed: authority.root.domain})
        other = RevocationUpkeep(Path(folder), again)
        begun_s = time.perf_counter()
        other.restore(now)
        loaded_s = time.perf_counter() - begun_s
        other.close()
        if len(again) != len(revoked):
            raise FailedError(f"{len(again)} of {len(revoked)} revocations came back from disk")
    return {"write_s": written_s, "file_bytes": size, "load_s": loaded_s}


def _newcomer(count: int) -> dict[str, float]:
    """Return the cost until a neighbour that comes up and knows none keeps all, and again ten more."""
    topology = Topology((Link("s1", "s2"),), (DomainPlan("lab", ("s1", "s2")),), ())
    world = Simulation(topology=topology, keepalive_ms=1_000, dead_s=10.0, hello_s=1.0)
    first, second = world.topology.nodes
    domain = world.topology.domain_of(first).label
    authority = world.authorities[domain]
    world.network.run(3)
    sim_link = world.cables[frozenset((first, second))]
    world.network.set_link(sim_link, up=False)
    now = world.network.now
    here, there = (world.switches[node]._policy.revoked for node in (first, second))
    for at, wire in enumerate(_statements(authority, count, now.unix_s)):
        here.receive_revocation(parse(wire), at.to_bytes(8, "big"), now, _nothing)
    sent = {"bytes": 0}

    def tap(_at_s: float, _a: str, _b: str, frame: bytes) -> None:
        if decode(frame, ETHER_BYTES).kind == FrameKind.REVOKED:
            sent["bytes"] += len(frame)

    world.network.taps.append(tap)
    found: dict[str, float] = {}
    for what, more in (("newcomer", 0), ("ten_more", 10)):
        for wire in _statements_more(authority, more, now.unix_s):
            here.receive_revocation(parse(wire), b"more", world.network.now, _nothing)
        sent["bytes"] = 0
        world.network.set_link(sim_link, up=True)
        begun_s, cpu_s = world.network.now.mono_s, time.process_time()
        if not world.network.run(3 * count / 1_000 + 60, lambda: len(there) == len(here)):
            raise FailedError(f"the newcomer keeps {len(there)} of {len(here)}")
        found[f"{what}_s"] = world.network.now.mono_s - begun_s
        found[f"{what}_cpu_s"] = time.process_time() - cpu_s
        found[f"{what}_bytes"] = sent["bytes"]
        world.network.set_link(sim_link, up=False)
        world.network.run(12)
    return found


def _statements_more(authority: CertificateAuthority, count: int, unix_s: float) -> Iterator[bytes]:
    for number in range(count):
        until = int(unix_s) + _YEAR_S
        yield Revocation.make(authority.key, authority.root.subject, number.to_bytes(32, "little"), until)


def _show_kept(found: dict[str, float]) -> None:
    rows = (
        ("memory, each", f"{found['kept_bytes_each']:.0f} B (the statement has {found['statement_bytes']:.0f})"),
        ("memory, all", f"{found['kept_bytes_each'] * found['count'] / 1e6:.1f} MB"),
        ("to take one, p50, p99", f"{found['take_us_p50']:.0f}, {found['take_us_p99']:.0f} µs"),
        ("to see that one is known", f"{found['known_us']:.1f} µs"),
        ("to refuse junk, parsed", f"{found['unconcerned_us']:.1f} µs"),
        ("to look one up", f"{found['look_up_us']:.2f} µs"),
        ("to write all, in the background", f"{found['write_s']:.1f} s, {found['file_bytes'] / 1e6:.0f} MB"),
        ("to read and verify all at a start", f"{found['load_s']:.1f} s"),
        ("until a newcomer keeps all", f"{found['newcomer_s']:.0f} s, paced; {found['newcomer_bytes'] / 1e6:.1f} MB"),
        ("... processor time of both ends", f"{found['newcomer_cpu_s']:.0f} s"),
        ("it comes back, ten are new", f"{found['ten_more_s']:.1f} s, {found['ten_more_bytes'] / 1e3:.1f} kB"),
    )
    print_table(("what", "figure"), rows, title=f"{found['count']:,.0f} revocations of one domain")


# -- closed


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
        end_s = time.monotonic() + STEADY_S
        while len(self._last_ns) < len(flows):
            self._look()
            if time.monotonic() > end_s:
                raise FailedError(f"{len(self._last_ns)} of {len(flows)} flows are read")
            time.sleep(0.1)
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
