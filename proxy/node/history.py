"""History of topics read from a holder: its capsules are audited, opened, decoded and merged by time.

I/O by its caller's ``ask``.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.opening import CapsuleOpener, Kept, NamedMark
from gdp.capsule.reading import CapsuleReader, given
from gdp.capsule.record import Record, split
from gdp.client.participant import Topic
from gdp.errors import GdpError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.names import Name
from proxy.bridge.core.decoder import MessageDecoder
from proxy.bridge.core.reduction import MessageExpander, expander_of
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage, TopicDescription

AskHolder = Callable[[HolderRequest], HolderAnswer]
_Decoders: TypeAlias = dict[tuple[Name, bytes], Sequence[tuple[MessageExpander, MessageDecoder]]]


class PastMessage(NamedTuple):
    """One message, as ROS wrote it.

    Attributes:
        stamp_ns: when the writer's proxy received it.
    """

    stamp_ns: int
    channel: Channel
    raw: bytes
    sequence: int


class History:
    """History of topics, of all their writers; a capsule with several of them is read once.

    Args:
        topics: with the names of their channels in a recording.
        from_ns: messages from this time on, by the writer's clock, 0: all; up to ``to_ns``.

    Attributes:
        readers: of the capsules.
        names: of the topics' channels.
        unreadable: messages that could not be decoded, as texts with their count, by topic.
    """

    def __init__(self, ask: AskHolder, topics: Sequence[tuple[Topic, str]], from_ns: int, to_ns: int) -> None:
        self._ask = ask
        self.names = {topic.name: name for topic, name in topics}
        secrets = {topic.name: topic.secrets for topic, _ in topics}
        found = [each for name in secrets for each in ask(HolderRequest(ask=Ask.LIST, topic=name)).descriptors]
        self.readers = [
            CapsuleReader(
                each, {name: secrets[name] for name in each.topics if name in secrets}, from_ns=from_ns, to_ns=to_ns
            )
            for each in given({each.name: each for each in found}.values())
        ]
        self.unreadable: dict[Name, dict[str, int]] = {name: {} for name in self.names}

    def messages(self) -> Iterator[PastMessage]:
        """Yield the messages in the order of their stamps, as far as each writer's rise."""
        return heapq.merge(*map(self._of_writer, self.readers), key=_stamp)

    def _of_writer(self, reader: CapsuleReader) -> Iterator[PastMessage]:
        decoders: _Decoders = {}
        while not reader.is_done:
            for kept in reader.handle_response(self._ask(reader.next_request())):
                try:
                    message = self._decoded(kept, decoders)
                except GdpError as error:
                    counts = self.unreadable[kept.topic]
                    counts[str(error)] = counts.get(str(error), 0) + 1
                    continue
                yield message

    def _decoded(self, kept: Kept, decoders: _Decoders) -> PastMessage:
        ready = decoders.get((kept.topic, kept.description))
        if ready is None:
            description = TopicDescription.from_cbor(kept.description)
            name = self.names[kept.topic]
            ready = decoders[kept.topic, kept.description] = [
                (
                    expander_of(description, source, MESSAGE_MAX_BYTES),
                    MessageDecoder(source, description.encoding, replace(source, topic=name), None),
                )
                for source in description.channels
            ]
        message = RosMessage.from_wire(kept.message)
        expander, decoder = ready[min(message.channel, len(ready) - 1)]
        raw = decoder.decode(*expander.expand(message))
        return PastMessage(message.stamp_ns, decoder.target, raw, kept.sequence)


def marks_of(ask: AskHolder, topic: Topic) -> list[NamedMark]:
    """Return the latest marks of a topic, of all its writers."""
    marks = list[NamedMark]()
    for each in ask(HolderRequest(ask=Ask.LIST, topic=topic.name)).descriptors:
        opener = CapsuleOpener(each, {topic.name: topic.secrets})
        for wire in split(ask(HolderRequest(ask=Ask.MARKS, capsule=each.name)).data):
            opener.open(Record.from_wire(wire))
        marks += opener.marks
    return marks


def _stamp(message: PastMessage) -> int:
    return message.stamp_ns
