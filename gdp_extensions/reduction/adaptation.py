"""Adaptation of an exposed topic: its controller, and what the overlay's publisher shows of messages on their way."""

from __future__ import annotations

from collections import deque
from typing import Final

from gdp.message.loss import Losses, LossReason
from gdp_extensions.reduction.adaptive import AdaptBounds, AdaptiveQuality
from proxy.bridge.core.reduction import Adaptation
from proxy.config.reduction import Adapt
from proxy.config.rule import Rule

_NOT_OF_THE_PATH: Final = (LossReason.NO_READER, LossReason.TOO_LARGE)


def adaptation_of(rule: Rule) -> Adaptation:
    """Return the adaptation that a rule states."""
    return Adaptation(rule.quality) if rule.adapt is None else PathAdaptation(_bounds(rule, rule.adapt))


class PathAdaptation(Adaptation):
    """Adaptation of one topic to its path; ``bounds``: of rate and quality."""

    __slots__ = ("_controller", "_dropped", "_looked_s", "_on_way", "_refused")

    def __init__(self, bounds: AdaptBounds) -> None:
        super().__init__(bounds.max_quality)
        self._controller = AdaptiveQuality(bounds)
        self._on_way = deque[tuple[int, float]]()  # count of published messages, second of publishing
        self._dropped = 0  # by the path, as far as the controller knows
        self._refused = 0  # here: the path had no space
        self._looked_s = float("-inf")  # when the publisher was looked at

    @property
    def quality(self) -> int:
        """Return the JPEG quality of the next message, 1 to 100."""
        return self._controller.quality

    def may_send(self, losses: Losses, acknowledged: int, path_bytes_s: float | None, now_s: float) -> bool:
        """Return whether a message that comes now may leave."""
        counts = losses.counts
        lost = counts.total()
        dropped = lost - self._refused - sum(counts[reason] for reason in _NOT_OF_THE_PATH)
        fresh, self._dropped = dropped - self._dropped, max(dropped, self._dropped)
        gone = acknowledged + lost
        while self._on_way and self._on_way[0][0] <= gone:
            _, sent_s = self._on_way.popleft()
            if fresh > 0:
                fresh -= 1
                self._controller.handle_dropped(1, now_s)
            else:  # it left after the last look: that wait is proven, a longer one is not
                self._controller.handle_left(max(self._looked_s - sent_s, 0.0), now_s)
        self._looked_s = now_s
        return self._controller.may_send(now_s, path_bytes_s)

    def handle_sent(self, count: int, size_bytes: int, now_s: float) -> None:
        """Count a message that was published; ``count``: as ``Publisher.publish`` returns it."""
        self._on_way.append((count, now_s))
        self._controller.handle_sent(size_bytes, now_s)

    def handle_refused(self, now_s: float) -> None:
        """Count a message that the path had no space for."""
        self._refused += 1
        self._controller.handle_refused(now_s)


def _bounds(rule: Rule, adapt: Adapt) -> AdaptBounds:
    best = rule.quality if adapt.max_quality is None else adapt.max_quality
    return AdaptBounds(
        min_hz=adapt.min_hz,
        max_hz=rule.max_hz if adapt.max_hz is None else adapt.max_hz,
        min_quality=min(adapt.min_quality, best),
        max_quality=best,
        has_quality=rule.image == "jpeg",
    )
