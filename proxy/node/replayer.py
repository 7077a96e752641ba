"""Replay of a recording over the bridge with its own timing, and its final statistics.

I/O; drives the node's loop between messages.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from gdp.client.publisher import Publisher
from gdp.intervals import REPORT_S, TICK_S
from gdp.message.loss import LossReason
from proxy.bridge.bridge import Bridge
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.keeping import TopicKeeper
from proxy.bridge.sent_stats import SentStats
from proxy.node.node import ProxyNode
from proxy.recordings.endpoint import ReplayEndpoint

log = logging.getLogger(__name__)

STALL_S: Final = 20.0  # after this time without any acknowledgement, readers are given up

_WHY: Final = {
    LossReason.NO_READER: "published without a reader",
    LossReason.GIVEN_UP: "given up for a reader that fell silent or behind",
    LossReason.WINDOW_OVERFLOW: "pushed out of the full window",
    LossReason.TOO_LARGE: "above the rule's max_bytes",
    LossReason.LIFESPAN: "too late to leave",
}


@dataclass(frozen=True, slots=True)
class Unconfirmed:
    """A reliable topic with a message that some reader did not confirm.

    Attributes:
        messages: how many were published, including those above the rule's limit.
        why: the reason as text, as far as it is known.
        reasons: messages by reason, a message once for each reader; pending ones have none.
    """

    topic: str
    messages: int
    confirmed: int
    why: str
    reasons: Mapping[str, int]

    def words(self) -> str:
        """Return it as one line."""
        return f"{self.topic}: {self.confirmed} of {self.messages} confirmed: {self.why}"


@dataclass(frozen=True, slots=True)
class Held:
    """A topic without a reader whose holders have what its rule keeps.

    Attributes:
        messages: how many were published.
        holders: how many there are.
        bytes: of its capsule, with what earlier runs published.
    """

    topic: str
    messages: int
    holders: int
    bytes: int

    def words(self) -> str:
        """Return it as one line."""
        at = "its holder has" if self.holders == 1 else f"each of its {self.holders} holders has"
        return f"{self.topic}: {self.messages} messages without a reader; {at} its capsule, {self.bytes} bytes"


@dataclass(frozen=True, slots=True)
class ReplayedTopic:
    """One topic of the recording that a rule exposes.

    Attributes:
        topic: as it was recorded.
        indexes: of its channels in the recording.
    """

    topic: str
    type_name: str
    flow: ExposedTopic
    publisher: Publisher
    indexes: tuple[int, ...]


class Pace:
    """When messages are due, in seconds after the beginning of a replay; see ``Replay`` for the arguments."""

    def __init__(self, rate: float, empty_max_s: float | None) -> None:
        self._rate = rate
        self._empty_max_s = empty_max_s
        self._last_ns: int | None = None
        self._recorded_s = 0.0  # of the replay so far, as recorded, without what was skipped

    def due_s(self, stamp_ns: int) -> tuple[float, str]:
        """Return when a message is due, and what to say of the time before it; empty: nothing."""
        if self._rate == 0:
            return 0.0, ""
        gap_s = 0.0 if self._last_ns is None else max(0, stamp_ns - self._last_ns) / 1e9
        self._last_ns, said = stamp_ns, ""
        if self._empty_max_s is not None and gap_s > self._empty_max_s:
            said = f"no message for {_span(gap_s)} in the recording: {_span(gap_s - self._empty_max_s)} are skipped"
            gap_s = self._empty_max_s
        elif gap_s / self._rate > STALL_S:
            said = f"no message for {_span(gap_s)} in the recording: waiting; --skip-empty SECONDS skips such times"
        self._recorded_s += gap_s
        return self._recorded_s / self._rate, said


def _span(seconds: float) -> str:
    """Return a length of time with the largest unit of which it has two."""
    for unit, length_s in (("years", 31_557_600), ("days", 86_400), ("hours", 3_600), ("minutes", 60)):
        if seconds >= 2 * length_s:
            return f"{seconds / length_s:.0f} {unit}"
    return f"{seconds:.0f} s"


class Replay:
    """One replay of a recording.

    Args:
        rate: 1: as recorded, 2: twice as fast, 0: as fast as readers confirm.
        empty_max_s: of a longer time without a message, the rest is skipped; None: it is waited for.
        keeper: of topics that are kept; their holders confirm what was replayed.
    """

    def __init__(
        self,
        node: ProxyNode,
        bridge: Bridge,
        endpoint: ReplayEndpoint,
        rate: float,
        report: Callable[[], None],
        empty_max_s: float | None = None,
        keeper: TopicKeeper | None = None,
    ) -> None:
        self._node = node
        self._keeper = keeper
        self._bridge = bridge
        self._endpoint = endpoint
        self._pace = Pace(rate, empty_max_s)
        self._report = report
        self._tick_at_s = 0.0
        self.topics = [
            ReplayedTopic(
                flow_spec.local,
                flow_spec.type_name,
                flow,
                flow.publisher,
                tuple(endpoint.channels_of(flow_spec.local, flow_spec.type_name)),
            )
            for flow_spec, flow in bridge.flows
            if isinstance(flow, ExposedTopic) and flow.publisher is not None
        ]
        self._flows = {each.flow.handle: each.flow for each in self.topics}

    @property
    def sent(self) -> int:
        """Return the number of published messages, including those without a reader."""
        return sum(each.flow.published.total() for each in self.topics)

    @property
    def sent_bytes(self) -> int:
        """Return the bytes of the published messages, as recorded."""
        return sum(each.flow.published_bytes.total() for each in self.topics)

    @property
    def confirmed(self) -> int:
        """Return the number of messages of reliable topics that every reader has confirmed."""
        return sum(each.publisher.acknowledgements.acknowledged for each in self.topics if each.publisher.confirms)

    @property
    def sent_best_effort(self) -> int:
        """Return the number of messages that left on best-effort topics, which have no confirmation."""
        return sum(each.sent for each in self.best_effort())

    def best_effort(self) -> list[SentStats]:
        """Return the statistics of the best-effort topics."""
        return [SentStats.of(each.topic, each.publisher) for each in self.topics if not each.publisher.confirms]

    @property
    def too_large(self) -> int:
        """Return the number of messages above a limit, which were not sent."""
        return sum(each.publisher.losses.counts.get(LossReason.TOO_LARGE, 0) for each in self.topics)

    def unconfirmed(self) -> list[Unconfirmed]:
        """Return the reliable topics with messages that neither all readers nor, without a reader, all holders have."""
        held = {each.topic for each in self.held()}
        publishers = [(each.topic, each.publisher) for each in self.topics if each.topic not in held]
        return [
            Unconfirmed(topic, each.messages, each.acknowledgements.acknowledged, _why(each), each.losses.by_label())
            for topic, each in publishers
            if each.confirms and each.acknowledgements.acknowledged < each.messages
        ]

    def held(self) -> list[Held]:
        """Return the topics without a reader whose holders have all that their rules keep."""
        kept = {} if self._keeper is None else self._keeper.capsules.topics
        return [
            Held(each.topic, publisher.messages, len(capsule.confirmed), min(capsule.confirmed))
            for each in self.topics
            for publisher in [each.publisher]
            if (capsule := kept.get(publisher.topic)) is not None and _is_unread(publisher) and capsule.is_whole
        ]

    def wait_for_readers(self, timeout_s: float) -> list[str]:
        """Wait until every topic has a reader; return the topics that have none after ``timeout_s`` seconds."""
        deadline_s = time.monotonic() + timeout_s
        self._node.runtime.run(lambda: all(each.publisher.readers for each in self.topics), deadline_s)
        return [each.topic for each in self.topics if not each.publisher.readers]

    def run(self) -> bool:
        """Replay to the end; return False when the node was stopped before."""
        runtime, begun_s = self._node.runtime, time.monotonic()
        for message in self._endpoint.messages(self._continue):
            due_s, said = self._pace.due_s(message.stamp_ns)
            if said:
                log.warning("%s", said)
            self._step_until(begun_s + due_s)
            flow = self._flows[message.handle]
            while not flow.has_space() and not runtime.is_stopped:
                self._step(None)
            if runtime.is_stopped:
                return False
            self._endpoint.deliver(message)
            self._node.work(self._bridge)
            self._step(0.0)
        return not runtime.is_stopped

    def finish(self) -> bool:
        """Wait until readers and holders have confirmed all that they can; return False when they or the node stop.

        Readers of best-effort topics have ``REPORT_S`` to report what they lost.
        """
        progress, stalled_s = (self.confirmed, self.sent_best_effort, 0), time.monotonic()
        kept = None if self._keeper is None else self._keeper.capsules
        if kept is not None:
            kept.flush(time.time())
        while any(each.publisher.is_wanted and not each.publisher.is_acknowledged() for each in self.topics) or (
            kept is not None and not kept.is_uploaded
        ):
            if self._node.runtime.is_stopped:
                return False
            self._step(TICK_S)
            now = self.confirmed, self.sent_best_effort, 0 if kept is None else kept.confirmed
            if now != progress:
                progress, stalled_s = now, time.monotonic()
            elif time.monotonic() - stalled_s > STALL_S:
                return False
        best_effort = [each.publisher for each in self.topics if not each.publisher.confirms]
        report_until_s = time.monotonic() + REPORT_S
        self._node.runtime.run(lambda: all(each.acknowledgements.is_reported() for each in best_effort), report_until_s)
        return not self._node.runtime.is_stopped

    def _continue(self) -> bool:
        """Run the node while waiting for the recording; return whether it was not stopped."""
        self._step(0.0)
        return not self._node.runtime.is_stopped

    def _step_until(self, due_s: float) -> None:
        while time.monotonic() < due_s and not self._node.runtime.is_stopped:
            self._step(due_s - time.monotonic())

    def _step(self, at_most_s: float | None) -> None:
        """Run the node and the bridge once, for at most this many seconds."""
        now_s = time.monotonic()
        wait_s = TICK_S if at_most_s is None else min(max(at_most_s, 0.0), TICK_S)
        due_s = self._bridge.get_timer()
        self._node.runtime.step(now_s + wait_s if due_s is None else min(now_s + wait_s, max(due_s, now_s)))
        if self._bridge.get_timer() is not None:  # delegations were read again, or topics are kept
            self._bridge.work(now_s)
        if now_s >= self._tick_at_s:
            self._tick_at_s = now_s + TICK_S
            self._report()


def _is_unread(publisher: Publisher) -> bool:
    return not publisher.is_wanted and publisher.losses.counts.keys() <= {LossReason.NO_READER}


def _why(publisher: Publisher) -> str:
    """Return why some of a publisher's messages were not confirmed, as far as it is known."""
    if _is_unread(publisher):
        return "no reader"
    known = [f"{count} {_WHY[reason]}" for reason, count in publisher.losses.counts.items() if reason in _WHY]
    rest = publisher.messages - publisher.acknowledgements.acknowledged - publisher.losses.total
    if rest > 0:
        known.append(f"{rest} not confirmed by a reader that {'lags' if publisher.readers else 'fell silent'}")
    return ", ".join(known)
