"""Statistics of an exposed best-effort topic: what was sent, what was dropped here, and what readers lost.

Sans-I/O. No reader confirms a best-effort message, so "sent" says nothing about arrival.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from gdp.message.loss import LossReason

if TYPE_CHECKING:
    from gdp.client.publisher import Publisher


@dataclass(frozen=True, slots=True)
class SentStats:
    """Statistics of one topic.

    Attributes:
        messages: how many were published, including those dropped here.
        sent: how many left this machine.
        dropped: messages that did not leave, by reason.
        readers: how many there are.
        reader_lost: how many the reader that lost most reports as lost, including those dropped here.
    """

    topic: str
    messages: int
    sent: int
    dropped: Mapping[str, int]
    readers: int
    reader_lost: int

    @classmethod
    def of(cls, topic: str, publisher: Publisher) -> SentStats:
        """Return the statistics of a publisher at this moment."""
        dropped = publisher.losses.by_label()
        confirmed = publisher.acknowledgements
        return cls(topic, publisher.messages, confirmed.sent, dropped, publisher.readers, confirmed.reader_lost)

    @property
    def is_whole(self) -> bool:
        """Return whether everything that had a reader was sent, and no reader reports a loss."""
        return not (self.reader_lost or self.dropped.keys() - {LossReason.NO_READER.label})

    def words(self) -> str:
        """Return one line, such as ``/camera: 9 sent of 10 (lifespan 1), a reader lost 3``."""
        reasons = ", ".join(f"{label} {count}" for label, count in self.dropped.items())
        here = f" ({reasons})" if reasons else ""
        lost = f"a reader lost {self.reader_lost}" if self.readers else "no reader"
        return f"{self.topic}: {self.sent} sent of {self.messages}{here}, {lost}"

    def to_fields(self) -> dict[str, object]:
        """Return the statistics as one JSON object."""
        return asdict(self)
