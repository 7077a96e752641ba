"""Counters of a proxy, as its metrics expose them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from gdp.telemetry.sources import Histogram


@dataclass(slots=True, kw_only=True)
class Traffic:
    """Counts of one proxy.

    Attributes:
        unread: messages that had no reader.
        thinned: messages left out because their rule limits the rate.
        dropped: messages that endpoints dropped because a local node did not keep up.
        late: responses of servers that were not the first.
        unexpected: responses of servers that had no request.
        hedged: second copies of requests.
        answered: by the overlay name of a service, 64 hex digits: the answered calls of local clients, and what they
            took together, in milliseconds.
        latency: one-way, from the remote proxy's stamp, as our clock shows it, until delivery to the endpoint here.
    """

    messages_out: int = 0
    bytes_out: int = 0
    messages_in: int = 0
    bytes_in: int = 0
    unread: int = 0
    thinned: int = 0
    dropped: int = 0
    late: int = 0
    unexpected: int = 0
    hedged: int = 0
    answered: dict[str, tuple[int, float]] = field(default_factory=dict)
    latency: Histogram = field(default_factory=Histogram)

    def sent(self, size: int) -> None:
        """Count an outgoing message of this many bytes."""
        self.messages_out += 1
        self.bytes_out += size

    def received(self, size: int) -> None:
        """Count an incoming message of this many bytes."""
        self.messages_in += 1
        self.bytes_in += size

    def call_ended(self, service: str, took_s: float) -> None:
        """Count an answered call of a local client."""
        ended, total_ms = self.answered.get(service, (0, 0.0))
        self.answered[service] = ended + 1, total_ms + 1_000 * took_s

    def messages(self) -> Mapping[str, int]:
        """Return the counts of messages by outcome."""
        return {
            "in": self.messages_in,
            "out": self.messages_out,
            "unread": self.unread,
            "thinned": self.thinned,
            "dropped": self.dropped,
        }

    def calls(self) -> Mapping[str, int]:
        """Return the counts of calls that several servers of one service cause: late, unexpected, hedged."""
        return {"late": self.late, "unexpected": self.unexpected, "hedged": self.hedged}

    def message_bytes(self) -> Mapping[str, int]:
        """Return the bytes carried, before sealing, by direction."""
        return {"in": self.bytes_in, "out": self.bytes_out}
