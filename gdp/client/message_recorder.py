"""Recorder of one writer: hands on each message as it was sealed, and seals for itself what no reader gets.

Sans-I/O. A capsule (``gdp/capsule``) keeps what it hands on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from gdp.client.key_epochs import KeyEpochs
from gdp.crypto.envelope import Sealed
from gdp.frame.codec import Flag
from gdp.limits import FRAME_MAX_BYTES, SEQUENCE_BYTES
from gdp.message.bundle import BUNDLE_BYTES, Gathered, pack

OnSealed = Callable[[Sealed, int, int], None]  # of a message: its frames, its first sequence number, its messages

_BUNDLE: Final = int(Flag.BUNDLE)


class Numbering(Protocol):
    """A send queue, as its recorder needs it."""

    next_number: int
    flags: int
    mtu: int | None
    depth: int

    def set_depth(self, depth: int) -> None:
        """Set how many messages are latched, and adopt ``next_number``."""


class MessageRecorder:
    """Recorder of a send queue.

    Args:
        on_sealed: gets each message, and each bundle of several.
        on_described: gets the sealed description before the messages that it describes.
    """

    def __init__(self, queue: Numbering, keys: KeyEpochs, on_sealed: OnSealed, on_described: OnSealed) -> None:
        self._queue = queue
        self._keys = keys
        self.on_sealed = on_sealed
        self._on_described = on_described
        self._unsent = Gathered()

    def add(self, message: bytes, sequence: int) -> None:
        """Record a message that is not sent; small ones wait to be bundled."""
        unsent = self._unsent
        if unsent.messages and unsent.first + len(unsent.messages) != sequence:
            self.seal_unsent()
        unsent.add(sequence, message)
        if unsent.held_bytes > BUNDLE_BYTES:
            self.seal_unsent()

    def seal_unsent(self) -> None:
        """Seal what waits. Its message numbers are a gap to readers, as those of evicted messages are."""
        queue, unsent = self._queue, self._unsent
        if not unsent.messages:
            return
        while unsent.messages:
            sequence, (together, _) = unsent.first, unsent.poll_batch(BUNDLE_BYTES)
            count, prefix = len(together), sequence.to_bytes(SEQUENCE_BYTES, "big")
            body, flags = together[0] if count == 1 else pack(together), queue.flags | _BUNDLE * (count > 1)
            self.on_sealed(self._seal(flags, body, prefix), sequence, count)
        queue.set_depth(queue.depth)  # the window learns of the numbers

    def seal_mark(self, name: str, time_ns: int) -> Sealed:
        """Return the sealed name and time of an event, which no reader gets."""
        self.seal_unsent()
        sealed = self._seal(self._queue.flags, name.encode(), time_ns.to_bytes(SEQUENCE_BYTES, "big"))
        self._queue.set_depth(self._queue.depth)
        return sealed

    def _seal(self, flags: int, body: bytes, prefix: bytes) -> Sealed:
        number = self._queue.next_number
        self._queue.next_number += 1
        return self._keys.data.seal(number, flags, body, self._mtu, prefix)

    def record_description(self, number: int, heartbeat: bytes) -> None:
        """Record a Heartbeat with the description that holds from now on."""
        self._on_described(self._keys.status.seal(number, self._queue.flags, heartbeat, self._mtu), 0, 0)

    @property
    def _mtu(self) -> int:
        return FRAME_MAX_BYTES if self._queue.mtu is None else self._queue.mtu
