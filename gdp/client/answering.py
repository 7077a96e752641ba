"""All private streams of one server: which clients it answers, and which of them it may forget.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final

from gdp.client.pasts import Pasts
from gdp.client.private import IDLE_S, AnswerStream, Life, private_name
from gdp.client.publisher import Publisher
from gdp.client.source import Secrets, Source
from gdp.errors import DropReason, LocalError
from gdp.names import Name

__all__ = ["STREAMS_MAX", "Answering"]

STREAMS_MAX: Final = 1_024


class Answering:
    """The clients of one service.

    Args:
        urgent: whether answers go before what is not.
        pasts: of what was forgotten; shared by all that this life publishes.
        published: told of each stream that has something to send.
    """

    def __init__(
        self,
        service: Name,
        server: Source,
        secrets: Secrets,
        pasts: Pasts,
        published: Callable[[Publisher], None],
        *,
        urgent: bool,
    ) -> None:
        self._service = service
        self._server = server
        self._secrets = secrets
        self._pasts = pasts
        self._published = published
        self._urgent = urgent
        self._streams: dict[Name, AnswerStream] = {}  # by client
        self._look_at_s = 0.0  # no stream is idle for long enough before
        self._drops: Counter[DropReason] = Counter()  # of streams that are gone

    def __iter__(self) -> Iterator[AnswerStream]:
        return iter(self._streams.values())

    def __len__(self) -> int:
        return len(self._streams)

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        return sum((stream.drops for stream in self), self._drops)

    def is_about(self, stream: bytes, client: Life) -> bool:
        """Return whether this is the name of the stream to a client, whether there is one or not."""
        known = self._streams.get(client.name)
        return stream == (known.topic if known is not None else self._name_of(client))

    def stream(self, client: Life, mtu: int | None, now_s: float) -> AnswerStream:
        """Return the stream to a client, made if it is not there.

        Args:
            client: one that is heard.
            mtu: smallest on the way to all clients; None where that is not known yet.

        Raises:
            LocalError: there are too many, all of them in use.
        """
        stream = self._streams.get(client.name)
        if stream is None:
            self._make_room()
            past = self._pasts.of(self._name_of(client))
            stream = self._streams[client.name] = AnswerStream(
                self._service, self._server, client, self._secrets,
                mtu=mtu, urgent=self._urgent, past=past, now_s=now_s,
            )  # fmt: skip
            stream.published = self._published
        stream.touch(now_s)
        return stream

    def forget(self, client: Life) -> None:
        """Let go of the stream to a client, if there is one; another to the same life goes on above its numbers."""
        stream = self._streams.get(client.name)
        if stream is not None and stream.client == client:
            del self._streams[client.name]
            self._pasts.put(stream.topic, stream.past)
            stream.close()
            self._drops += stream.drops

    def forget_idle(self, now_s: float) -> None:
        """Let go of streams that nobody has read or written for long."""
        if now_s >= self._look_at_s:
            self._look_at_s = now_s + IDLE_S / 4
            for client in [stream.client for stream in self if stream.is_idle(now_s)]:
                self.forget(client)

    def renew(self, secrets: Secrets) -> None:
        """Take the service's secrets anew."""
        self._secrets = secrets
        for stream in self:
            stream.renew(secrets)

    def close(self) -> None:
        """Answer nobody any more."""
        for client in [stream.client for stream in self]:
            self.forget(client)

    def _name_of(self, client: Life) -> Name:
        return private_name(self._service, Life(self._server.name, self._server.incarnation), client)

    def _make_room(self) -> None:
        if len(self._streams) < STREAMS_MAX:
            return
        silent = next((stream.client for stream in self if not stream.readers), None)
        if silent is None:
            raise LocalError(f"{STREAMS_MAX} clients of {self._service.short} are being answered: no more at once")
        self.forget(silent)
