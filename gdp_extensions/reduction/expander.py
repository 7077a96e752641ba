"""Message expander that decompresses bodies, and restores images.

Sans-I/O. Memory is bounded by the local rule: a body is decompressed to no more than its messages may have.
"""

from __future__ import annotations

from typing import Final

from gdp.errors import DropReason, RemoteError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp_extensions.reduction.compression import BodyDecompressor
from gdp_extensions.reduction.image import ImageRestorer
from proxy.bridge.core.reduction import MessageExpander, Restore
from proxy.serial.channel import Channel
from proxy.serial.serializer import Encoding
from proxy.wire.message import RosMessage, Step, TopicDescription

_TEXT_RATIO: Final = 16  # most bytes of JSON or CBOR, with the names of fields, for each byte as ROS wrote it
_TEXT_FREE_BYTES: Final = 64 << 10


class RestoringExpander(MessageExpander):
    """Expander of one channel's bodies."""

    __slots__ = ("_decompressor", "_restorer")

    def __init__(self, description: TopicDescription, source: Channel, max_bytes: int) -> None:
        super().__init__(description)
        limit = body_max_bytes(description.encoding, max_bytes)
        self._decompressor = BodyDecompressor(limit, description.dictionary) if description.is_compressed else None
        self._restorer: ImageRestorer | None = None
        if description.image is not None and source.definition_format:
            self._restorer = ImageRestorer(source, description.image, max_bytes)

    def expand(self, message: RosMessage) -> tuple[bytes, Restore | None]:
        """Return the body as the encoding has it, and what restores the decoded message; None: nothing has to."""
        body, _ = super().expand(message)
        if message.steps & Step.ZSTD and self._decompressor is not None:
            body = self._decompressor.decompress(body)
        if not message.steps & Step.IMAGE:
            return body, None
        if self._restorer is None:
            raise RemoteError(DropReason.MALFORMED, "a picture file in a channel without a definition")
        return body, self._restorer.restore


def body_max_bytes(encoding: Encoding, max_bytes: int) -> int:
    """Return the most bytes of a body, for messages of ``max_bytes`` as ROS wrote them."""
    if encoding == "cdr":
        return max_bytes
    return min(_TEXT_FREE_BYTES + _TEXT_RATIO * max_bytes, MESSAGE_MAX_BYTES)
