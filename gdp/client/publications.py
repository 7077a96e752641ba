"""Publications of a participant: a publisher for each name, and unicast streams where it serves or calls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.path_mtu import PathMtu
from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPaths
from gdp.client.reader_proxies import TOPICS
from gdp.client.request_streams import RequestStreams
from gdp.client.send_options import PublisherSettings, SendOptions
from gdp.client.send_scheduler import SendScheduler
from gdp.client.sequence_numbers import SequenceRegistry
from gdp.client.timer_queue import TimerQueue
from gdp.client.unicast_stream import Party, PeerIncarnation
from gdp.client.unicast_streams import UnicastStreams
from gdp.congestion.scavenger import ScavengingController
from gdp.control.join import Join
from gdp.crypto.control_seal import topic_of
from gdp.errors import DropReason, LocalError, StatementError
from gdp.frame.codec import Header
from gdp.message.loss import LossReason
from gdp.names import Name


class Publications:
    """All publishers of one participant.

    Args:
        heard: returns another party of a service, if it is connected now.

    Attributes:
        requests: to the servers of each name that is called.
        holding: those of them with copies that have not begun.
        timers: of the publishers.
        reader_paths: to the readers of all of them but those at the priority ``background``.
        background_paths: to the readers of those; ``all_paths``: both.
        scheduler: the order in which they send.
    """

    def __init__(self, source: WriterIdentity, heard: Callable[[Name, bytes], Party | None]) -> None:
        self._source = source
        self._heard = heard
        self._publishers: dict[Name, Publisher] = {}
        self._private: dict[Name, UnicastStreams] = {}  # by service
        self.requests: dict[Name, RequestStreams] = {}
        self.holding: dict[RequestStreams, None] = {}
        self._paths: dict[Name, PathMtu] = {}
        self._sequence_registry = SequenceRegistry()
        self.timers = TimerQueue[Publisher]()
        self.reader_paths = ReaderPaths()
        self.background_paths = ReaderPaths(ScavengingController)
        self.all_paths = self.reader_paths, self.background_paths
        self.scheduler = SendScheduler(self.timers, self.background_paths)
        self._drops: Counter[DropReason] = Counter()  # of closed publishers
        self._losses: Counter[LossReason] = Counter()

    def __iter__(self) -> Iterator[Publisher]:
        return iter(self._publishers.values())

    def __contains__(self, name: Name) -> bool:
        return name in self._publishers

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        publishers = sum((publisher.drops for publisher in self), self._drops)
        return sum((streams.drops for streams in self._private.values()), publishers)

    def unconfirmed(self) -> Counter[LossReason]:
        """Return how many messages some reader did not get, as far as known here, by reason."""
        counts = sum((publisher.losses.counts for publisher in list(self)), self._losses)
        return sum((streams.losses for streams in list(self._private.values())), counts)

    def is_acknowledged(self, name: Name) -> bool:
        """Return whether every reader of a name has confirmed everything, what was sent to it alone included.

        Readers that may return count. Best-effort messages have left instead. Without readers nothing waits but
        what is kept for those that may come.
        """
        each_of = self._all_of(name)
        return all((each.is_acknowledged() or not each.is_wanted) and not each.queue.awaited for each in each_of)

    def unacknowledged(self, name: Name) -> int:
        """Return how many messages on a name some reader has not confirmed, or have not left if none does."""
        return sum(each.messages - each.acknowledgements.acknowledged for each in self._all_of(name) if each.is_wanted)

    def get(self, name: Name) -> Publisher | None:
        """Return the publisher of a name, or None."""
        return self._publishers.get(name)

    def add(self, name: Name, secrets: Secrets, description: bytes, settings: PublisherSettings) -> Publisher:
        """Publish a name from now on, above all numbers that were used for it before."""
        publisher = Publisher(
            topic=name,
            source=self._source,
            secrets=secrets,
            description=description,
            settings=settings,
            past=self._sequence_registry.of(name),
            reader_paths=self._paths_for(settings.options),
        )
        publisher.published = self.scheduler.add
        self._publishers[name] = publisher
        return publisher

    def enable_unicast(self, name: Name, secrets: Secrets, settings: PublisherSettings) -> None:
        """Enable unicast streams on a published name from now on."""
        public, paths_to = self._publishers[name], self._paths_for(settings.options)
        self.requests[name] = RequestStreams(public, partial(self.stream_to, name), paths_to, self.holding)
        self._private[name] = UnicastStreams(
            service=name,
            writer=self._source,
            secrets=secrets,
            sequence_registry=self._sequence_registry,
            published=self.scheduler.add,
            settings=replace(settings, patience=TOPICS),
            reader_paths=paths_to,
        )

    def remove(self, name: Name) -> bool:
        """Stop publishing a name; return whether it was published."""
        publisher, streams = self._publishers.pop(name, None), self._private.pop(name, None)
        self._paths.pop(name, None)
        if (requests := self.requests.pop(name, None)) is not None:
            requests.close()
        if publisher is None:
            return False
        self._sequence_registry.put(name, publisher.past)
        publisher.close()
        self._drops += publisher.drops
        self._losses += publisher.losses.counts
        if streams is not None:
            streams.close()
            self._drops += streams.drops
            self._losses += streams.losses
        return True

    def renew(self, name: Name, secrets: Secrets, now_s: float) -> None:
        """Replace a name's secrets."""
        for each in (self._publishers.get(name), self._private.get(name)):
            if each is not None:
                each.renew(secrets, now_s)

    def stream_to(self, service: Name, party: Name, now_s: float) -> Publisher:
        """Return the unicast stream to a party of a service.

        Raises:
            LocalError: it is not connected, or there are too many.
        """
        streams, heard = self._private.get(service), self._heard(service, party)
        if streams is None or heard is None:
            raise LocalError(f"{party.short} is not heard on {service.short}")
        return streams.stream(heard, self._publishers[service].queue.mtu, now_s)

    def release_requests(self, now_s: float) -> None:
        """Begin the copies of requests that have waited for a faster one to leave."""
        for requests in list(self.holding):
            requests.release(now_s)

    def forget(self, service: Name, party: PeerIncarnation) -> None:
        """Drop the stream to a party of a service that is gone."""
        streams = self._private.get(service)
        if streams is not None:
            streams.forget(party)

    def receive_introduction(self, header: Header, frame: bytes) -> None:
        """Process a reader's introduction. Raises ``RemoteError``: it concerns nothing that is published here."""
        publisher = self._publishers.get(topic_of(header, frame))  # type: ignore[call-overload]
        if publisher is None:
            raise StatementError(DropReason.NOT_FOR_US)
        publisher.receive_introduction(header, frame)

    def receive_acknack(self, header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> None:
        """Process a reader's sealed report, which came ``waited_s`` before.

        Raises:
            RemoteError: it concerns nothing that is published here, or there are too many unicast streams.
        """
        topic = topic_of(header, frame)
        publisher = self._publishers.get(topic) or self._stream(topic, header.source, now_s)  # type: ignore[call-overload]
        publisher.receive_acknack(header, frame, now_s, waited_s)
        self.scheduler.handle_report(publisher, now_s)

    def receive_join(self, join: Join, now_s: float) -> None:
        """Note that a tree is installed, and its MTU."""
        publisher = self._publishers.get(join.topic)
        if publisher is not None and join.publisher == self._source.name and join.path > 1:
            publisher.governing_paths.second_until_s = now_s + join.lease_s
        if publisher is not None and join.publisher == self._source.name and join.lease_s > 0:
            path = self._paths.setdefault(join.topic, PathMtu())
            mtu, is_split = path.receive_mtu(join.mtu, now_s), False
            for each in (publisher, *self._private.get(join.topic, ())):
                is_split |= each.tree_stands(mtu)
                self.scheduler.add(each)
            if is_split:
                path.count()

    def handle_timer(self, now_s: float) -> None:
        """Process the timers that are due."""
        timers = self.timers
        for publisher in timers.poll_due(now_s) if timers.touched or now_s >= timers.due_s else ():
            publisher.handle_timer(now_s)
            self.scheduler.add(publisher)
        for streams in self._private.values() if self._private else ():
            streams.forget_idle(now_s)
        for paths in self.all_paths:
            if now_s >= paths.due_s and paths.handle_timer(now_s):
                self.scheduler.resume()
        if self.holding:
            self.release_requests(now_s)

    def attachment_changed(self, now_s: float) -> None:
        """Measure all paths again: frames leave by another switch."""
        for paths in self.all_paths:
            paths.attachment_changed(now_s)
        self.scheduler.resume()

    def _paths_for(self, options: SendOptions) -> ReaderPaths:
        return self.background_paths if options.is_background else self.reader_paths

    def _all_of(self, name: Name) -> list[Publisher]:
        """Return the publisher of a name and its unicast streams."""
        public = self._publishers.get(name)
        return [*([] if public is None else [public]), *self._private.get(name, ())]

    def _stream(self, stream: bytes, reader: bytes, now_s: float) -> Publisher:
        """Return the unicast stream that a report concerns."""
        for service, streams in self._private.items():
            heard = self._heard(service, reader)
            if heard is None or not streams.is_about(stream, heard):
                continue
            known = streams.get(heard.incarnation_id)
            if known is not None:
                return known
            try:
                return streams.stream(heard, self._publishers[service].queue.mtu, now_s)
            except LocalError as error:
                raise StatementError(DropReason.QUOTA, "private streams") from error
        raise StatementError(DropReason.NOT_FOR_US)
