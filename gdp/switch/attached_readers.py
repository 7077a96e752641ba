"""Readers that are attached to a switch: nodes that read a topic, serve or call."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from gdp.errors import DropReason, StatementError
from gdp.limits import READERS_MAX
from gdp.message.shares import Shares
from gdp.names import Name
from gdp.switch.trees import Downstream, owner_of
from gdp.trust.advertisement import Advertisement


@dataclass(slots=True)
class AttachedReader:
    """A node attached here that reads a topic, serves or calls.

    Attributes:
        costs: of the paths to those that it hears, as it knows them.
    """

    advertisement: Advertisement
    expires_s: float
    costs: dict[Name, int] = field(default_factory=dict)


class AttachedReaders:
    """Attached readers of one switch, by topic and place."""

    def __init__(self) -> None:
        self._by_topic: dict[Name, dict[Downstream, AttachedReader]] = {}
        self._shares = Shares(READERS_MAX)
        self._end_s = float("inf")  # no reader's lease ends before

    def of(self, topic: Name) -> Mapping[Downstream, AttachedReader]:
        """Return the readers of a topic, by where they are attached."""
        return self._by_topic.get(topic, {})

    def wanting_costs(self) -> Iterator[tuple[Downstream, AttachedReader]]:
        """Yield the readers that want the costs of paths, with their places."""
        for readers in self._by_topic.values():
            for at, reader in readers.items():
                if reader.advertisement.wants_costs:
                    yield at, reader

    def topics_at(self, at: Downstream) -> list[Name]:
        """Return the topics of the readers that are attached at a place."""
        return [topic for topic, readers in self._by_topic.items() if at in readers]

    def advertisement_of(self, topic: Name, at: Downstream) -> Advertisement | None:
        """Return the advertisement of a reader attached there, or None."""
        reader = self.of(topic).get(at)
        return None if reader is None else reader.advertisement

    def put(self, advertisement: Advertisement, at: Downstream, now_s: float) -> bool:
        """Add the verified advertisement of a reader; return whether it is the name's first here.

        Raises:
            StatementError: QUOTA, the node reads too many topics.
        """
        topic, expires_s = advertisement.name, now_s + advertisement.lease_s
        is_first = topic not in self._by_topic
        if at not in self.of(topic) and not self._shares.reserve(owner_of(at)):
            raise StatementError(DropReason.QUOTA, "topics that one node reads")
        self._by_topic.setdefault(topic, {})[at] = AttachedReader(advertisement, expires_s)
        self._end_s = min(self._end_s, expires_s)
        return is_first

    def remove(self, topic: Name, at: Downstream) -> bool:
        """Remove a reader; return whether the topic has none left here."""
        readers = self._by_topic.get(topic, {})
        if readers.pop(at, None) is not None:
            self._shares.release(owner_of(at))
        if not readers:
            self._by_topic.pop(topic, None)
        return not readers

    def expired(self, now_s: float) -> list[tuple[Name, Downstream]]:
        """Return the topics and places of readers whose lease has ended; the caller removes them."""
        if now_s < self._end_s:
            return []
        everyone = [(topic, *each) for topic, readers in self._by_topic.items() for each in readers.items()]
        self._end_s = min((each.expires_s for _, _, each in everyone if each.expires_s > now_s), default=float("inf"))
        return [(topic, at) for topic, at, reader in everyone if reader.expires_s <= now_s]

    def next_expiry(self) -> float:
        """Return a monotonic second that is no later than the end of the next lease; infinite: there is none."""
        return self._end_s
