"""Late joiners of a topic that is kept: a holder has what the publisher's memory has no more."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from gdp.capsule.holder import HolderAnswer
from gdp.capsule.late_join import LateJoin
from gdp.client.participant import Message
from gdp.limits import WINDOW_BYTES
from gdp.names import Name
from gdp.service.replication import Mode, Replication
from gdp.session.protocol.client_core import Call, ClientCore
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.capsules import BACKGROUND, STORE, Holder, Keeping
from tests.journeys.flows import advertise, row

READER = "nuc2/edge"


@dataclass
class Joiner:
    """Member that joins late, with a grant of its own."""

    world: Simulation
    name: str
    messages: int
    age_s: float | None = None
    got: list[Message] = field(default_factory=list)
    call: Call | None = None

    def __post_init__(self) -> None:
        member = self.world.members[READER]
        topic = self.world.topic(self.name, member, [Right.READ])
        unix_s = self.world.network.now.unix_s
        self.join = LateJoin(topic, unix_s, self.age_s, self.messages, WINDOW_BYTES)
        self.client = ClientCore(
            member, self.world.topic(STORE, member, [Right.CALL], kind="service"), STORE, start=9, options=BACKGROUND
        )
        member.subscribe(topic)
        self.topic: Name = topic.name
        self.world.network.send_pending(READER)

    def work(self) -> None:
        now_s, member = self.world.network.now.mono_s, self.world.members[READER]
        for message in member.poll_messages():
            if message.topic == self.topic:
                self.join.receive_live(message, now_s)
            else:
                self.client.receive(message, now_s)
        if (due_s := self.client.get_timer()) is not None and now_s >= due_s:
            self.client.handle_timer(now_s)
        if self.call is not None and self.call.is_done:
            call, self.call = self.call, None
            if call.response is None:
                self.join.give_up()
            else:
                self.join.handle_response(HolderAnswer.from_cbor(call.response.payload), now_s)
        if self.call is None and (request := self.join.next_request(now_s)) is not None:
            self.call = Call(payload=request.to_cbor(), timeout_s=5.0, replication=Replication(Mode.SOME, copies=1))
            self.client.begin(self.call, now_s)
        self.got += self.join.poll_messages()
        member.flush(now_s)
        self.world.network.send_pending(READER)

    @property
    def numbers(self) -> list[int]:
        return [int(each.delivered.message) for each in self.got]


def joining(
    tmp_path: Path, *, depth: int = 0, messages: int = 1_000, age_s: float | None = None, has_holder: bool = True
) -> tuple[Joiner, int]:
    """Return a joiner that came after 200 messages of ten seconds, while 60 more came; and how many there are."""
    world = row(lease_s=5.0)
    world.add_member(READER, "nuc2")
    assert world.run_until_attached()
    keeping = Keeping(advertise(world, depth=depth), tmp_path / "robot")
    holder = Holder(world, tmp_path / "holder")
    keeping.publish_at([0.05 * each for each in range(260)], lambda each: b"%d" % each)
    keeping.run(10, holder)
    holders = [holder] if has_holder else []
    joiner = Joiner(world, "/chatter", messages, age_s)

    def step() -> bool:
        joiner.work()
        return False

    keeping.run(9, *holders, until=step)
    return joiner, 260


@pytest.mark.parametrize("depth", [0, 20], ids=["nothing in memory", "a latched part"])
def test_the_past_and_the_live_part_are_one_stream(tmp_path: Path, depth: int) -> None:
    joiner, count = joining(tmp_path, depth=depth)
    assert joiner.numbers == list(range(count))
    assert {each.description for each in joiner.got} == {b"described"}
    assert joiner.join.is_done


def test_as_many_as_were_asked_for_come_and_none_that_are_older(tmp_path: Path) -> None:
    joiner, count = joining(tmp_path, messages=70)
    first = joiner.numbers[0]
    assert joiner.numbers == list(range(first, count))
    assert 200 - 70 <= first < 200 - 30
    aged, _ = joining(tmp_path / "aged", age_s=3.0)
    assert aged.numbers == list(range(aged.numbers[0], count))
    assert 200 - 72 <= aged.numbers[0] <= 200 - 30


def test_without_its_holder_the_live_part_comes(tmp_path: Path) -> None:
    joiner, count = joining(tmp_path, has_holder=False)
    assert joiner.numbers == list(range(joiner.numbers[0], count))
    assert joiner.numbers[0] >= 199
