"""What a member says on its names: a publisher for each, and where it serves or calls, private streams besides.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from gdp.client.agenda import Agenda
from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.pasts import Pasts
from gdp.client.path_mtu import PathMtu
from gdp.client.private import Life, Party
from gdp.client.private_streams import PrivateStreams
from gdp.client.publisher import Publisher
from gdp.client.readers import TOPICS, Patience
from gdp.client.turns import Turns
from gdp.control.join import Join
from gdp.crypto.note import topic_of
from gdp.errors import DropReason, LocalError, StatementError
from gdp.frame.codec import Header
from gdp.message.loss import LossReason
from gdp.names import Name

__all__ = ["Publications"]


class Publications:
    """All that one member publishes.

    Args:
        source: the member.
        heard: returns another party of a service, if that is heard now.
    """

    def __init__(self, source: WriterIdentity, heard: Callable[[Name, bytes], Party | None]) -> None:
        self._source = source
        self._heard = heard
        self._publishers: dict[Name, Publisher] = {}
        self._private: dict[Name, PrivateStreams] = {}  # by service
        self._paths: dict[Name, PathMtu] = {}
        self._pasts = Pasts()
        self._agenda = Agenda[Publisher]()
        self.turns = Turns(self._agenda.touch)
        self._drops: Counter[DropReason] = Counter()  # of what is gone
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
        """Return how many messages some reader did not get, as far as it is known here, by reason."""
        counts = sum((publisher.losses.counts for publisher in list(self)), self._losses)
        return sum((streams.losses for streams in list(self._private.values())), counts)

    def get(self, name: Name) -> Publisher | None:
        """Return the publisher of a name, or None."""
        return self._publishers.get(name)

    def begin(
        self,
        name: Name,
        secrets: Secrets,
        description: bytes,
        *,
        reliable: bool,
        depth: int = 0,
        urgent: bool,
        patience: Patience = TOPICS,
    ) -> Publisher:
        """Publish a name from now on, above all numbers that were used for it before."""
        publisher = Publisher(
            topic=name,
            source=self._source,
            secrets=secrets,
            description=description,
            reliable=reliable,
            depth=depth,
            urgent=urgent,
            past=self._pasts.of(name),
            patience=patience,
        )
        publisher.published = self.turns.add
        self._publishers[name] = publisher
        return publisher

    def begin_private(self, name: Name, secrets: Secrets, *, urgent: bool) -> None:
        """Have private streams on a published name from now on."""
        self._private[name] = PrivateStreams(
            service=name,
            writer=self._source,
            secrets=secrets,
            pasts=self._pasts,
            published=self.turns.add,
            urgent=urgent,
        )

    def end(self, name: Name) -> bool:
        """Say nothing on a name any more; return whether it was published."""
        publisher, streams = self._publishers.pop(name, None), self._private.pop(name, None)
        self._paths.pop(name, None)
        if publisher is None:
            return False
        self._pasts.put(name, publisher.past)
        publisher.close()
        self._drops += publisher.drops
        self._losses += publisher.losses.counts
        if streams is not None:
            streams.close()
            self._drops += streams.drops
            self._losses += streams.losses
        return True

    def renew(self, name: Name, secrets: Secrets, now_s: float) -> None:
        """Take a name's secrets anew."""
        for each in (self._publishers.get(name), self._private.get(name)):
            if each is not None:
                each.renew(secrets, now_s)

    def tell(self, service: Name, party: Name, message: bytes, now_s: float) -> None:
        """Send a message to one other party of a service alone.

        Raises:
            LocalError: it is not heard, there are too many, or the message is above the limits.
        """
        streams, heard = self._private.get(service), self._heard(service, party)
        if streams is None or heard is None:
            raise LocalError(f"{party.short} is not heard on {service.short}")
        streams.stream(heard, self._publishers[service].mtu, now_s).publish(message)

    def forget(self, service: Name, party: Life) -> None:
        """Let go of what waits for a party of a service that is gone."""
        streams = self._private.get(service)
        if streams is not None:
            streams.forget(party)

    def take_introduction(self, header: Header, frame: bytes) -> None:
        """Take a reader's introduction.

        Raises:
            RemoteError: it is about nothing that is published here.
        """
        publisher = self._publishers.get(topic_of(header, frame))  # type: ignore[call-overload]
        if publisher is None:
            raise StatementError(DropReason.NOT_FOR_US)
        publisher.receive_introduction(header, frame)

    def take_report(self, header: Header, frame: bytes, now_s: float) -> None:
        """Take a reader's note.

        Raises:
            RemoteError: it is about nothing that is published here, or there are too many private streams.
        """
        topic = topic_of(header, frame)
        publisher = self._publishers.get(topic) or self._stream(topic, header.source, now_s)  # type: ignore[call-overload]
        publisher.receive_report(header, frame, now_s)
        self.turns.add(publisher)

    def take_join(self, join: Join, now_s: float) -> None:
        """Learn that a tree stands, and how wide it is."""
        publisher = self._publishers.get(join.topic)
        if publisher is not None and join.publisher == self._source.name and join.lease_s > 0:
            path = self._paths.setdefault(join.topic, PathMtu())
            mtu, is_split = path.take(join.mtu, now_s), False
            for each in (publisher, *self._private.get(join.topic, ())):
                is_split |= each.tree_stands(mtu)
                self.turns.add(each)
            if is_split:
                path.count()

    def timeout(self, now_s: float) -> None:
        """Do what is due."""
        for publisher in self._agenda.take_due(now_s):
            publisher.timeout(now_s)
            self.turns.add(publisher)
        for streams in self._private.values():
            streams.forget_idle(now_s)

    def next_due(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._agenda.next_due()

    def _stream(self, stream: bytes, reader: bytes, now_s: float) -> Publisher:
        """Return the private stream that a note is about."""
        for service, streams in self._private.items():
            heard = self._heard(service, reader)
            if heard is None or not streams.is_about(stream, heard.life):
                continue
            known = streams.get(heard.life)
            if known is not None:
                return known
            try:
                return streams.stream(heard, self._publishers[service].mtu, now_s)
            except LocalError as error:
                raise StatementError(DropReason.QUOTA, "private streams") from error
        raise StatementError(DropReason.NOT_FOR_US)
