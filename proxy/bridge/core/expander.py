"""Message expander: undoes the steps by which a remote proxy made a body smaller.

Sans-I/O. Memory is bounded by the local rule: a body is decompressed to no more than its messages may have.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from gdp.errors import DropReason, RemoteError
from gdp_extensions.reduction.compression import BodyDecompressor, body_max_bytes
from gdp_extensions.reduction.image import ImageRestorer
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage, Step, TopicDescription

__all__ = ["MessageExpander", "Restore"]

Restore: TypeAlias = "Callable[[bytes], bytes]"


class MessageExpander:
    """Expander of one channel's bodies.

    Args:
        source: the channel, as its publisher describes it.
        max_bytes: of a message as ROS wrote it.

    Raises:
        RemoteError: the description contains a dictionary that is none.
        DefinitionError: images are reduced, and the channel has no usable definition.
    """

    __slots__ = ("_decompressor", "_restorer", "_steps")

    def __init__(self, description: TopicDescription, source: Channel, max_bytes: int) -> None:
        self._steps = description.steps
        limit = body_max_bytes(description.encoding, max_bytes)
        self._decompressor = BodyDecompressor(limit, description.dictionary) if description.is_compressed else None
        self._restorer: ImageRestorer | None = None
        if description.image is not None and source.definition_format:
            self._restorer = ImageRestorer(source, description.image, max_bytes)

    def expand(self, message: RosMessage) -> tuple[bytes, Restore | None]:
        """Return the body as the encoding has it, and what restores the decoded message; None: nothing has to.

        Raises:
            RemoteError: a step that the description does not state, or a body that is no frame or too long.
        """
        if message.steps & ~self._steps:
            raise RemoteError(DropReason.MALFORMED, "a step that the description does not state")
        body = message.body
        if message.steps & Step.ZSTD and self._decompressor is not None:
            body = self._decompressor.decompress(body)
        if not message.steps & Step.IMAGE:
            return body, None
        if self._restorer is None:
            raise RemoteError(DropReason.MALFORMED, "a picture file in a channel without a definition")
        return body, self._restorer.restore
