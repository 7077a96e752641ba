"""Service with state, its replicas and sequencers on a network that delays: all live replicas agree at the end."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.dispatch import Ask, Failure
from gdp.service.follower import Apply, Fetch, Follower, Load, Refuse, Say
from gdp.service.replicated_log import ReplicatedLog
from gdp.service.replication_messages import AttachReplica, ReplicaProbe, ReplicaStatus, Snapshot, SnapshotRequest
from gdp.service.sequencer import Sequencer
from tests.draws import draws

SEQUENCERS = tuple(Name(bytes([number]) * 32) for number in (1, 2))
SERVERS = tuple(Name(bytes([number]) * 32) for number in (11, 12, 13))


@dataclass(slots=True)
class Replica:
    """Server that records its requests, and the proxy that follows for it."""

    tells: bool
    done: list[bytes] = field(default_factory=list)
    at: list[Apply | Fetch | Load] = field(default_factory=list)  # given to the server, not done yet
    follower: Follower = field(init=False)

    def __post_init__(self) -> None:
        self.follower = Follower(tells=self.tells)


@dataclass(slots=True)
class Client:
    """Client's proxy, and the results of its calls."""

    sequencer: Sequencer[bytes]
    answered: list[bytes] = field(default_factory=list)
    failed: list[tuple[bytes, str]] = field(default_factory=list)


class World:
    """Sequencers, replicas and their messages in flight: in order between each pair, each direction independent."""

    def __init__(self, seed: int, *, tells: bool, replicas: int = 3) -> None:
        self.dice = random.Random(seed)
        self.tells = tells
        self.now_s = 0.0
        self.replicas: dict[Name, Replica] = {}
        self.clients: dict[Name, Client] = {}
        self.ways: dict[tuple[Name, Name, str], deque[object]] = {}
        self.asked = 0
        self.failing: set[Name] = set()
        for server in SERVERS[:replicas]:
            self.start(server)
        self.open(SEQUENCERS[0])

    def open(self, name: Name) -> None:
        self.cut(name)
        sequencer = Sequencer[bytes](
            incarnation_id=lambda: self.dice.getrandbits(32),
            entries=partial(ReplicatedLog, state_every=8, entries_max=256),
        )
        self.clients[name] = Client(sequencer)
        for server in self.replicas:
            sequencer.replica_joined(server, self.now_s)

    def start(self, server: Name, *, keeps_state: bool = False) -> None:
        """Start a replica, or restart only its proxy."""
        before = self.replicas.get(server)
        self.stop(server)
        self.replicas[server] = Replica(self.tells, before.done if before is not None and keeps_state else [])
        for client in self.clients.values():
            client.sequencer.replica_joined(server, self.now_s)

    def stop(self, server: Name) -> None:
        self.cut(server)
        if self.replicas.pop(server, None) is not None:
            for client in self.clients.values():
                client.sequencer.replica_lost(server, self.now_s, "gone")

    def leave(self, name: Name) -> None:
        self.cut(name)
        self.clients.pop(name, None)
        for replica in self.replicas.values():
            if replica.follower.sequencer == name:
                replica.follower.sequencer_lost()

    def cut(self, name: Name) -> None:
        self.ways = {way: sent for way, sent in self.ways.items() if name not in way[:2]}

    def ask(self, name: Name = SEQUENCERS[0]) -> str:
        """Let a client call; return the reason if it was refused at once."""
        client, text = self.clients[name], b"%d" % self.asked
        self.asked += 1
        try:
            client.sequencer.begin(
                self.now_s,
                lambda call: text,
                60.0,
                client.answered.append,
                lambda why, reason: client.failed.append((text, reason or why.value)),
            )
        except LocalError as error:
            return str(error)
        return ""

    def step(self, loss: float = 0.0) -> None:
        """Process one event, and advance time a little."""
        self.now_s += self.dice.uniform(0, 0.02)
        for name, client in self.clients.items():
            client.sequencer.handle_timer(self.now_s)
            for effect in client.sequencer.poll_effects():
                if isinstance(effect, Ask) and effect.servers is None:
                    for server in self.replicas:
                        if self.dice.random() >= loss:
                            self.way(name, server, "tree").append(effect)
                elif isinstance(effect, Ask):
                    for server in effect.servers or ():
                        self.way(name, server, "private").append(effect)
                else:
                    self.way(name, effect.server, "private").append(effect.word)
        for server, replica in self.replicas.items():
            for said in replica.follower.poll_effects():
                if isinstance(said, Say | Refuse):
                    self.way(server, said.client, "back").append(said)
                else:
                    replica.at.append(said)
        full = [way for way, sent in self.ways.items() if sent]
        busy = [server for server, replica in self.replicas.items() if replica.at]
        if full and (not busy or self.dice.random() < 0.6):
            self.deliver(*self.dice.choice(full))
        elif busy:
            self.work(self.dice.choice(busy))

    def way(self, here: Name, there: Name, kind: str) -> deque[object]:
        return self.ways.setdefault((here, there, kind), deque())

    def deliver(self, here: Name, there: Name, kind: str) -> None:
        what = self.ways[here, there, kind].popleft()
        if kind != "back":
            replica = self.replicas.get(there)
            if replica is None:
                return
            if isinstance(what, Ask):
                replica.follower.entry(here, what.call, what.request)
            else:
                assert isinstance(what, ReplicaProbe | AttachReplica | SnapshotRequest)
                replica.follower.handle_message(here, what)
            return
        client = self.clients.get(there)
        if client is None or here not in self.replicas:
            return
        if isinstance(what, Refuse):
            client.sequencer.refused(what.call, here, what.reason, self.now_s)
        elif isinstance(what, Say):
            client.sequencer.positioned(here, what.word, self.now_s)
        else:
            assert isinstance(what, tuple)
            client.sequencer.answered(what[0], here, what[1], self.now_s)

    def work(self, server: Name) -> None:
        replica = self.replicas[server]
        job = replica.at.pop(0)
        if isinstance(job, Apply) and server in self.failing:
            self.failing.remove(server)
            replica.done.append(b"half")
            replica.follower.failed()
        elif isinstance(job, Apply):
            replica.done.append(job.request)
            self.way(server, job.client, "back").append((job.call, job.request))
            replica.follower.applied()
        elif isinstance(job, Fetch):
            replica.follower.receive_state(b",".join(replica.done))
        else:
            replica.done = [each for each in job.state.split(b",") if each]
            replica.follower.loaded(is_done=True)

    def run(self, steps: int, loss: float = 0.0) -> None:
        for _ in range(steps):
            self.step(loss)

    def settle(self) -> None:
        """Process all pending events."""
        for _ in range(60):
            self.run(100)
            states = [replica.done for replica in self.replicas.values()]
            idle = not any(self.ways.values()) and not any(len(client.sequencer) for client in self.clients.values())
            if idle and all(state == states[0] for state in states):
                return

    def agreed(self) -> list[bytes]:
        """Return the executed requests of all replicas."""
        first, *others = [replica.done for replica in self.replicas.values()]
        assert all(other == first for other in others), [first, *others]
        assert len(set(first)) == len(first)
        return first


def answered_are_done(world: World, client: Client) -> None:
    done = world.agreed()
    answered = set(client.answered)
    assert len(answered) == len(client.answered)
    asked = {b"%d" % number for number in range(world.asked)}
    assert answered <= set(done) <= asked
    assert sorted(done, key=int) == done


@pytest.mark.parametrize("tells", [True, False])
@draws(40, long=100)
@given(seed=st.integers(0, 1 << 32), loss=st.sampled_from([0.0, 0.1]))
def test_whatever_replica_dies_those_that_live_hold_the_answered_requests_in_order(
    tells: bool, seed: int, loss: float
) -> None:
    world = World(seed, tells=tells)
    for _ in range(60):
        for _ in range(world.dice.choice([0, 1, 3])):
            assert world.ask() == ""
        match world.dice.randrange(8):
            case 0:
                world.stop(world.dice.choice(SERVERS))
            case 1 | 2:
                world.start(world.dice.choice(SERVERS))
            case 3 if tells:
                world.start(world.dice.choice(SERVERS), keeps_state=True)
            case _:
                pass
        if not world.replicas:
            world.start(SERVERS[0])
        world.run(world.dice.randrange(40), loss)
    for server in SERVERS:
        if server not in world.replicas:
            world.start(server)
    world.settle()
    answered_are_done(world, world.clients[SEQUENCERS[0]])
    assert world.clients[SEQUENCERS[0]].failed == []


@draws(40, long=100)
@given(seed=st.integers(0, 1 << 32), loss=st.sampled_from([0.0, 0.1]))
def test_a_sequencer_that_restarts_goes_on_from_the_replica_that_is_furthest(seed: int, loss: float) -> None:
    world = World(seed, tells=True)
    answered: set[bytes] = set()
    for _ in range(5):
        for _ in range(12):
            world.ask()
            world.run(world.dice.randrange(30), loss)
        answered |= set(world.clients[SEQUENCERS[0]].answered)
        world.open(SEQUENCERS[0])
    world.settle()
    done = world.agreed()
    assert done == sorted(done, key=int)
    assert answered <= set(done)
    assert world.ask() == ""
    world.settle()
    assert world.agreed()[-1] == b"%d" % (world.asked - 1)


def test_a_second_client_learns_the_sequencer_until_that_one_is_gone() -> None:
    world = World(1, tells=True)
    assert world.ask() == ""
    world.settle()
    world.open(SEQUENCERS[1])
    world.run(400)
    assert world.ask(SEQUENCERS[1]) == f"kept in order by {SEQUENCERS[0].short}"
    assert world.ask() == ""
    world.settle()
    world.leave(SEQUENCERS[0])
    world.run(1000)
    assert world.ask(SEQUENCERS[1]) == ""
    world.settle()
    assert world.agreed() == [b"0", b"2", b"3"]


@draws(40, long=100)
@given(seed=st.integers(0, 1 << 32))
def test_of_two_clients_that_begin_at_once_one_keeps_the_order(seed: int) -> None:
    world = World(seed, tells=True)
    world.open(SEQUENCERS[1])
    for _ in range(20):
        for name in SEQUENCERS:
            world.ask(name)
        world.run(50)
    world.settle()
    done = world.agreed()
    answered = [set(world.clients[name].answered) for name in SEQUENCERS]
    assert answered[0] | answered[1] <= set(done)
    assert min(map(len, answered)) == 0


def test_a_full_log_without_states_is_said() -> None:
    world = World(1, tells=False, replicas=1)
    for _ in range(256):
        assert world.ask() == ""
    assert world.ask().startswith("the log is full")
    world.settle()
    assert len(world.agreed()) == 256


def test_a_server_that_failed_is_out_until_it_takes_on_a_state() -> None:
    world = World(1, tells=True, replicas=2)
    world.ask()
    world.settle()
    world.failing = {SERVERS[0]}
    world.ask()
    world.settle()
    assert not world.failing
    assert world.agreed() == [b"0", b"1"]


def test_without_states_a_replica_that_is_unlike_the_others_stays_out() -> None:
    world = World(1, tells=False, replicas=2)
    world.ask()
    world.settle()
    world.open(SEQUENCERS[0])  # its log is lost
    world.run(1000)
    world.ask()
    world.settle()
    world.start(SERVERS[2])
    world.run(500)
    assert list(world.clients[SEQUENCERS[0]].sequencer.outside) == [SERVERS[2]]
    assert [replica.done for replica in world.replicas.values()] == [[b"0", b"1"], [b"0", b"1"], []]


def test_a_calls_time_runs_out_though_its_entry_stays() -> None:
    world = World(1, tells=True, replicas=1)
    world.settle()
    world.ask()
    world.now_s += 100
    world.settle()
    client = world.clients[SEQUENCERS[0]]
    assert [reason for _, reason in client.failed] == [Failure.TIMED_OUT.value]
    assert world.agreed() == [b"0"]


def test_unexpected_messages_of_replicas_change_nothing() -> None:
    world = World(1, tells=True, replicas=1)
    world.settle()
    sequencer = world.clients[SEQUENCERS[0]].sequencer
    sequencer.positioned(SERVERS[2], ReplicaStatus(), 0.0)
    sequencer.answered(7, SERVERS[0], b"", 0.0)
    sequencer.positioned(SERVERS[0], Snapshot(sequencer.log, 99, b"x"), 0.0)
    assert sequencer.unexpected == 2
