"""History of topics read from a holder: its capsules are audited, opened, decoded and merged by time.

I/O by its caller's ``ask``.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.opening import CapsuleOpener, Kept, NamedMark
from gdp.capsule.reading import CapsuleReader, given
from gdp.capsule.record import Record, split
from gdp.client.participant import Topic
from gdp.errors import GdpError
from gdp.limits import MESSAGE_MAX_BYTES
from proxy.bridge.core.decoder import MessageDecoder
from proxy.bridge.core.reduction import MessageExpander, expander_of
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage, TopicDescription

AskHolder = Callable[[HolderRequest], HolderAnswer]


class PastMessage(NamedTuple):
    """One message, as ROS wrote it.

    Attributes:
        stamp_ns: when the writer's proxy received it.
    """

    stamp_ns: int
    channel: Channel
    raw: bytes
    sequence: int


class TopicHistory:
    """History of one topic, of all its writers.

    Args:
        name: of its channels in a recording.
        from_ns: messages from this time on, by the writer's clock, 0: all; up to ``to_ns``.

    Attributes:
        readers: of its capsules.
        unreadable: messages that could not be decoded, as texts with their count.
    """

    def __init__(self, ask: AskHolder, topic: Topic, name: str, from_ns: int, to_ns: int) -> None:
        self._ask = ask
        self.name = name
        found = ask(HolderRequest(ask=Ask.LIST, topic=topic.name)).descriptors
        self.readers = [CapsuleReader(each, topic.secrets, from_ns=from_ns, to_ns=to_ns) for each in given(found)]
        self.unreadable: dict[str, int] = {}

    def messages(self) -> Iterator[PastMessage]:
        """Yield the messages of all writers in the order of their stamps, as far as each writer's rise."""
        return heapq.merge(*map(self._of_writer, self.readers), key=_stamp)

    def _of_writer(self, reader: CapsuleReader) -> Iterator[PastMessage]:
        decoders: dict[bytes, Sequence[tuple[MessageExpander, MessageDecoder]]] = {}
        while not reader.is_done:
            for kept in reader.handle_response(self._ask(reader.next_request())):
                try:
                    message = self._decoded(kept, decoders)
                except GdpError as error:
                    self.unreadable[str(error)] = self.unreadable.get(str(error), 0) + 1
                    continue
                yield message

    def _decoded(
        self, kept: Kept, decoders: dict[bytes, Sequence[tuple[MessageExpander, MessageDecoder]]]
    ) -> PastMessage:
        ready = decoders.get(kept.description)
        if ready is None:
            description = TopicDescription.from_cbor(kept.description)
            ready = decoders[kept.description] = [
                (
                    expander_of(description, source, MESSAGE_MAX_BYTES),
                    MessageDecoder(source, description.encoding, replace(source, topic=self.name), None),
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
        opener = CapsuleOpener(topic.name, each.writer.name, topic.secrets, each.key)
        for wire in split(ask(HolderRequest(ask=Ask.MARKS, capsule=each.name)).data):
            opener.open(Record.from_wire(wire))
        marks += opener.marks
    return marks


def merged(histories: Iterable[TopicHistory]) -> Iterator[PastMessage]:
    """Yield the messages of several topics in the order of their stamps."""
    return heapq.merge(*[each.messages() for each in histories], key=_stamp)


def _stamp(message: PastMessage) -> int:
    return message.stamp_ns
