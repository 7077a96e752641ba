"""Images over a path that loses frames: parity restores them without a repair, and there is none without loss."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import partial

import pytest

from gdp.client.participant import Participant
from gdp.client.send_options import SendOptions
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.trust.right import Right
from lab.network import SimLink
from tests.draws import IS_LONG
from tests.journeys.flows import Flow
from tests.journeys.test_two_paths import site
from tests.lanes import nightly

pytestmark = pytest.mark.momentary("loss and parity within a round trip are what these tests are about")

ONE_WAY_S = 0.030
LATE_S = ONE_WAY_S + 0.010  # after the last frame of a message, or of its parity, has left
STEP_S = 0.001
RATE_BYTES_S = 12.5e6
JPEG_BYTES, IMAGE_BYTES = 40_000, 921_600
IMAGES = 150 if IS_LONG else 100


@dataclass
class Camera:
    """A publisher, its readers, and the link between their switches."""

    flow: Flow
    cable: SimLink
    readers: list[Participant]
    reader_cables: list[SimLink]
    left_s: dict[int, float] = field(
        default_factory=dict
    )  # by message number: when the last of its frames and their parity first left
    came_s: list[dict[int, float]] = field(default_factory=list)  # by reader and image
    bytes_of: Counter[int] = field(default_factory=Counter)  # by kind, of what the publisher sends
    sent: int = 0

    def tap(self, at_s: float, a: str, _b: str, frame: bytes) -> None:
        """Note what the publisher sends."""
        if a == self.flow.source:
            header = decode(frame, ETHER_BYTES)
            self.bytes_of[header.kind] += len(frame)
            if header.kind == Kind.DATA and header.part == header.parts - 1:
                self.left_s.setdefault(header.number, at_s)
            elif header.kind == Kind.PARITY:
                self.left_s[header.number] = at_s

    def stream(self, count: int, period_s: float, size: int, settle_s: float = 2.0) -> None:
        """Publish images at a steady rate, and let ``settle_s`` more pass."""
        network = self.flow.world.network
        for place in range(count):
            message = (self.sent + place).to_bytes(4, "big") + bytes(size - 4)
            network.call(place * period_s, partial(self.flow.publish, message))
        self.sent += count
        end_s = network.now.mono_s + count * period_s + settle_s
        while network.now.mono_s < end_s:
            network.run(STEP_S)
            for reader, came_s in zip(self.readers, self.came_s, strict=True):
                for each in reader.poll_messages():
                    came_s.setdefault(int.from_bytes(each.delivered.message[:4], "big"), network.now.mono_s)

    def in_time(self, warm: int, reader: int = 0) -> float:
        """Return the share of the images from ``warm`` on that came in time."""
        first, came_s = min(self.left_s), self.came_s[reader]  # an image that never left keeps its number
        late_s = (came_s.get(image, 1e9) - self.left_s.get(first + image, 0.0) for image in range(warm, self.sent))
        count = sum(each <= LATE_S + STEP_S for each in late_s)
        return count / (self.sent - warm)

    def recovered(self, reader: int = 0) -> int:
        """Return how many frames parity has restored at a reader."""
        return sum(each.recovery.recovered for each in self.readers[reader].subscriptions.writer_proxies())


def camera(*, fec: bool = True, reliable: bool = False, seed: int = 1, readers: int = 1) -> Camera:
    """Return a topic that is read over a link of 30 ms and 100 Mbit/s, by one node or several at sites of their own."""
    sites = [f"s{at}" for at in range(1, readers + 1)]
    at = site([("s0", each, 10) for each in sites], tuple(sites), seed=seed)
    world, member = at.world, at.world.members["s0/robot"]
    cables = [each for _, _, each in at.cables]
    for cable in cables:
        cable.delay_s, cable.bytes_s = ONE_WAY_S - 2 * world.delay_s, RATE_BYTES_S
    topic = world.topic("/camera", member, [Right.PUBLISH])
    publisher = member.advertise(topic, b"described", reliable=reliable, options=SendOptions(fec=fec))
    world.network.send_pending("s0/robot")
    flow = Flow(world, "/camera", "s0/robot", topic, publisher)
    labels = [f"{each}/r{each}" for each in sites]
    for label in labels:
        world.members[label].subscribe(world.topic("/camera", world.members[label], [Right.READ]))
        world.network.send_pending(label)
    assert world.network.run(5, lambda: flow.is_read_by(readers))
    world.network.run(1.0)
    made = Camera(flow, cables[0], [world.members[label] for label in labels], cables)
    made.came_s = [{} for _ in labels]
    world.network.taps.append(made.tap)
    return made


@pytest.mark.parametrize(
    ("loss", "burst", "without", "with_parity"),
    [(0.05, 1.0, (0.1, 0.5), 0.95), *nightly((0.02, 8.0, (0.55, 1.0), 0.72), (0.01, 1.0, (0.6, 0.9), 0.97))],
)
def test_jpegs_come_within_one_way_and_10_ms(
    loss: float, burst: float, without: tuple[float, float], with_parity: float
) -> None:
    shares = []
    for fec in (False, True):
        made = camera(fec=fec)
        made.cable.loss, made.cable.burst_frames = loss, burst
        made.stream(IMAGES, 0.15, JPEG_BYTES)
        shares.append(made.in_time(30))
        assert bool(made.recovered()) is fec
        assert made.bytes_of[Kind.PARITY] <= 0.25 * made.bytes_of[Kind.DATA]
    assert without[0] <= shares[0] <= without[1]
    assert shares[1] >= with_parity  # a burst of eight is more than the parity of so few frames can fill


@pytest.mark.nightly
@pytest.mark.parametrize(("loss", "with_parity"), [(0.05, 0.8), (0.01, 0.9)])
def test_raw_images_come_within_one_way_and_10_ms(loss: float, with_parity: float) -> None:
    shares = []
    for fec in (False, True):
        made = camera(fec=fec)
        made.cable.loss = loss
        made.stream(20, 0.4, IMAGE_BYTES)
        shares.append(made.in_time(5))
    assert shares[0] <= 0.2  # those that lost nothing in their last 40 ms: repairs of the rest come before their end
    assert shares[1] >= with_parity


def test_a_reliable_topic_delivers_everything_in_order_with_fewer_repairs() -> None:
    repairs, latest = [], []
    for fec in (False, True):
        made = camera(fec=fec, reliable=True)
        made.cable.loss = 0.03
        made.stream(60, 0.15, JPEG_BYTES)
        assert list(made.came_s[0]) == list(range(60))
        repairs.append(made.flow.publisher.protection.repairs)
        latest.append(made.in_time(20))
    assert repairs[1] < 0.4 * repairs[0]
    assert latest[1] > 0.9 > latest[0]


def test_a_reliable_bulk_transfer_is_not_slower_by_more_than_its_parity() -> None:
    ends_s = []
    for fec in (False, True):
        made = camera(fec=fec, reliable=True)
        made.cable.loss = 0.01
        made.stream(20, 0.2, JPEG_BYTES)  # the path is measured
        begun_s = made.flow.world.network.now.mono_s
        made.stream(12, 0.0, IMAGE_BYTES, 6.0)
        assert bool(made.recovered()) is fec
        ends_s.append(max(made.came_s[0].values()) - begun_s)
        assert list(made.came_s[0]) == list(range(32))
    assert ends_s[1] <= 1.15 * ends_s[0]


def test_a_path_without_loss_carries_no_parity() -> None:
    made = camera()
    made.stream(60, 0.1, JPEG_BYTES)
    assert made.bytes_of[Kind.PARITY] == made.recovered() == made.flow.publisher.protection.parity.sent == 0
    assert made.in_time(5) == 1.0


def test_a_short_path_is_repaired_and_carries_no_parity() -> None:
    made = camera()
    made.cable.delay_s, made.cable.loss = 0.001, 0.02
    made.stream(60, 0.1, JPEG_BYTES)
    assert made.bytes_of[Kind.PARITY] == 0
    assert len(made.came_s[0]) >= 59


def test_parity_ends_when_the_loss_ends() -> None:
    made = camera()
    made.cable.loss = 0.02
    made.stream(60, 0.1, JPEG_BYTES)
    made.cable.loss = 0.0
    made.stream(200, 0.05, JPEG_BYTES)
    before = made.bytes_of[Kind.PARITY]
    made.stream(20, 0.05, JPEG_BYTES)
    assert made.bytes_of[Kind.PARITY] == before > 0


def test_restored_frames_count_as_lost_for_the_measurement() -> None:
    made = camera()
    made.cable.loss = 0.05
    made.stream(90, 0.1, JPEG_BYTES)
    assert made.recovered() > 60
    assert 0.03 < made.flow.publisher.governing_paths.loss < 0.08


def test_each_of_several_readers_restores_what_it_lost_itself() -> None:
    made = camera(readers=3)
    for cable in made.reader_cables:
        cable.loss = 0.02
    made.stream(70, 0.15, JPEG_BYTES)
    for reader in range(3):
        assert made.recovered(reader) > 10
        assert made.in_time(30, reader) > 0.9


def test_memory_of_recovery_is_released() -> None:
    made = camera()
    made.cable.loss = 0.05
    made.stream(40, 0.1, JPEG_BYTES)
    made.cable.loss = 0.0
    made.flow.world.network.run(8.0)
    assert made.readers[0].subscriptions.held_bytes == 0
    drops = Counter(made.readers[0].drops())
    assert drops[DropReason.UNUSED_PARITY]
    assert not drops[DropReason.BAD_TAG] + drops[DropReason.MALFORMED]
