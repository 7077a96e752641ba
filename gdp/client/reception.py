"""Reception of a participant: frames go to their writer proxies; messages and reports come out."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from gdp.client.subscription import Message, Subscription, Subscriptions
from gdp.client.timer_queue import TimerQueue
from gdp.client.writer_proxy import WriterProxy
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Header
from gdp.intervals import JOIN, NEVER_S
from gdp.limits import PACE_MAX
from gdp.names import Name
from gdp.sansio import ReceivedFrame


class Reception:
    """The writer proxies of one participant, with those that have news.

    Args:
        state: states to the switch the pace of what a publisher (the second name) sends to a topic.

    Attributes:
        under_way: the writer proxy whose next fragment is expected.
        fed: writer proxies that received frames since the last ``hand_out``.
        messages: that arrived, in order within each writer proxy; the participant hands them out.
        reporting: writer proxies whose report may be due.
        timers: of the writer proxies.
    """

    def __init__(
        self,
        subscriptions: Subscriptions,
        send: Callable[[list[bytes]], None],
        state: Callable[[Name, Name, int], None],
    ) -> None:
        self._subscriptions = subscriptions
        self._send = send
        self._state = state
        self.fed: dict[WriterProxy, Subscription] = {}
        self.under_way: tuple[WriterProxy, Subscription] | None = None
        self.messages: list[Message] = []
        self.reporting: dict[WriterProxy, None] = {}
        self.timers = TimerQueue[WriterProxy]()
        self._paces: dict[tuple[Name, Name], tuple[int, float]] = {}  # stated; and when again, by topic and publisher

    def receive(self, header: Header, arrival: ReceivedFrame, now_s: float) -> None:
        """Pass a frame to its writer proxy. Raises ``StatementError``: NOT_FOR_US."""
        found = self._subscriptions.find(header, now_s)
        if found is None:
            raise StatementError(DropReason.NOT_FOR_US)
        subscription, writer_proxy = found
        writer_proxy.receive(header, arrival.frame, now_s, arrival.waited_s)
        self.fed[writer_proxy] = subscription
        if header.parts > 1:
            self.under_way = writer_proxy, subscription

    def hand_out(self, now_s: float) -> None:
        """Take the messages of the writer proxies that received frames."""
        for writer_proxy, subscription in self.fed.items():
            self.messages += subscription.poll_messages(writer_proxy.publisher)
            if writer_proxy.is_report_due(now_s):
                self.reporting[writer_proxy] = None  # it states for how long it held back what it reports
            self.timers.touched[writer_proxy] = None
        self.fed = {}

    def handle_timer(self, now_s: float) -> None:
        """Process the timers that are due."""
        timers = self.timers
        for writer_proxy in timers.poll_due(now_s) if timers.touched or now_s >= timers.due_s else ():
            writer_proxy.handle_timer(now_s)
            self.reporting[writer_proxy] = None
            subscription = self._subscriptions.get(writer_proxy.topic) if writer_proxy.delivery.ready else None
            if subscription is not None:  # it has gone on without what is lost
                self.messages += subscription.poll_messages(writer_proxy.publisher)

    def report(self, now_s: float) -> None:
        """Send the reports that are due."""
        for writer_proxy in self.reporting:
            if writer_proxy.pace < PACE_MAX or self._paces:
                self._state_pace(writer_proxy, now_s)
            notes = writer_proxy.control_to_send(now_s)
            if notes:
                self._send(notes)
            self.timers.touched[writer_proxy] = None
        self.reporting.clear()

    def _state_pace(self, writer_proxy: WriterProxy, now_s: float) -> None:
        """State the pace of a writer proxy to the switch, if it is new there or was stated a while ago."""
        key, pace = (writer_proxy.topic, writer_proxy.publisher), writer_proxy.pace
        stated, again_s = self._paces.get(key, (PACE_MAX, NEVER_S))
        if pace != stated or now_s >= again_s:
            self._paces[key] = pace, now_s + JOIN.refresh_s
            self._state(*key, pace)
            if pace == stated == PACE_MAX:
                del self._paces[key]

    def close(self, writer_proxies: Iterable[WriterProxy], *, goodbye: bool) -> None:
        """Close writer proxies; ``goodbye``: also send each publisher a goodbye."""
        self.under_way = None
        for writer_proxy in writer_proxies:
            notes = writer_proxy.close()
            if goodbye:
                self._send(notes)
            self.reporting.pop(writer_proxy, None)
            self.timers.touched[writer_proxy] = None
