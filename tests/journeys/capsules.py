"""A robot that keeps a topic, and a holder of its capsule, in a simulation."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.opening import CapsuleOpener, Kept
from gdp.capsule.reading import CapsuleReader
from gdp.capsule.record import Record, split
from gdp.client.participant import Participant
from gdp.client.send_options import SendOptions
from gdp.errors import GdpError, StoreError
from gdp.names import Name
from gdp.service.replication import Mode, Replication
from gdp.session.keeping import CapsuleKeeper, KeptCapsule
from gdp.session.protocol.client_core import Call, ClientCore
from gdp.session.protocol.server_core import ServerCore
from gdp.stores.capsule_store import CapsuleStore, StoreLimits
from gdp.stores.holder_exchange import Steps
from gdp.stores.holder_upkeep import HolderUpkeep
from gdp.trust.right import Right
from lab.inline import Inline
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Flow

STORE = "/store"
_STEP_S = 0.02  # between two turns of work
BACKGROUND = SendOptions(priority="background")
LIMITS = StoreLimits(owner_bytes=1 << 30, spare_bytes=0)


@dataclass
class Holder:
    """Member that holds capsules.

    Attributes:
        service: its name.
        peers: services of other holders.
        faults: what it found wrong.
        lie: changes each answer; None: it tells the truth.
    """

    world: Simulation
    folder: Path
    label: str = SERVER
    limits: StoreLimits = LIMITS
    service: str = STORE
    peers: tuple[str, ...] = ()
    lie: Callable[[HolderRequest, HolderAnswer], HolderAnswer] | None = None
    refusals: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    store: CapsuleStore = field(init=False)
    upkeep: HolderUpkeep = field(init=False)
    core: ServerCore = field(init=False)
    clients: dict[str, ClientCore] = field(default_factory=dict)
    called: dict[Name, ClientCore] = field(default_factory=dict)
    exchanges: dict[str, tuple[Steps, Call]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.join()
        self.open()

    def join(self) -> None:
        """Serve and call, as a new process does."""
        topic = self.world.topic(self.service, self.member, [Right.SERVE], kind="service")
        self.core = ServerCore(self.member, topic, start=1, at_once=1)
        self.exchanges.clear()
        for peer in self.peers:
            called = self.world.topic(peer, self.member, [Right.CALL], kind="service")
            start = int(self.world.network.now.mono_s * 1e6)
            self.clients[peer] = ClientCore(self.member, called, peer, start=start, options=BACKGROUND)
            self.called[called.name] = self.clients[peer]

    @property
    def member(self) -> Participant:
        return self.world.members[self.label]

    def open(self) -> None:
        """Open the store, as after a restart."""
        self.store = CapsuleStore(self.folder, self.limits, lambda: self.world.network.now.unix_s)
        self.upkeep = HolderUpkeep(self.store, self.peers, self.world.network.now.mono_s)

    def restart(self, *, has_disk: bool = True) -> None:
        """End the process, and begin another one; without its disk, it has nothing."""
        self.store.close()
        if not has_disk:
            shutil.rmtree(self.folder)
        self.world.restart_member(self.label)
        self.join()
        self.open()

    def exchange(self, now_s: float) -> None:
        """Fetch what other holders have."""
        for peer, client in self.clients.items():
            due_s = client.get_timer()
            if due_s is not None and now_s >= due_s:
                client.handle_timer(now_s)
            if peer in self.exchanges and self.exchanges[peer][1].is_done:
                steps, call = self.exchanges.pop(peer)
                if call.response is not None:
                    self._step(peer, steps, HolderAnswer.from_cbor(call.response.payload), now_s)
        for peer, steps in self.upkeep.handle_timer(now_s):
            self._step(peer, steps, None, now_s)
        self.faults += self.store.poll_faults().values()

    def _step(self, peer: str, steps: Steps, answer: HolderAnswer | None, now_s: float) -> None:
        try:
            request = next(steps) if answer is None else steps.send(answer)
        except StopIteration:
            self.upkeep.ended(peer, now_s)
            return
        except StoreError:
            return  # the pause grows
        call = Call(payload=request.to_cbor(), timeout_s=5.0, replication=Replication(Mode.SOME, copies=1))
        self.clients[peer].begin(call, now_s)
        self.exchanges[peer] = steps, call

    def work(self) -> None:
        """Answer the requests that have come."""
        now_s = self.world.network.now.mono_s
        for message in self.member.poll_messages():
            self.called.get(message.topic, self.core).receive(message, now_s)
        self.exchange(now_s)
        due_s = self.core.get_timer()
        if due_s is not None and now_s >= due_s:
            self.core.handle_timer(now_s)
        while self.core.turns:
            turn = self.core.turns.popleft()
            self.core.finish(turn.number, self._outcome(turn.request, turn.asked.client), now_s)
        self.member.flush(now_s)
        self.world.network.send_pending(self.label)

    def _outcome(self, wire: bytes, client: Name) -> bytes | str:
        try:
            answer = self.store.handle(wire, client)
        except GdpError as error:
            self.refusals.append(str(error))
            return str(error)
        if self.lie is not None:
            answer = self.lie(HolderRequest.from_cbor(wire), HolderAnswer.from_cbor(answer)).to_cbor()
        return answer


@dataclass
class Keeping:
    """Robot that keeps the topic of a flow."""

    flow: Flow
    folder: Path
    most_bytes: int = 1 << 24
    holders: tuple[str, ...] = (STORE,)
    around_ns: tuple[int, int] | None = None
    capsule: str | None = None
    keeper: CapsuleKeeper = field(init=False)
    kept: KeptCapsule = field(init=False)
    step_s: float = _STEP_S
    worked_s: float = 0.0

    def __post_init__(self) -> None:
        world, member = self.flow.world, self.flow.member
        identity = next(each for each in world.identities.values() if each.name == member.name)
        self.keeper = CapsuleKeeper(member, identity, self.folder, start=7, pool=Inline())
        self.keep(self.flow)

    def keep(self, flow: Flow) -> None:
        """Keep the topic of a flow; the latest one's capsule is ``kept``."""
        world = flow.world
        services = [world.topic(each, flow.member, [Right.CALL], kind="service") for each in self.holders]
        self.kept = self.keeper.keep(
            flow.topic,
            flow.publisher,
            services,
            self.most_bytes,
            world.network.now.unix_s,
            self.around_ns,
            self.capsule,
        )

    def work(self) -> None:
        """Write and upload."""
        now = self.flow.world.network.now
        for message in self.flow.member.poll_messages():
            self.keeper.receive(message, now.mono_s)
        self.keeper.handle(now)
        self.flow.member.flush(now.mono_s)
        self.flow.world.network.send_pending(ROBOT)

    def run(self, duration_s: float, *holders: Holder, until: Callable[[], bool] = lambda: False) -> bool:
        """Advance time while robot and holders work; return whether ``until`` came true."""

        world, tick_s = self.flow.world, 0.05

        def step() -> bool:
            now_s = world.network.now.mono_s
            if now_s - self.worked_s < self.step_s:
                return False
            self.worked_s = now_s
            self.work()
            for holder in holders:
                holder.work()
            return until()

        for number in range(int(duration_s / tick_s)):
            world.network.call(number * tick_s, lambda: None)  # its own timers are not those of the member
        return world.network.run(duration_s, step)

    def is_uploaded(self) -> bool:
        """Return whether the holder has confirmed all that is on the disk here."""
        return self.kept.is_uploaded and self.kept.ring.end > 0

    def publish_at(self, times_s: list[float], message: Callable[[int], bytes]) -> list[bytes]:
        """Publish numbered messages at these seconds from now on; return them."""
        messages = [message(number) for number in range(len(times_s))]
        for at_s, each in zip(times_s, messages, strict=True):
            self.flow.world.network.call(at_s, partial(self.flow.publish, each))
        return messages


def records_at(store: CapsuleStore, capsule: Name, *, time_ns: int = 0) -> bytes:
    """Return what a holder gives to a reader, from a time on."""
    pieces, offset, reader = list[bytes](), 0, Name(b"r" * 32)
    while True:
        request = HolderRequest(ask=Ask.READ, capsule=capsule, offset=offset, time_ns=0 if pieces else time_ns)
        answer = HolderAnswer.from_cbor(store.handle(request.to_cbor(), reader))
        if not answer.data:
            return b"".join(pieces)
        pieces.append(answer.data)
        offset = answer.offset + len(answer.data)


def read_from(holder: Holder, keeping: Keeping, from_ns: int = 0) -> tuple[list[Kept], CapsuleReader]:
    """Return what a reader with the topic's secrets gets from a holder, and the reader."""
    topic = keeping.flow.topic
    reader = CapsuleReader(keeping.kept.ring.descriptor, {topic.name: topic.secrets}, from_ns=from_ns)
    kept = list[Kept]()
    while not reader.is_done:
        answer = holder.store.handle(reader.next_request().to_cbor(), Name(b"r" * 32))
        kept += reader.handle_response(HolderAnswer.from_cbor(answer))
    return kept, reader


def opened(data: bytes, keeping: Keeping) -> list[Kept]:
    """Return the messages in records, opened with the secrets of the flow's topic."""
    descriptor, topic = keeping.kept.ring.descriptor, keeping.flow.topic
    opener = CapsuleOpener(descriptor, {topic.name: topic.secrets})
    return [each for wire in split(data) for each in opener.open(Record.from_wire(wire))]
