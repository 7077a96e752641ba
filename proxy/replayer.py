"""Playing a recording onto the overlay, with its own timing.

Place: shell; drives the node's loop between messages.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from gdp.client.publisher import Publisher
from gdp.message.loss import LossReason
from proxy.node import ProxyNode
from proxy.outbound import Outbound
from proxy.recordings.reader import BagReader

__all__ = ["Played", "Replayer", "Unconfirmed"]

log = logging.getLogger(__name__)

STALL_S: Final = 20.0  # without any acknowledgement, readers are given up
TICK_S: Final = 0.5


@dataclass(slots=True)
class Played:
    """What was played so far."""

    sent: int = 0
    sent_bytes: int = 0  # as recorded
    by_channel: Counter[int] = field(default_factory=Counter)
    bytes_by_channel: Counter[int] = field(default_factory=Counter)


_WHY: Final = {
    LossReason.NO_READER: "published while nobody read it",
    LossReason.GIVEN_UP: "given up for a reader that fell silent or behind",
    LossReason.WINDOW_OVERFLOW: "pushed out of the full window",
    LossReason.TOO_LARGE: "above the rule's max_bytes",
}


@dataclass(frozen=True, slots=True)
class Unconfirmed:
    """A reliable topic of which some message was not confirmed by each of its readers.

    Attributes:
        messages: how many were published, those above the rule's limit included.
        why: in words, as far as it is known.
        reasons: messages by reason, a message once for each reader; what is still waited for has none.
    """

    topic: str
    messages: int
    confirmed: int
    why: str
    reasons: Mapping[str, int]

    def words(self) -> str:
        """Return it as one line."""
        return f"{self.topic}: {self.confirmed} of {self.messages} confirmed: {self.why}"


class Replayer:
    """Plays one recording.

    Args:
        rate: 1: as recorded, 2: twice as fast, 0: as fast as readers confirm.
        tick: called about twice a second while playing.
    """

    def __init__(
        self, node: ProxyNode, bag: BagReader, outbound: Outbound, rate: float, tick: Callable[[Played], None]
    ) -> None:
        self._node = node
        self._bag = bag
        self._outbound = outbound
        self._rate = rate
        self._tick = tick
        self._tick_at_s = 0.0
        self.played = Played()

    @property
    def confirmed(self) -> int:
        """Return how many messages of reliable topics every reader has confirmed."""
        return sum(publisher.acknowledged for publisher in self._outbound.publishers.values() if publisher.confirms)

    @property
    def sent_best_effort(self) -> int:
        """Return how many messages of best-effort topics were sent: nobody confirms them."""
        publishers = [publisher for publisher in self._outbound.publishers.values() if not publisher.confirms]
        return sum(publisher.messages - publisher.losses.total for publisher in publishers)

    def unconfirmed(self) -> list[Unconfirmed]:
        """Return the reliable topics of which something was not confirmed."""
        publishers = self._outbound.publishers.items()
        return [
            Unconfirmed(topic, each.messages, each.acknowledged, _why(each), each.losses.by_label())
            for topic, each in publishers
            if each.confirms and each.acknowledged < each.messages
        ]

    def wait_for_readers(self, patience_s: float) -> list[str]:
        """Wait until every topic has a reader; return the topics that have none when patience ends."""
        publishers = self._outbound.publishers
        deadline_s = time.monotonic() + patience_s
        self._node.runtime.run(lambda: all(each.readers for each in publishers.values()), deadline_s)
        return [topic for topic, publisher in publishers.items() if not publisher.readers]

    def play(self) -> bool:
        """Play to the end; return False when the node was stopped before."""
        begun_s = time.monotonic()
        first_ns: int | None = None
        for channel, stamp_ns, raw in self._bag.messages(self._goes_on):
            if not self._outbound.is_exposed(channel):
                continue
            first_ns = stamp_ns if first_ns is None else first_ns
            if self._rate > 0:
                self._work_until(begun_s + (stamp_ns - first_ns) / 1e9 / self._rate)
            while not self._outbound.has_room(channel) and not self._node.runtime.is_stopped:
                self._step(None)
            if self._node.runtime.is_stopped:
                return False
            if self._outbound.publish(channel, raw):
                self._count(channel, raw)
            self._step(0.0)
        return not self._node.runtime.is_stopped

    def finish(self) -> bool:
        """Wait until readers have confirmed what they may get; return False when they stop to, or when stopped."""
        publishers = self._outbound.publishers.values()
        progress, stalled_s = self.confirmed, time.monotonic()
        while any(publisher.is_wanted and not publisher.is_acknowledged() for publisher in publishers):
            if self._node.runtime.is_stopped:
                return False
            self._step(TICK_S)
            if self.confirmed != progress:
                progress, stalled_s = self.confirmed, time.monotonic()
            elif time.monotonic() - stalled_s > STALL_S:
                return False
        return True

    def _count(self, channel: int, raw: bytes) -> None:
        played = self.played
        played.sent += 1
        played.sent_bytes += len(raw)
        played.by_channel[channel] += 1
        played.bytes_by_channel[channel] += len(raw)

    def _goes_on(self) -> bool:
        """Let the node work while the recording is waited for; return whether it was not stopped."""
        self._step(0.0)
        return not self._node.runtime.is_stopped

    def _work_until(self, due_s: float) -> None:
        while time.monotonic() < due_s and not self._node.runtime.is_stopped:
            self._step(due_s - time.monotonic())

    def _step(self, at_most_s: float | None) -> None:
        """Let the node work once, for no longer than so many seconds."""
        moment_s = time.monotonic()
        wait_s = TICK_S if at_most_s is None else min(max(at_most_s, 0.0), TICK_S)
        self._node.runtime.step(moment_s + wait_s)
        if moment_s >= self._tick_at_s:
            self._tick_at_s = moment_s + TICK_S
            self._tick(self.played)


def _why(publisher: Publisher) -> str:
    """Return why not everything that a publisher has published was confirmed, as far as it is known."""
    if not publisher.is_wanted and publisher.losses.counts.keys() <= {LossReason.NO_READER}:
        return "nobody reads it"
    known = [f"{count} {_WHY[reason]}" for reason, count in publisher.losses.counts.items() if reason in _WHY]
    rest = publisher.messages - publisher.acknowledged - publisher.losses.total
    if rest > 0:
        known.append(f"{rest} not confirmed by a reader that {'lags' if publisher.readers else 'fell silent'}")
    return ", ".join(known)
