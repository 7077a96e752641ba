"""Growth of long-lived nodes in memory, while subscriptions and publishers come and go."""

from __future__ import annotations

import gc
import statistics
from collections.abc import Callable

import pytest

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import chain

pytestmark = pytest.mark.nightly

CYCLES, SAMPLES = 600, 50
WARM_UP = 0.4  # share of the samples
SHARE, LEAST_OBJECTS = 0.02, 200
OBJECTS_A_PUBLISHER = 120  # verified delegations and withdrawals, which nodes remember up to a bound
LEFT, RIGHT = "s1/left", "s3/right"


class Soak:
    """Three switches, a RIB and two members on a network in memory."""

    def __init__(self) -> None:
        self.world = Simulation(topology=chain(3), seed=1, hello_s=20.0, dead_s=70.0)  # hellos cost most otherwise
        assert self.world.run_until_attached()
        self.left, self.right = self.world.members[LEFT], self.world.members[RIGHT]

    def send(self) -> None:
        """Send what both members have to send."""
        self.world.network.send_pending(LEFT)
        self.world.network.send_pending(RIGHT)

    def until(self, is_met: Callable[[], bool]) -> None:
        """Run until something holds."""
        assert self.world.network.run(30.0, is_met)

    def publisher(self, name: str) -> Publisher:
        """Return a new publisher of a topic."""
        made = self.left.advertise(self.world.topic(name, self.left, [Right.PUBLISH]), b"soak", reliable=True)
        self.send()
        return made

    def topic(self, name: str) -> Topic:
        """Return a topic with a new delegation for its reader."""
        return self.world.topic(name, self.right, [Right.READ])

    def read_once(self, publisher: Publisher, topic: Topic) -> None:
        """Subscribe, read one message, and unsubscribe."""
        self.right.subscribe(topic)
        self.send()
        self.until(lambda: publisher.readers == 1)
        publisher.publish(b"message")
        self.left.flush(self.world.network.now.mono_s)
        self.send()
        self.until(lambda: bool(self.right.poll_messages()))
        self.right.unsubscribe(topic.name)
        self.send()


def objects_while(once: Callable[[], None], times: int) -> list[int]:
    """Return how many objects there are, at even distances while an action is repeated."""
    samples = []
    for at in range(times):
        once()
        if not (at + 1) % (times // SAMPLES):
            gc.collect()
            samples.append(len(gc.get_objects()))
    return samples


def rise(samples: list[int]) -> tuple[float, float]:
    """Return how much the line through the samples after the warm-up rises, and their scatter around it."""
    kept = samples[int(len(samples) * WARM_UP) :]
    slope, start = statistics.linear_regression(range(len(kept)), kept)
    scatter = statistics.pstdev(value - (start + slope * at) for at, value in enumerate(kept))
    return slope * (len(kept) - 1), scatter


@pytest.mark.momentary("objects are counted while no lease ends")
def test_a_reader_that_comes_and_goes_leaves_no_object_behind() -> None:
    soak = Soak()
    publisher, topic = soak.publisher("/soak"), soak.topic("/soak")

    def once() -> None:
        soak.read_once(publisher, topic)
        soak.until(lambda: not publisher.readers)

    samples = objects_while(once, CYCLES)
    grown, scatter = rise(samples)
    assert grown <= max(SHARE * statistics.fmean(samples), LEAST_OBJECTS, 2 * scatter)


def test_a_publisher_of_a_new_name_leaves_no_more_than_what_nodes_remember_up_to_a_bound() -> None:
    soak, names = Soak(), iter(range(CYCLES))

    def once() -> None:
        name = f"/soak/{next(names)}"
        publisher = soak.publisher(name)
        soak.read_once(publisher, soak.topic(name))
        soak.left.withdraw(publisher.topic)
        soak.send()
        soak.world.network.run(1.0)

    times = CYCLES // 3
    grown, scatter = rise(objects_while(once, times))
    assert grown <= max(OBJECTS_A_PUBLISHER * times * (1 - WARM_UP), 2 * scatter)
