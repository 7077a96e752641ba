"""All traffic of a robot on a simulated link: raw images fill a fast one, and a thin one keeps them fresh."""

from __future__ import annotations

from thin_link.channel import ConstantRate

from tests.gdp.congestion.simulated_robot import JPEG, RAW, SimulatedRobot, Stream, mix

RTT_S = 0.06
BEGIN_S, SECONDS = 3.0, 2.5


def measured(mbit_s: float, camera: Stream, fifo_s: float) -> SimulatedRobot:
    bits_s = mbit_s * 1e6
    robot = SimulatedRobot(
        mix(camera), rate=ConstantRate(bits_s), bits_s=bits_s, rtt_s=RTT_S, fifo_bytes=round(bits_s * fifo_s / 8)
    )
    robot.run(BEGIN_S + SECONDS)
    return robot


def test_raw_images_fill_a_link_of_100_mbit_s_with_a_short_fifo() -> None:
    robot = measured(100, RAW, RTT_S)
    could_s = 11.5  # images a second, next to the other streams
    assert len(robot.ages("camera", BEGIN_S)) / SECONDS >= 0.9 * could_s
    assert robot.age_quantile("tf", BEGIN_S, 0.99) - RTT_S / 2 <= 0.015


def test_images_on_a_link_of_10_mbit_s_with_a_deep_fifo_are_fresh() -> None:
    robot = measured(10, JPEG, 1.0)
    assert robot.utilisation(BEGIN_S) >= 0.95
    assert robot.age_quantile("camera", BEGIN_S, 0.99) <= 0.25
