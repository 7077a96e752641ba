"""Sealer of a reader's reports and introductions, under the key epochs of the topic.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

Reports are sealed under the epoch of the newest verified message. A silent writer may have moved to another epoch, or
may have lost its state of this reader. Therefore reports are at times sealed under another epoch too, with an
introduction.
"""

from __future__ import annotations

from typing import Final

from gdp.client.identities import PublisherIdentity, ReaderIdentity
from gdp.client.key_epochs import Secrets
from gdp.crypto.control_seal import ControlContext, ControlSealer, control_key
from gdp.crypto.envelope import seal_key
from gdp.frame.codec import Kind
from gdp.intervals import READER
from gdp.message.acknack import AckNack
from gdp.names import Name

_TRIES: Final = 3  # under one epoch, before the next is tried


class AckNackSealer:
    """Sealer of what one reader sends to one writer.

    Args:
        secrets: topic secrets by epoch.
        introduces: introductions are sent; else the writer has the reader's key from another source.

    Attributes:
        epoch: under which reports are sealed.

    Raises:
        StatementError: MALFORMED, the publisher's ``exchange`` is no key.
    """

    def __init__(
        self,
        *,
        topic: Name,
        reader: ReaderIdentity,
        publisher: PublisherIdentity,
        secrets: Secrets,
        introduces: bool,
        now_s: float,
    ) -> None:
        self._topic = topic
        self._reader = reader
        self._publisher = publisher
        self._introduces = introduces
        self._secrets = secrets
        self._shared = reader.control_keys.shared(publisher.exchange)
        self._sealers: dict[int, ControlSealer] = {}
        self._tried = 0
        self._epoch_at = -1  # number of the message that had this epoch
        self._silent_s = now_s  # start of the writer's silence, or time of the last introduction
        self.epoch = max(secrets)

    def handle_message(self, number: int, epoch: int, now_s: float) -> None:
        """Note the epoch of a verified message."""
        self._silent_s = now_s
        if number >= self._epoch_at:
            self.epoch, self._epoch_at = epoch, number

    def handle_status(self, epoch: int, now_s: float, *, is_newest: bool) -> None:
        """Note the epoch of a verified Heartbeat."""
        self._silent_s = now_s
        if is_newest:
            self.epoch = epoch

    def renew(self, secrets: Secrets) -> None:
        """Replace the topic's secrets."""
        self._secrets = secrets
        self._sealers.clear()
        if self.epoch not in secrets:
            self.epoch = max(secrets)

    def seal(self, acknack: AckNack) -> bytes:
        """Return the frame of a report."""
        return self.sealer(self.epoch).seal(acknack.to_wire())

    def seal_first(self, acknack: AckNack) -> list[bytes]:
        """Return the frames of an introduction and a report to a writer that has not responded yet."""
        self.epoch = self._epoch_to_try()
        return [*self._introduction(self.epoch), self.seal(acknack)]

    def seal_all(self, acknack: AckNack, now_s: float) -> list[bytes]:
        """Return the frames of a report; to a silent writer also an introduction, in turn under every epoch."""
        frames = [self.seal(acknack)]
        if now_s - self._silent_s >= READER.lease_s / 2:
            self._silent_s = now_s
            epoch = self._epoch_to_try()
            frames += self._introduction(epoch)
            if epoch != self.epoch:
                frames.append(self.sealer(epoch).seal(acknack.to_wire()))
        return frames

    def sealer(self, epoch: int) -> ControlSealer:
        """Return the sealer of reports under an epoch. Raises ``KeyError``: there is no secret of that epoch."""
        if epoch not in self._sealers:
            key = control_key(self._shared, self._secrets[epoch], *self._context(Kind.ACKNACK))
            self._sealers[epoch] = self._note_sealer(key, epoch, Kind.ACKNACK)
        return self._sealers[epoch]

    def _introduction(self, epoch: int) -> list[bytes]:
        """Return the frames that prove the sender of these reports, sealed under the secret of an epoch."""
        if not self._introduces:
            return []
        reader = self._reader
        key = seal_key(self._secrets[epoch], Kind.INTRODUCTION, reader.name, reader.incarnation, self._publisher.name)
        return [self._note_sealer(key, epoch, Kind.INTRODUCTION).seal(reader.introduction())]

    def _note_sealer(self, key: bytes, epoch: int, kind: Kind) -> ControlSealer:
        return ControlSealer(key=key, epoch=epoch, context=self._context(kind), numbers=self._reader.note_numbers)

    def _context(self, kind: Kind) -> ControlContext:
        reader, publisher = self._reader, self._publisher
        ends = reader.name, reader.incarnation, publisher.name, publisher.incarnation
        return ControlContext(kind, *ends, self._topic)

    def _epoch_to_try(self) -> int:
        """Return the newest epoch, and in turn the others, because the writer may not have the newest yet."""
        epochs = sorted(self._secrets, reverse=True)
        epoch = epochs[self._tried // _TRIES % len(epochs)]
        self._tried += 1
        return epoch
