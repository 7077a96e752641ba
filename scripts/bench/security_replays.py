"""Replay bench: recorded frames that are accepted after a restart, of all that are played back. The target is none.

One process with the in-memory network and its virtual clock. There are two domains with a RIB each, a publisher and its
reader, a client and a server. One node has moved, one has withdrawn its topic, and one is revoked. Every frame on every
link is recorded: while all come up, at work, and during each event. Events are a cut link, a restart of a RIB, a move,
a withdrawal and a revocation.

Then nothing, one process or all of them restart: after seconds or, all being off, after hours or days. Their clocks
are right, or nearly an hour behind or ahead. RIBs begin with their snapshot and switches with the revocations that
they kept. From the start, recordings of each kind are played back: single frames, all parts of a statement, and
stretches of a link in their order. They arrive at their original port or at any other one, under the address of the
neighbour there, their own, or a stranger's. Where a reader or a server has restarted, its peers are silent meanwhile,
and every second recording is of what it received from them.

*Accepted* is what the oracle (``Domain.found``) sees after that and ``QUIET_S`` more:

- a message or request that no member sent in this batch, or that an application got twice or out of order;
- one that was sent when all had settled, and was not delivered or answered within ``PROMISE_S``: a flow was cut;
- a neighbour, an attached advertisement, a location, a route of a RIB, or a branch of a tree of an absent node; or one
  that is gone although its node is there. Of the moved node the former location counts, of the withdrawn topic and the
  revoked node anything;
- a link state that its origin did not send last.

What a frame warrants by itself is none of these: a current keepalive keeps a present neighbour up.

``--control`` removes one check of freshness and must find something; it shows that the oracle can.

    .venv/bin/python scripts/bench/security.py replays
    .venv/bin/python scripts/bench/security.py replays --tries 2000 --control window --no-save
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final
from unittest import mock

from report import print_table, progress

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gdp.client.rib_host import RibHost
from gdp.client.writer_proxy import WriterProxy
from gdp.control.boundary import ErrorBoundary
from gdp.control.neighbour import NeighbourState
from gdp.control.rib_replication import Entry
from gdp.frame.codec import ETHER_BYTES, decode
from gdp.frame.kinds import Kind
from gdp.message.heartbeat import Heartbeat
from gdp.message.replay import ReplayWindow
from gdp.rib.route import Route
from gdp.sansio import OutgoingFrames, ProtocolCore, ReceivedFrame, Timestamps
from gdp.simulation.network import EPOCH_UNIX_S, SimNetwork
from gdp.simulation.simulation import Simulation
from gdp.simulation.topology import Attachment, DomainPlan, Link, Topology
from gdp.switch.advertisements import AdvertisementHandler
from gdp.switch.table import Table as ForwardingTable
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from tests.insiders.oracle import signing_oracle
from tests.journeys.flows import Flow, advertise
from tests.journeys.services import Party

__all__ = ["add_arguments", "run"]

QUIET_S: Final = 4.0
PROMISE_S: Final = 5.0
SETTLE_S: Final = 20.0
ROBOT, READER, CLIENT, SERVER = "a/robot", "c/reader", "a/client", "c/server"
ROAMER, GHOST, OUTCAST = "a/roamer", "a/ghost", "b/outcast"
GAPS_S: Final = (0.0, 0.0, 60.0, 3_000.0, 7_000.0, 15_000.0, 86_400.0, 5 * 86_400.0)
CLOCKS_S: Final = (0.0, 0.0, 0.0, -3_000.0, 3_000.0)
RESTARTS: Final = ("nothing", ROBOT, READER, READER, CLIENT, SERVER, SERVER, ROAMER, "switch a", "switch b", "switch c",
                   "rib home", "rib away", "all", "all", "all")  # fmt: skip
SILENT: Final = {READER: ROBOT, SERVER: CLIENT}  # nodes whose frames are dropped while their receivers start
BATCH: Final = 1_000
_BATCHES: Final = 8  # of one network
_LEASE_S: Final = 6.0
_TOPOLOGY: Final = Topology(
    links=(Link("a", "b"), Link("b", "c")),
    domains=(DomainPlan("home", ("a", "b"), upper="away"), DomainPlan("away", ("c",))),
    attachments=(
        Attachment("b", "rib", "rib"),
        Attachment("c", "rib", "rib"),
        *(
            Attachment(label.split("/")[0], "proxy", label.split("/")[1])
            for label in (ROBOT, READER, CLIENT, SERVER, ROAMER, GHOST, OUTCAST)
        ),
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Recorded:
    """Frame, from its header on, as it arrived somewhere."""

    node: str
    port: int
    mac: bytes
    frame: bytes
    kind: int
    statement: tuple[int, bytes, int]  # key of the statement that it is a part of


class _Stepped:
    """Machine whose wall clock is off."""

    def __init__(self, machine: ProtocolCore, ahead_s: float) -> None:
        self._machine = machine
        self._ahead_s = ahead_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._machine, name)

    def _at(self, now: Timestamps) -> Timestamps:
        return Timestamps(now.mono_s, now.unix_s + self._ahead_s)

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        self._machine.add_port(index, mac, mtu, cost, self._at(now))

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        self._machine.port_changed(port, up, self._at(now))

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        self._machine.receive(arrivals, self._at(now))

    def handle_timer(self, now: Timestamps) -> None:
        self._machine.handle_timer(self._at(now))

    def get_timer(self) -> float | None:
        return self._machine.get_timer()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        return self._machine.frames_to_send(now_s)

    def frames_leave(self, now_s: float) -> None:
        self._machine.frames_leave(now_s)


class RecordingNetwork(SimNetwork):
    """Network that records arrivals, and lets clocks jump and be off.

    Attributes:
        records: None: nothing is recorded.
        ahead_s: offset of the clock of machines that start now.
    """

    records: list[Recorded] | None = None
    ahead_s = 0.0

    @property
    def now(self) -> Timestamps:
        """Return the virtual time, with the clock offset of machines that start now."""
        return Timestamps(self._now_s, EPOCH_UNIX_S + self._now_s + self.ahead_s)

    def jump(self, gap_s: float) -> None:
        """Advance the time while every machine is off."""
        self._now_s += gap_s

    def replace(self, name: str, machine: ProtocolCore, table: ForwardingTable | None = None) -> None:
        """Replace a machine; its wall clock keeps the present offset."""
        stepped = _Stepped(machine, self.ahead_s) if self.ahead_s else machine
        ahead_s, self.ahead_s = self.ahead_s, 0.0
        super().replace(name, stepped, table)
        self.ahead_s = ahead_s

    def _send(self, wired: Any, frame: bytes) -> None:
        if self.records is not None:
            _, own, far = wired
            header = decode(frame, ETHER_BYTES)
            group = (header.kind, bytes(header.source), header.number)
            self.records.append(Recorded(far.node, far.port, own.mac, frame[ETHER_BYTES:], header.kind, group))
        super()._send(wired, frame)


@dataclass(slots=True)
class Domain:
    """Network of one episode, and its invariants."""

    seed: int
    rng: random.Random = field(init=False)
    world: Simulation = field(init=False)
    network: RecordingNetwork = field(init=False)
    flow: Flow = field(init=False)
    moved: Flow = field(init=False)
    client: Party = field(init=False)
    server: Party = field(init=False)
    records: list[Recorded] = field(default_factory=list)
    groups: dict[tuple[int, bytes, int], list[Recorded]] = field(default_factory=dict)
    kinds: dict[int, list[int]] = field(default_factory=dict)
    sent: int = 0
    expected: list[bytes] = field(default_factory=list)  # messages since all had settled
    asked: list[bytes] = field(default_factory=list)
    revocation: bytes = b""
    before: dict[str, set[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        self.world = world = Simulation(
            topology=_TOPOLOGY, seed=self.seed, hello_s=1.0, dead_s=3.6, lease_s=_LEASE_S, keepalive_ms=500
        )
        assert isinstance(world.network, RecordingNetwork)
        self.network = world.network
        self.network.records = self.records
        assert world.run_until_attached(SETTLE_S)
        self._begin_flows()
        self._live_through()
        self._index(0)

    # -- what is recorded

    def _begin_flows(self) -> None:
        self.flow = advertise(self.world, "/chatter", ROBOT)
        self.flow.read_by(READER)
        self.moved = advertise(self.world, "/moved", ROAMER)
        self.moved.read_by(READER)
        self.client, self.server = Party(self.world, CLIENT, Right.CALL), Party(self.world, SERVER, Right.SERVE)
        assert self._is_settled(SETTLE_S)

    def _live_through(self) -> None:
        """Run the events that are recorded."""
        world, network = self.world, self.network
        ghost = advertise(world, "/ghost", GHOST)
        ghost.read_by(READER)
        for _ in range(10):
            self.say()
            ghost.publish(b"ghost")
            network.run(0.1)
        world.members[GHOST].withdraw(ghost.topic.name)
        world.members[READER].unsubscribe(ghost.topic.name)
        network.send_pending(GHOST)
        network.send_pending(READER)
        member, authority = world.identities[OUTCAST].member, world.authorities["home"]
        self.revocation = Revocation.make(
            authority.key, authority.root.subject, member.fingerprint, member.validity.not_after_unix_s
        )
        world.switches["a"].revoke(self.revocation, network.now)
        network.send_pending("a")
        network.run(2.0)
        network.set_link(world.cables[frozenset("ab")], up=False)
        network.run(5.0)
        network.set_link(world.cables[frozenset("ab")], up=True)
        network.run(3.0)
        world.roam(ROAMER, "b")
        network.run(3.0)
        self.restart("rib home")
        self.restart(SERVER)
        self.restart(ROBOT)
        assert self._is_settled(SETTLE_S)
        for _ in range(10):
            self.say()
            network.run(0.2)
        network.run(2.0)
        self.forget()

    def record_more(self) -> None:
        """Record how a reader and a server of the present incarnations begin and work."""
        first, self.network.records = len(self.records), self.records
        for what in (READER, SERVER):
            self.restart(what)
        self._is_settled(SETTLE_S)
        for _ in range(5):
            self.say()
            self.network.run(0.1)
        self.network.run(1.0)
        self._index(first)
        self.delivered()

    def _index(self, first: int) -> None:
        self.network.records = None
        for number, each in enumerate(self.records[first:], first):
            self.groups.setdefault(each.statement, []).append(each)
            self.kinds.setdefault(each.kind, []).append(number)

    # -- what happens

    def say(self) -> None:
        """Publish a message and send a request."""
        self.sent += 1
        message = b"message %d" % self.sent
        self.expected.append(message)
        self.asked.append(message)
        self.flow.publish(message)
        self.client.publish(message)

    def restart(self, what: str, ahead_s: float = 0.0) -> None:
        """Restart a process with its files, and start its flows again."""
        world, network = self.world, self.network
        network.ahead_s = ahead_s
        if what.startswith("switch "):
            name = what.split()[1]
            world.restart_switch(name)
            world.switches[name].revoke(self.revocation, network.now)
        elif what.startswith("rib "):
            label = what.split()[1]
            entries = self._snapshot(world.ribs[label])
            world.restart_rib(label)
            world.ribs[label].rib.load(entries, network.now)
        elif what != "nothing":
            world.restart_member(what)
        network.ahead_s = 0.0
        self._take_part(what)

    def _take_part(self, what: str) -> None:
        world = self.world
        if what == ROBOT:
            name = self.flow.topic
            self.flow.publisher = world.members[ROBOT].advertise(name, b"described", reliable=True)
        elif what == ROAMER:
            self.moved.publisher = world.members[ROAMER].advertise(self.moved.topic, b"described", reliable=True)
        elif what == READER:
            self.flow.read_by(READER)
            self.moved.read_by(READER)
        elif what == CLIENT:
            self.client.begin()
        elif what == SERVER:
            self.server.begin()
        if what in world.members:
            self.network.send_pending(what)

    def _snapshot(self, host: RibHost) -> list[Entry]:
        """Return what a RIB has on disk."""
        now_s = self.network.now.mono_s
        store = host.rib._store
        return [entry for key in store.known() if (entry := host.rib.entry_of(key, now_s))]  # type: ignore[attr-defined]

    def restart_all(self, gap_s: float, aheads: Callable[[], float]) -> None:
        """End every process, advance the time, and start them all."""
        world, network = self.world, self.network
        names = [*(f"switch {each}" for each in world.switches), *(f"rib {each}" for each in world.ribs)]
        nodes = [*world.switches, *map(world.rib_node, world.ribs), *world.members]
        entries = {label: self._snapshot(host) for label, host in world.ribs.items()}
        for node in nodes:
            network.stop(node)
        network.run(1.0)
        network.jump(gap_s)
        for what in names:
            network.ahead_s = aheads()
            if what.startswith("switch "):
                world.restart_switch(what.split()[1])
                world.switches[what.split()[1]].revoke(self.revocation, network.now)
            else:
                world.restart_rib(what.split()[1])
                left = [replace(each, lease_s=each.lease_s - gap_s) for each in entries[what.split()[1]]]
                kept = [each for each in left if each.lease_s > 0 or each.membership]
                world.ribs[what.split()[1]].rib.load(
                    [replace(each, lease_s=max(each.lease_s, 0.0)) for each in kept], network.now
                )
        for label in world.members:
            network.ahead_s = aheads()
            world.restart_member(label)
        network.ahead_s = 0.0
        for label in (ROBOT, ROAMER, READER, CLIENT, SERVER):
            self._take_part(label)

    def play(self, tries: int, counts: Counter[str], *, is_live: bool, to: str | None = None) -> Iterator[None]:
        """Play back so many frames; yield at intervals. ``to``: half of them are frames that this member received."""
        done = 0
        heard = [each for each in self.records if each.node == to and each.kind in (Kind.HEARTBEAT, Kind.DATA)]
        while done < tries:
            first = self.rng.choice(self.kinds[self.rng.choice(list(self.kinds))])
            chance = self.rng.random()
            if heard and self.rng.random() < 0.5:
                begin = max(self.rng.randrange(len(heard)), len(heard) - self.rng.randrange(1, 100))
                chosen = heard[begin : begin + 30]
            elif chance < 0.5:
                chosen = self.records[first : first + 1]
            elif chance < 0.8:
                chosen = self.groups[self.records[first].statement][:64]
            else:
                at = self.records[first].node
                chosen = [each for each in self.records[first : first + 200] if each.node == at][:30]
            elsewhere = None if self.rng.random() < 0.7 else self._anywhere()
            address = self.rng.random()
            for each in chosen[: tries - done]:
                node, port = elsewhere or (each.node, each.port)
                ports = self.network._nodes[node].ports
                mac = ports[port][2].mac if address < 0.8 else each.mac if address < 0.9 else b"\x02evil\x00"
                self.network.inject(node, port, each.frame, mac)
                counts[Kind(each.kind).name.lower()] += 1
                done += 1
                self.network.run(self.rng.choice((0.0, 0.001, 0.005) if heard else (0.0, 0.0, 0.0002, 0.001)))
            if self.rng.random() < 0.02:
                self.network.run(self.rng.choice((0.1, 0.5)))
            if is_live and self.rng.random() < 0.03:
                self.say()
            yield

    def _anywhere(self) -> tuple[str, int]:
        node = self.rng.choice(list(self.network._nodes))
        return node, self.rng.choice(list(self.network._nodes[node].ports))

    # -- what must be true

    def _is_settled(self, within_s: float) -> bool:
        """Wait until all flows work; return whether they do in time."""

        def are_there() -> bool:
            server, client = self.server.member, self.client.member
            return (
                self.flow.is_read_by(1) and self.moved.is_read_by(1)
                and len(server.peers(self.server.service)) == 1 and len(client.peers(self.client.service)) == 1
            )  # fmt: skip

        return self.network.run(within_s, are_there)

    def forget(self) -> None:
        """Take everything that was delivered, and restart the count."""
        self.collect()
        self.network.run(0.5)  # wait for answers to what the server has just accepted
        self.collect()
        self.flow.got[READER].clear()
        self.server.got.clear()
        self.client.got.clear()
        self.expected.clear()
        self.asked.clear()

    def collect(self) -> None:
        """Take the deliveries."""
        self.flow.got[READER] += [each.delivered for each in self.world.members[READER].poll_messages()]
        self.server.collect()
        self.client.collect()

    def settle(self) -> list[str]:
        """Wait until all restarted processes work again; return the deliveries meanwhile, or what does not work."""
        found = [] if self._is_settled(SETTLE_S) else ["a flow does not come back"]
        self.network.run(QUIET_S)
        return [*found, *self.delivered()]

    def delivered(self) -> list[str]:
        """Return wrong deliveries to applications, and deliveries that are overdue."""
        self.network.run(PROMISE_S, self._has_all)
        tail = b" by " + SERVER.encode()
        found = []
        for what, got, due in (
            ("message", [each.message for each in self.flow.got[READER]], self.expected),
            ("request", [each.delivered.message for each in self.server.got], self.asked),
            ("answer", [each.delivered.message for each in self.client.got], [each + tail for each in self.asked]),
        ):
            if got != due:
                extra = [each for each in got if each not in due]
                twice = len(got) - len(set(got))
                found.append(f"{what}s: {len(extra)} of before, {twice} twice, {len(set(due) - set(got))} lost")
        self.forget()
        return found

    def _has_all(self) -> bool:
        self.collect()
        return (
            len(self.flow.got[READER]) >= len(self.expected)
            and len(self.server.got) >= len(self.asked) and len(self.client.got) >= len(self.asked)
        )  # fmt: skip

    def found(self) -> list[str]:
        """Return what was accepted, compared with ``before`` and with the true state."""
        found = self.delivered()
        state, true = self.state(), self._truth()
        for what, values in state.items():
            if wrong := values - true.get(what, values):
                found.append(f"{what}: {len(wrong)} that are not")
            if what != "link states" and (extra := values - self.before.get(what, values) - true.get(what, set())):
                found.append(f"{what}: {len(extra)} new")
            if what in ("neighbours", "attached", "routes", "trees") and (gone := self.before[what] - values):
                found.append(f"{what}: {len(gone)} gone")
        return found

    def _truth(self) -> dict[str, set[Any]]:
        """Return the true location of every node, independent of all statements."""
        world = self.world
        at = {label: label.split("/")[0] for label in world.members} | {ROAMER: "b"}
        advertisements = {
            (advertisement.subject.name, member.name, world.identities[at[label]].name)
            for label, member in world.members.items() if label != OUTCAST
            for advertisement in member.attachment.advertisements if advertisement.right is not Right.READ
        }  # fmt: skip
        last = {
            (switch.name, entry.state.scope, entry.state.sequence)
            for switch in world.switches.values()
            for (origin, _), entry in switch._flooding.link_states._entries.items() if origin == switch.name
        }  # fmt: skip
        return {"attached": advertisements, "places": advertisements, "routes": advertisements, "link states": last}

    def state(self) -> dict[str, set[Any]]:
        """Return the state that nodes believe."""
        world = self.world
        hosts = {world.rib_node(label): host.attachment.hello_protocol for label, host in world.ribs.items()}
        members = {
            label: member.attachment.hello_protocol for label, member in world.members.items() if label != OUTCAST
        }
        greeters = {label: switch.hello_protocol for label, switch in world.switches.items()} | hosts | members
        switches = world.switches
        return {
            "neighbours": {
                (node, port.index, each.name, each.mac)
                for node, hello_protocol in greeters.items() for port in hello_protocol.ports.values()
                for each in port.neighbours.values() if each.state is NeighbourState.UP
            },
            "attached": {
                (each.advertisement.name, each.advertisement.node, switch.name)
                for switch in switches.values() for each in switch.attached.all()
            },
            "places": {
                (each.name, each.advertiser, each.switch)
                for switch in switches.values() for each in switch.resolver.cache.all()
            },
            "routes": {
                (*key, route.switch)
                for host in world.ribs.values() for key in host.rib._store.known()  # type: ignore[attr-defined]
                if isinstance(route := host.rib._store.get(*key), Route)
            },
            "trees": {
                (node, tree.topic, tree.publisher, at)
                for node, switch in switches.items() for tree in switch.multicast.trees.all() for at in tree.branches
            },
            "link states": {
                (origin, scope, entry.state.sequence)
                for switch in switches.values()
                for (origin, scope), entry in switch._flooding.link_states._entries.items()
            },
        }  # fmt: skip


# -- checks taken away


def _always(value: Any) -> Callable[..., Any]:
    return lambda *_: value


def _any_start(self: WriterProxy, joined: Any, epoch: int, now_s: float) -> None:
    """Accept a start of another incarnation of this reader."""
    status = Heartbeat.from_wire(joined.message)
    start = status.starts.get(self._reader.name)
    if start is not None:
        wire = status._replace(
            starts={self._reader.name: start._replace(incarnation=self._reader.incarnation)}
        ).to_wire()
        joined = replace(joined, message=wire)
    _HANDLE_STATUS(self, joined, epoch, now_s)


_HANDLE_STATUS: Final = WriterProxy._handle_status


CONTROLS: Final[dict[str, tuple[tuple[object, str, Any], ...]]] = {
    "window": ((ReplayWindow, "is_finished", _always(False)),),
    "start": ((WriterProxy, "_handle_status", _any_start),),
    "claims": ((AdvertisementHandler, "_check_fresh", _always(None)),),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--tries", type=int, default=100_000, help="frames played back (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after so long in any case")
    parser.add_argument("--seed", type=int, default=1, help="of the first network")
    parser.add_argument("--add", action="store_true", help="to the figures in the file; begins at the next network")
    parser.add_argument("--control", choices=list(CONTROLS), help="take this check away; something must be found")


def run(options: argparse.Namespace, before: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Play back so many frames."""
    logging.disable(logging.CRITICAL)
    ErrorBoundary.reraises = True
    counts: Counter[str] = Counter()
    restarts: Counter[str] = Counter()
    found: list[str] = []
    held = before if options.add else {}
    begun_s, first = time.monotonic(), held["seeds"][1] + 1 if held else options.seed
    seed = first
    with ExitStack() as stack:
        stack.enter_context(mock.patch("gdp.simulation.simulation.SimNetwork", RecordingNetwork))
        stack.enter_context(signing_oracle())
        while counts.total() < options.tries and time.monotonic() - begun_s < options.seconds:
            with _without(options.control):
                found += _episode(Domain(seed), options.tries - counts.total(), counts, restarts)
            progress(f"network {seed}: {counts.total()} tries, {len(found)} accepted")
            seed += 1
    seconds = round(time.monotonic() - begun_s, 1)
    if options.control is not None:
        _show(counts, restarts, found)
        tried = {options.control: {"tries": counts.total(), "accepted": len(found)}}
        controls = {**before.get("controls", {}), **tried}
        return {"controls": controls}, bool(found)
    counts.update(held.get("by_kind", {}))
    restarts.update(held.get("by_restart", {}))
    _show(counts, restarts, found)
    found = [*held.get("found", []), *found]
    figures = {
        "tries": counts.total(), "accepted": held.get("accepted", 0) + len(found) - len(held.get("found", [])),
        "target_accepted": 0, "by_kind": dict(counts.most_common()), "by_restart": dict(restarts.most_common()),
        "found": found[:50], "seeds": [held["seeds"][0] if held else first, seed - 1],
        "seconds": seconds + held.get("seconds", 0.0),
    }  # fmt: skip
    return figures, not figures["accepted"]


@contextmanager
def _without(control: str | None) -> Iterator[None]:
    with ExitStack() as stack:
        for owner, name, value in CONTROLS[control] if control else ():
            stack.enter_context(mock.patch.object(owner, name, value))
        yield


def _episode(domain: Domain, tries: int, counts: Counter[str], restarts: Counter[str]) -> list[str]:
    """Restart and play back a few times in one network; return what was accepted."""
    rng, found = domain.rng, []
    for number in range(_BATCHES):
        size = min(BATCH, tries - number * BATCH)
        if size <= 0:
            break
        what = rng.choice(RESTARTS)
        gap_s, ahead_s = rng.choice(GAPS_S) if what == "all" else 0.0, rng.choice(CLOCKS_S)
        text = f"network {domain.seed}, batch {number}: {what}, {gap_s:g} s later, clock {ahead_s:+g} s"
        if broken := domain.settle():
            found += [f"{text}, before it: {each}" for each in broken]
            break
        domain.record_more()
        domain.before = domain.state()
        at_once = rng.randrange(size) if rng.random() < 0.7 else 0
        if what == "all":
            aheads = [0.0, ahead_s]
            domain.restart_all(gap_s, lambda aheads=aheads: rng.choice(aheads))  # type: ignore[misc]
        else:
            domain.restart(what, ahead_s)
        silent = SILENT.get(what)
        if silent is not None:
            domain.network.freeze(silent)  # an attacker in a link blocks the regular frames meanwhile
        for _ in domain.play(at_once, counts, is_live=False, to=what if silent else None):
            pass
        if silent is not None:
            domain.network.thaw(silent)
        seen = domain.settle()
        for _ in domain.play(size - at_once, counts, is_live=True):
            pass
        domain.network.run(QUIET_S)
        seen += domain.found()
        restarts[what] += size
        found += [f"{text}: {each}" for each in seen]
        if seen:
            break
    return found


def _show(counts: Counter[str], restarts: Counter[str], found: list[str]) -> None:
    rows = zip_longest(counts.most_common(), restarts.most_common(), fillvalue=("", ""))
    cells = [(str(what), str(tries), str(which), str(often)) for (what, tries), (which, often) in rows]
    title = f"{counts.total():,} recorded frames played back, {len(found)} accepted"
    print_table(("kind", "tries", "restarted", "tries"), cells, title=title)
    for each in found[:20]:
        print(each)
