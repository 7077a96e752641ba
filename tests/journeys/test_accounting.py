"""Frame accounting in the simulated network: published = delivered + dropped by reason + in flight.

The network counts the drops of its planes; the losses of pulled links and of chance are recorded here.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

import pytest

from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, HOPS_AT, KIND_AT, Kind
from gdp.sansio import ReceivedFrame
from gdp.switch.forwarder import Drop, Forward, decide
from gdp.switch.name_resolver import PendingFrames
from gdp.switch.table import Hop
from gdp.switch.unicast import Unicast
from lab import simulation as worlds
from lab.network import SimLink, SimNetwork
from lab.simulation import Simulation
from lab.topology import chain
from tests.journeys.flows import Tap, advertise, flowing

pytestmark = pytest.mark.momentary("the books close once the last frame has come to rest, before any lease ends")

A, B = "s1/left", "s5/right"
MIDDLE = frozenset(("s2", "s3"))
SIZE = 1_000  # of a message: it fits one frame, so that frames are messages
ON_THE_WAY = (
    DropReason.NO_ROUTE,
    DropReason.NO_READER,
    DropReason.PENDING_FULL,
    DropReason.PENDING_EXPIRED,
    DropReason.HOPS_EXPIRED,
    DropReason.UNKNOWN_SENDER,
)


def is_data(frame: bytes) -> bool:
    return frame[ETHER_BYTES + KIND_AT] == Kind.DATA


class Ledger(SimNetwork):
    """Fate of DATA frames: dropped by a plane, lost by chance, cut off with their link, still in flight."""

    def __init__(self, seed: int = 1) -> None:
        super().__init__(seed)
        self.dropped: Counter[DropReason] = Counter()
        self.taken: Counter[str] = Counter()

    def _send(self, wired: Any, frame: bytes) -> None:
        drops, lost = self.drops.copy(), self.lost
        super()._send(wired, frame)
        if is_data(frame):
            self.dropped += self.drops - drops
            self.taken["lost"] += self.lost - lost
            self.taken["flying"] += self.drops == drops and self.lost == lost

    def _arrive(self, sim_link: SimLink, end: Any, frame: bytes) -> None:
        if is_data(frame):
            self.taken["flying"] -= 1
            self.taken["cut"] += not sim_link.is_up
        super()._arrive(sim_link, end, frame)

    def _deliver(self, end: Any, frame: bytes) -> None:
        node = self._nodes[end.node]
        if is_data(frame) and not node.is_alive:
            self.taken["dead"] += 1
        elif is_data(frame) and node.table is not None:
            mtus = {port: sim_link.mtu for port, (sim_link, _, _) in node.ports.items() if sim_link.is_up}
            ack = decide(frame, node.table.entries, mtus, node.table.sides, end.port)
            if isinstance(ack, Drop):
                self.dropped[ack.reason] += 1
            elif isinstance(ack, Forward):
                self.dropped += Counter(ack.lost)
        super()._deliver(end, frame)


def note_others(monkeypatch: pytest.MonkeyPatch) -> Counter[DropReason]:
    """Return a growing count of the drops of switches' machines of other kinds than DATA."""
    others: Counter[DropReason] = Counter()
    send = Unicast._send

    def noted_send(self: Unicast, hop: Hop | DropReason, frames: Sequence[bytes]) -> None:
        for frame in frames:
            before = self.drops.copy()
            send(self, hop, [frame])
            if frame[KIND_AT] != Kind.DATA:
                others.update(self.drops - before)

    expire = PendingFrames.expire

    def noted_expire(self: PendingFrames, now_s: float) -> None:
        def waiting() -> int:
            return sum(each.frame[KIND_AT] != Kind.DATA for queue in self._by_name.values() for each in queue)

        before = waiting()
        expire(self, now_s)
        others[DropReason.PENDING_EXPIRED] += before - waiting()

    monkeypatch.setattr(PendingFrames, "expire", noted_expire)
    monkeypatch.setattr(Unicast, "_send", noted_send)
    return others


class Books:
    """Best-effort flow over five switches, three of them transit, and the sum of the fates of its messages."""

    def __init__(self, others: Counter[DropReason]) -> None:
        self._others = others
        self.world = Simulation(topology=chain(5))
        assert self.world.run_until_attached()
        self.flow = flowing(self.world, source=A, readers=(B,), reliable=False)
        self.network = self.world.network
        self.network.run(1)
        assert isinstance(self.network, Ledger)
        self.ledger = self.network
        self._before = self._machines()
        self._attempts = 0

    def stream(self, count: int, every_s: float = 0.001) -> None:
        """Publish this many messages from now on."""
        self._attempts += count
        self.flow.stream(count, every_s, SIZE - 4)

    def inject(self, frame: bytes, mac: bytes) -> None:
        """Let a frame come in at the first switch."""
        self._attempts += 1
        self.network.inject("s1", 0, frame, mac)

    def reasons(self) -> Counter[DropReason]:
        """Return the drop reasons of messages: planes, switches' machines, both members."""
        return self.ledger.dropped + self._machines() - self._before

    def settle(self) -> None:
        """Wait until no frame moves, and add up."""
        self.network.run(3)
        self.flow.collect()
        world = self.world
        pending = sum(len(switch.resolver.pending) for switch in world.switches.values())
        ends = {"delivered": len(self.flow.got[B]), "parked": pending, **self.ledger.taken}
        assert self.ledger.taken["flying"] == pending == 0
        assert self._attempts == sum(ends.values()) + sum(self.reasons().values()), (ends, self.reasons())

    def _machines(self) -> Counter[DropReason]:
        found: Counter[DropReason] = Counter()
        for switch in self.world.switches.values():
            found += Counter({reason: switch.drops().get(reason, 0) for reason in ON_THE_WAY})
        for label in (A, B):
            found += Counter(self.world.members[label].drops())
        return found - self._others


@pytest.fixture
def books(monkeypatch: pytest.MonkeyPatch) -> Books:
    """Running flow whose counters are open."""
    monkeypatch.setattr(worlds, "SimNetwork", Ledger)
    return Books(note_others(monkeypatch))


def test_when_nothing_goes_wrong_all_is_delivered(books: Books) -> None:
    books.stream(500)
    books.settle()
    assert len(books.flow.got[B]) == 500


def test_loss_by_chance_adds_up(books: Books) -> None:
    for sim_link in books.world.cables.values():
        sim_link.loss = 0.05
    books.stream(500)
    books.settle()
    assert 0 < books.ledger.taken["lost"] < 500
    assert books.reasons().keys() <= {DropReason.LIFESPAN}  # a fifth is lost: the publisher takes that for congestion


@pytest.mark.parametrize("down_s", [0.02, 0.3])
def test_a_link_that_is_pulled_under_a_stream_adds_up(books: Books, down_s: float) -> None:
    sim_link = books.world.cables[MIDDLE]
    books.stream(1_000)
    books.network.call(0.1, partial(books.network.set_link, sim_link, False))
    books.network.call(0.1 + down_s, partial(books.network.set_link, sim_link, True))
    books.settle()
    assert len(books.flow.got[B]) < 1_000


def test_a_link_that_becomes_narrower_than_what_is_under_way_adds_up(books: Books) -> None:
    books.stream(1_000)
    books.network.call(0.1, partial(books.network.set_mtu, books.world.cables[MIDDLE], 700))
    books.settle()
    assert books.reasons()[DropReason.TOO_BIG] > 0


@pytest.mark.parametrize("says_goodbye", [True, False])
def test_a_reader_that_is_gone_adds_up(books: Books, says_goodbye: bool) -> None:
    def leave() -> None:
        books.flow.collect()
        if says_goodbye:
            books.world.members[B].leave()
            books.network.send_pending(B)
        else:
            books.network.stop(B)

    books.stream(12_000)
    books.network.call(0.1, leave)
    books.network.run(11)
    books.settle()
    assert books.reasons()[DropReason.NO_READER] > 0


def test_a_switch_that_dies_in_between_adds_up(books: Books) -> None:
    books.stream(2_000)
    books.network.call(0.1, partial(books.network.stop, "s3"))
    books.network.run(2)
    books.settle()
    assert books.ledger.taken["dead"] > 0


def test_a_source_that_loses_its_switch_adds_up(books: Books) -> None:
    books.stream(2_000)
    books.network.call(0.1, partial(books.network.set_link, books.world.leads[A], False))
    books.network.call(0.5, partial(books.network.set_link, books.world.leads[A], True))
    books.network.run(3)
    books.settle()


def test_frames_of_strangers_add_up_at_every_switch(books: Books) -> None:
    tap = Tap(A, "s1")
    books.network.taps.append(tap)
    books.stream(1)
    books.network.run(0.1)
    (frame,) = (frame for frame, header in zip(tap.frames, tap.headers, strict=True) if header.kind == Kind.DATA)
    books.network.taps.remove(tap)
    mac = books.network._nodes[A].ports[0][1].mac
    wrong = {
        "expires": frame[:HOPS_AT] + b"\x03" + frame[HOPS_AT + 1 :],
        "to unknown": frame[:32] + os.urandom(32) + frame[64:],
        "of unknown": frame[:64] + os.urandom(32) + frame[96:],
        "altered": frame[:-1] + bytes([frame[-1] ^ 1]),
        "again": frame,
        "too short": frame[:-20],
        "to unknown, at the end": frame[:HOPS_AT] + b"\x01" + frame[HOPS_AT + 1 : 32] + os.urandom(32) + frame[64:],
    }
    for each in wrong.values():
        for sender in (mac, b"\x02evil\x00"):
            books.inject(each, sender)
    books.settle()


def altered(frame: bytes, at: int, value: bytes) -> bytes:
    return frame[:at] + value + frame[at + len(value) :]


def test_every_frame_that_a_reader_gets_is_delivered_or_dropped_for_a_reason(books: Books) -> None:
    flow, world = books.flow, books.world
    tap = Tap("s5", B)
    books.network.taps.append(tap)
    books.stream(20)
    books.settle()
    frames = [frame for frame, header in zip(tap.frames, tap.headers, strict=True) if header.kind == Kind.DATA]
    member, now = world.members[B], books.network.now
    given: list[bytes] = []
    for frame in frames:
        given += [
            frame,
            frame[:50],
            frame[:-1],
            altered(frame, 0, b"\x07"),
            altered(frame, KIND_AT, b"\x6f"),
            altered(frame, 4, b"\x12\x34"),
            altered(frame, 24, os.urandom(8)),
            altered(frame, 32, os.urandom(32)),
            altered(frame, 64, os.urandom(32)),
            altered(frame, 120, b"other"),
            altered(frame, 8, (1 << 40).to_bytes(8, "big")),
        ]
    before, delivered = sum(member.drops().values()), len(flow.got[B])
    for frame in given:
        member.receive([ReceivedFrame(0, b"\x02evil\x00", frame)], now)
    flow.collect()
    assert len(flow.got[B]) == delivered
    assert sum(member.drops().values()) - before == len(given)


def test_reliable_messages_that_were_published_all_come_whatever_the_books_say_of_their_frames(books: Books) -> None:
    flow = advertise(books.world, "/reliable", A)
    flow.read_by(B)
    assert books.network.run(5, lambda: flow.is_read_by(1))
    for sim_link in books.world.cables.values():
        sim_link.loss = 0.05
    flow.stream(200, 0.002, 5_000)
    assert books.network.run(20, lambda: flow.has(B, 200))
    (writer_proxy,) = books.world.members[B].subscriptions.writer_proxies_of(flow.topic.name)
    assert (flow.numbers(B), writer_proxy.losses.total) == (list(range(200)), 0)
