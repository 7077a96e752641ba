"""A topic of far publishers on its way in: joined while somebody local reads it, decoded, converted, published here.

Place: shell; endpoint and member do the I/O. The virtual publisher stands as long as the rule does, so that local
tools see the topic; the overlay's tree stands while a local reader does. Where another one must take its place, to
promise more, that one has what a latched topic keeps: readers get it again, as from any publisher that restarts.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence, Set
from dataclasses import replace

from gdp.client.member import Message, Topic
from gdp.errors import LocalError, RemoteError
from gdp.message.loss import Losses
from proxy.bridge.incoming import Incoming
from proxy.bridge.pace import Pace
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Wish
from proxy.endpoints.endpoint import End, Event, Faulted
from proxy.faults import Fault
from proxy.parcel import Description, Parcel
from proxy.qos import default, offer, unmatched
from proxy.serial.channel import Channel, Qos
from proxy.serial.schema import DefinitionError
from proxy.sources import Sources
from proxy.tally import Tally

__all__ = ["ImportedTopic"]

_SAMPLES_MAX = 4_096  # latencies kept
_FAR_MAX = 1_024  # publishers whose QoS is kept; the oldest go


class ImportedTopic:
    """Carries one far topic in.

    Raises:
        LocalError: this graph does not take a publisher of it.
    """

    def __init__(self, site: Site, seat: Seat, wish: Wish, topic: Topic) -> None:
        self._site = site
        self._seat = seat
        self._wish = wish
        self._topic = topic
        self._wants: tuple[Qos, ...] = ()
        self._unmatched: Set[str] = frozenset()  # keys of readers that want what cannot be had
        self._handle: int | None = None
        self._channel: Channel | None = None  # as it is offered here
        self._far: dict[bytes, Qos] = {}  # what publishers offer, by name
        self._kept = deque[bytes]()  # what the virtual publisher keeps for late joiners, for another one in its place
        self._sources = Sources[Incoming]()
        self._is_joined = False
        self._past_losses = Losses()  # of when a local reader stood before
        self._pace = Pace(wish.rule.max_hz)
        self.tally = Tally(wish.local, wish.type_name, latencies_ms=deque(maxlen=_SAMPLES_MAX))
        if (known := self._known()) is not None:  # else the far side's own definition may do
            self._offer(known)

    def follow(self, ends: Sequence[End]) -> None:
        """Learn who reads here now."""
        self._wants = tuple(end.qos for end in sorted(ends, key=lambda end: end.key) if end.qos is not None)
        self._tell_unmatched(ends)
        if ends and not self._is_joined:
            self._is_joined = True
            self._site.member.subscribe(self._topic)
        elif not ends and self._is_joined:
            self._leave()
            if self._channel is not None and self._channel.latched:
                self._kept.clear()
                self._shut()  # what it keeps grows old, and comes again with the next reader
        if self._channel is not None:
            self._offer(self._channel)
        self._sources.forget_refused()  # others may do now

    def receive(self, message: Message, now_s: float) -> None:
        """Take a message from the overlay."""
        try:
            self._receive(message, now_s)
        except RemoteError as error:
            self.tally.refused += 1
            self._site.faults.tell(self._wish.local, Fault.MALFORMED, str(error))

    def take(self, event: Event, now_s: float) -> None:
        """Take what the endpoint says of the virtual publisher."""
        del now_s
        if isinstance(event, Faulted):
            self._site.tell(self._wish.local, event, Fault.QOS)

    def close(self, now_s: float) -> None:
        """Carry nothing any more."""
        del now_s
        if self._is_joined:
            self._leave()
        self.count_losses()
        self._shut()

    def renew(self, topic: Topic) -> None:
        """Take the delegation anew."""
        self._topic = topic
        if self._is_joined:
            self._site.member.renew(topic)

    def count_losses(self) -> None:
        """Bring the tally's losses up to date."""
        self.tally.losses = losses = Losses()
        losses.update(self._past_losses)
        if self._is_joined:
            losses.update(self._site.member.losses_of(self._topic.name))

    def _leave(self) -> None:
        self._is_joined = False
        self._past_losses.update(self._site.member.losses_of(self._topic.name))
        self._site.member.unsubscribe(self._topic.name)

    def _shut(self) -> None:
        if self._handle is not None:
            self._seat.close(self._handle)
            self._handle = None

    def _tell_unmatched(self, ends: Sequence[End]) -> None:
        """Tell, once, of each reader that wants what cannot be had."""
        odd = {end.key: (end.node or "a node", policy) for end in ends if end.qos and (policy := unmatched(end.qos))}
        for key in odd.keys() - self._unmatched:
            detail = "{} will get nothing: {}, which no network can promise".format(*odd[key])
            self._site.faults.tell(self._wish.local, Fault.QOS, detail)
        if self._unmatched and not odd:
            self._site.faults.over(self._wish.local, Fault.QOS)
        self._unmatched = odd.keys()

    def _receive(self, message: Message, now_s: float) -> None:
        delivered, traffic, rule = message.delivered, self._site.traffic, self._wish.rule
        publisher = delivered.publisher
        if (publisher, message.description) not in self._sources:
            self._sources.put(publisher, message.description, None)
            ready = self._describe(publisher, Description.from_wire(message.description))
            self._sources.put(publisher, message.description, ready)
        incoming = self._sources.get(publisher, message.description)
        if incoming is None or self._handle is None:
            self.tally.refused += 1
            return
        if not self._pace.may_pass(now_s):
            traffic.thinned += 1
            return
        parcel = Parcel.from_wire(delivered.message)
        raw = incoming.decode(parcel.body)
        if len(raw) > rule.max_bytes:
            self.tally.refused += 1
            detail = f"a message of {len(raw)} bytes; the rule's max_bytes is {rule.max_bytes}"
            self._site.faults.tell(self._wish.local, Fault.TOO_LARGE, detail)
            return
        self._seat.endpoint.publish(self._handle, raw)
        self._kept.append(raw)
        latency_ms = (time.time_ns() - parcel.stamp_ns) / 1e6
        self.tally.count_number(delivered.publisher, delivered.incarnation, delivered.number, delivered.place)
        self.tally.add(latency_ms, delivered.parts, delivered.hops)
        traffic.latency.observe(latency_ms / 1e3)
        traffic.received(len(delivered.message))

    def _describe(self, publisher: bytes, description: Description) -> Incoming | None:
        """Make ready for a publisher's messages; None if they cannot be had here."""
        source, what = description.channels[0], self._wish.local
        if source.type_name != self._wish.type_name:
            self._site.faults.tell(what, Fault.OTHER_TYPE, f"the far side sends {source.type_name}")
            return None
        try:
            incoming = Incoming.ready(source, description.encoding, self._known(), self._seat.endpoint.ros)
        except DefinitionError as error:
            self._site.faults.tell(what, Fault.OTHER_TYPE, f"the far side's definition does not fit: {error}")
            return None
        self._far[publisher] = source.qos[0] if source.qos else default(latched=source.latched)
        while len(self._far) > _FAR_MAX:
            del self._far[next(iter(self._far))]
        try:
            self._offer(incoming.target)
        except LocalError as error:
            self._site.faults.tell(what, Fault.UNKNOWN_TYPE, str(error))
            return None
        return incoming

    def _known(self) -> Channel | None:
        try:
            return self._seat.endpoint.channel(self._wish.local, self._wish.type_name)
        except LocalError:
            return None

    def _offer(self, channel: Channel) -> None:
        """Be the publisher that the far one is, as far as local readers allow; again where that has changed."""
        profile = offer(tuple(self._far.values()), self._wants, is_latched=self._wish.rule.wants_latched)
        latched = profile.durability == "transient_local"
        offered = replace(channel, topic=self._wish.local, qos=(profile,), latched=latched, callerid=None)
        if self._handle is not None and self._channel is not None and _is_served(self._channel, offered):
            return
        self._shut()
        self._handle = self._seat.advertise(self, offered)
        self._channel = offered
        self._kept = deque(self._kept if latched else (), maxlen=profile.depth if latched else 0)
        for raw in self._kept:  # who joins late finds them at the new one, too
            self._seat.endpoint.publish(self._handle, raw)


def _is_served(standing: Channel, wanted: Channel) -> bool:
    """Return whether a publisher that stands does for what is wanted: the same, or only with a smaller depth."""
    if replace(standing, qos=()) != replace(wanted, qos=()):
        return False
    before, after = standing.qos[0], wanted.qos[0]
    return replace(before, depth=0) == replace(after, depth=0) and before.depth >= after.depth
