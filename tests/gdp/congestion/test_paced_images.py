"""A small flow next to images that leave whole, each when the queue holds less than a set time of them."""

from __future__ import annotations

from dataclasses import dataclass

from hypothesis import example, given
from hypothesis import strategies as st

from gdp.congestion.controller import PathController
from gdp.congestion.delivery_rate import DeliveryRate, Flight
from tests.draws import draws
from tests.gdp.congestion.simulated_path import MTU, Flow, SimulatedPath

SMALL_S, IMAGES_S = 3.0, 4.0  # from when the flow offers little, and images leave
SETTLED_S, END_S = 10.0, 30.0
LEAST = 0.96  # of what the flow offers


@dataclass(frozen=True)
class Shared:
    """Path of two flows.

    Args:
        queue_s: as much of the images may wait when the next one begins.
        image_frames: frames of an image.
        share: of the path, that the small flow offers.
        report_s: how long its reader holds back reports.
    """

    mbit_s: float
    rtt_s: float
    fifo_s: float
    queue_s: float
    image_frames: int
    share: float
    report_s: float


class ImageSender:
    """Sends whole images as long as fewer than so many frames are under way, whatever else the path carries."""

    def __init__(self, most: int, image_frames: int) -> None:
        self._most, self._image_frames, self._left = most, image_frames, 0
        self._rate = DeliveryRate()
        self._under_way: set[Flight] = set()

    def next_send_s(self, size: int) -> float | None:
        if not self._left and len(self._under_way) < self._most:
            self._left = self._image_frames
        return 0.0 if self._left else None

    def sent(self, size: int, now_s: float) -> Flight:
        self._left -= 1
        flight = self._rate.sent(size, now_s)
        self._under_way.add(flight)
        return flight

    def acknowledged(self, flights: list[Flight], now_s: float) -> None:
        self._under_way.difference_update(flights)

    def lost(self, flights: list[Flight], now_s: float) -> None:
        self._under_way.difference_update(flights)


def paths() -> st.SearchStrategy[Shared]:
    """Draw a path and its two flows."""
    return st.builds(
        Shared,
        st.sampled_from([4.0, 8.0, 20.0]),
        st.sampled_from([0.02, 0.04, 0.06, 0.1]),
        st.sampled_from([0.2, 0.5, 1.0]),
        st.sampled_from([0.02, 0.04, 0.08]),
        st.sampled_from([1, 8, 22]),
        st.sampled_from([0.1, 0.15, 0.25]),
        st.sampled_from([0.0, 0.02]),
    )


@draws(4, long=200)
@given(paths())
@example(Shared(8.0, 0.06, 0.5, 0.08, 22, 0.25, 0.0))  # had 0.89 of what it offered
@example(Shared(20.0, 0.06, 0.5, 0.04, 22, 0.25, 0.0))  # 0.87
@example(Shared(20.0, 0.02, 0.5, 0.04, 8, 0.25, 0.0))  # 0.84
@example(Shared(20.0, 0.06, 1.0, 0.08, 1, 0.25, 0.0))  # 0.86
def test_a_small_flow_that_had_the_path_keeps_what_it_offers_next_to_paced_images(shared: Shared) -> None:
    bytes_s = shared.mbit_s * 1e6 / 8
    link = SimulatedPath(bits_s=shared.mbit_s * 1e6, rtt_s=shared.rtt_s, fifo_bytes=int(bytes_s * shared.fifo_s))
    small = link.add(Flow(PathController(MTU), ack_every_s=shared.report_s))

    def offer_little() -> None:
        small.offered_bytes_s = shared.share * bytes_s
        small.sent_bytes = int(small.offered_bytes_s * SMALL_S)

    link.at(SMALL_S, offer_little)
    images = ImageSender(int((shared.queue_s + shared.rtt_s) * bytes_s / MTU), shared.image_frames)
    link.add(Flow(images, start_s=IMAGES_S, ack_every_s=0.02))
    link.run(END_S)
    assert small.share(SETTLED_S, END_S, link.bits_s) >= LEAST * shared.share
