"""A private stream: what one server answers to one client, by unicast, reliable and in order.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
Source: DESIGN section 6 ("answers return by unicast"). It is an ordinary stream, but for three things:

- its frames are addressed to the client, so any switch finds their way;
- a name that both ends derive from who they are, in this life, stands for the topic in keys and notes, and the header's
  incarnation is derived from that: a later life of either end shares nothing with it;
- nobody introduces himself. The server knows its one reader by the client's claim, and the client expects number 1.
"""

from __future__ import annotations

import hashlib
from typing import Final, NamedTuple

from gdp.client.feed import Ended, Feed, FeedState, Reader
from gdp.client.pasts import Past
from gdp.client.publisher import Publisher
from gdp.client.source import Secrets, Source
from gdp.crypto.envelope import Sealer, Signer
from gdp.frame.kinds import Kind
from gdp.limits import MTU_MIN_BYTES, REPORT_IDLE_S
from gdp.message.join import Joined, VerifiesDigest
from gdp.message.memory import Budget
from gdp.names import Name

__all__ = ["IDLE_S", "AnswerFeed", "AnswerStream", "Life", "private_incarnation", "private_name"]

IDLE_S: Final = 60.0  # without a reader and a message, after which a stream is forgotten


class Life(NamedTuple):
    """A node from one start to the next."""

    name: Name
    incarnation: int


def private_name(service: Name, server: Life, client: Life) -> Name:
    """Return the name of what a server answers to a client."""
    ends = b"".join(name + incarnation.to_bytes(8, "big") for name, incarnation in (server, client))
    return Name(hashlib.sha256(b"gdp-private-1" + service + ends).digest())


def private_incarnation(name: Name) -> int:
    """Return what stands as the source's incarnation in a private stream's headers."""
    return int.from_bytes(hashlib.sha256(b"gdp-private-incarnation-1" + name).digest()[:8], "big")


class _PrivateSealer(Sealer):
    """Seals under the key of a stream what is addressed to somebody."""

    def __init__(
        self, secret: bytes, epoch: int, kind: int, source: Source, stream: Name, destination: Name, signer: Signer
    ) -> None:
        super().__init__(secret, epoch, kind, source.name, source.incarnation, stream, signer)
        self._fixed = (epoch, kind, source.incarnation, destination, source.name)


class AnswerStream(Publisher):
    """The server's end.

    Args:
        server: its source for all clients.
        mtu: smallest on the way; None where that is not known yet.
        past: of the same stream, if it was forgotten.
    """

    def __init__(
        self,
        service: Name,
        server: Source,
        client: Life,
        secrets: Secrets,
        *,
        mtu: int | None,
        urgent: bool,
        past: Past,
        now_s: float,
    ) -> None:
        name = private_name(service, Life(server.name, server.incarnation), client)
        source = Source(server.name, private_incarnation(name), server.signer)
        self.client = client
        self._touched_s = now_s
        super().__init__(name, source, secrets, b"", reliable=True, urgent=urgent, past=past)
        self.tree_stands(MTU_MIN_BYTES if mtu is None else mtu)

    def touch(self, now_s: float) -> None:
        """Note that there is something to say, or to hear; a client that was silent is a reader again, from now on."""
        self._touched_s = now_s
        name, incarnation = self.client
        if name not in self._readers:
            self._readers.admit(name, incarnation, now_s)
            self._window.add_reader(name, self._next_number, now_s)

    def is_idle(self, now_s: float) -> bool:
        """Return whether it may be forgotten."""
        return not self._readers and now_s - self._touched_s >= IDLE_S

    def _sealer(self, kind: Kind) -> Sealer:
        source, secret = self._source, self._secrets[self._epoch]
        return _PrivateSealer(secret, self._epoch, kind, source, self.topic, self.client.name, source.signer)


class AnswerFeed(Feed):
    """The client's end.

    Args:
        name: of the stream.
        writer: verifies the server's signatures.
        ended: where the same stream ended before, in this life.
    """

    def __init__(
        self,
        name: Name,
        reader: Reader,
        server: Name,
        writer: VerifiesDigest,
        secrets: Secrets,
        budget: Budget,
        now_s: float,
        ended: Ended,
    ) -> None:
        super().__init__(name, reader, server, private_incarnation(name), writer, secrets, budget, now_s, ended)
        self.state = FeedState.LIVE
        self._is_reliable = True
        self._expected = max(ended.number, 1)
        self._data.begin(self._expected, ())
        self._report_at_s = now_s + REPORT_IDLE_S  # the server may not have heard of us yet

    def _take_status(self, joined: Joined, epoch: int, now_s: float) -> None:
        self._note = self._note_sealer(epoch)  # one that the server has
        super()._take_status(joined, epoch, now_s)
