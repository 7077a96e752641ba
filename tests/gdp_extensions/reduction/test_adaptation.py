"""Topics that adapt to their path: what a publisher shows of its messages decides about the next ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from gdp.client.governing_paths import GoverningPaths
from gdp.message.loss import Losses, LossReason, LostRange
from gdp_extensions.reduction.adaptation import PathAdaptation
from gdp_extensions.reduction.adaptive import AdaptBounds
from gdp_extensions.reduction.picture import HAS_LIBRARY
from proxy.bridge.core.reduction import Adaptation, adaptation_of
from tests.gdp_extensions.reduction.samples import image
from tests.gdp_extensions.reduction.test_reductions import CAMERA, flowing
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import Sites
from tests.proxy.rule_files import furnish, rule

CHATTER = f"name: /chatter, type: {STRING}"
NOISE = np.random.default_rng(1).normal(128, 40, (120, 160)).clip(0, 255).astype(np.uint8)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


@dataclass(slots=True)
class FakePath:
    """A publisher as an adaptation sees it."""

    path_bytes_s: float | None = None
    acknowledged: int = 0
    losses: Losses = field(default_factory=Losses)


def run(
    adaptation: Adaptation, path: FakePath, seconds: float, lag: int, begin_s: float = 0.0, size: int = 10_000
) -> int:
    """Offer 30 messages a second, each acknowledged ``lag`` messages later; return how many may leave."""
    sent = path.acknowledged + path.losses.total
    before = sent
    for number in range(int(30 * seconds)):
        now_s = begin_s + number / 30
        path.acknowledged = max(sent - lag - path.losses.total, path.acknowledged)
        if adaptation.may_send(path.losses, path.acknowledged, path.path_bytes_s, now_s):
            sent += 1
            adaptation.handle_sent(sent, size, now_s)
    return sent - before


def test_messages_that_leave_at_once_all_may_leave() -> None:
    assert run(PathAdaptation(AdaptBounds()), FakePath(), 10, lag=0) == 300


def test_a_publisher_that_holds_messages_back_gets_fewer() -> None:
    adaptation = PathAdaptation(AdaptBounds())
    run(adaptation, path := FakePath(), 5, lag=0)
    assert run(adaptation, path, 5, lag=12, begin_s=5) < 100


def test_messages_without_a_reader_or_too_large_are_no_sign_of_the_path() -> None:
    adaptation, path = PathAdaptation(AdaptBounds()), FakePath()
    run(adaptation, path, 3, lag=0)
    for reason in (LossReason.NO_READER, LossReason.TOO_LARGE):
        path.losses.add(LostRange(1, 5, reason))
    assert run(adaptation, path, 3, lag=0, begin_s=3) == 90


def test_dropped_messages_lower_the_quality() -> None:
    adaptation, path = PathAdaptation(AdaptBounds()), FakePath()
    run(adaptation, path, 3, lag=1)
    best = adaptation.quality
    path.losses.add(LostRange(1, 1, LossReason.QUEUE_OVERFLOW))
    run(adaptation, path, 0.2, lag=1, begin_s=3)
    assert adaptation.quality < best


def test_a_rule_states_the_bounds(tmp_path: Path) -> None:
    furnish(tmp_path)
    assert type(adaptation_of(rule(tmp_path, "name: /a"))) is Adaptation
    adaptation = adaptation_of(rule(tmp_path, "name: /a, image: jpeg, quality: 60, max_hz: 5, adapt: true"))
    assert adaptation.quality == 60
    assert run(adaptation, FakePath(), 10, lag=0) == pytest.approx(50, abs=1)


def test_a_topic_that_adapts_crosses_whole_on_a_wide_path(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites, ", adapt: true, encoding: cdr, reliable: false", CHATTER)
    sites.every(0.05, 60, lambda number: talker.publish(string(str(number))))
    sites.run(4)
    assert ear.texts == [str(number) for number in range(60)]
    assert robot.context.traffic.thinned == 0


@pytest.mark.skipif(not HAS_LIBRARY, reason="Pillow is not installed")
def test_the_rate_that_a_publisher_states_decides_about_quality_and_rate(
    sites: Sites, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, _, talker, ear = flowing(sites, ", image: jpeg, adapt: true, encoding: cdr, reliable: false", CAMERA)
    raw = image("mono8", NOISE.shape, NOISE)
    traffic = robot.context.traffic
    sites.every(0.05, 40, lambda _: talker.publish(raw))
    sites.run(3)
    wide, traffic.bytes_out = traffic.bytes_out / len(ear.heard), 0
    assert len(ear.heard) == 40
    ear.heard.clear()
    monkeypatch.setattr(GoverningPaths, "bytes_s", property(lambda _: wide * 20 / 4))
    sites.every(0.05, 100, lambda _: talker.publish(raw))
    sites.run(6)
    assert traffic.bytes_out < 6 * wide * 20 / 4
    assert traffic.bytes_out / len(ear.heard) < 0.7 * wide
    assert 30 < len(ear.heard) < 100
    assert traffic.thinned == 100 - len(ear.heard)
