"""Message encoder that reduces as the rule states, and the expander that decompresses bodies and restores images.

Sans-I/O. Order of the steps: region and voxels (the message stays of its kind), picture file, encoding, compression.
``proxy.bridge.core.decoder`` and the expander undo the last three. Memory is bounded by the local rule: a body is
decompressed to no more than its messages may have.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from gdp.errors import DropReason, RemoteError
from gdp.extras import MissingExtraError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp_extensions.reduction.cloud import CloudReducer
from gdp_extensions.reduction.compression import BodyCompressor, BodyDecompressor
from gdp_extensions.reduction.image import ImageReducer, ImageRestorer
from gdp_extensions.reduction.picture import check_pictures
from proxy.bridge.core.encoder import MessageEncoder
from proxy.bridge.core.reduction import MessageExpander, Restore
from proxy.bridge.faults import Fault
from proxy.config.reduction import CLOUD, IMAGE
from proxy.config.rule import Rule
from proxy.serial.channel import Channel
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding
from proxy.wire.message import RosMessage, Step, TopicDescription

_TEXT_RATIO: Final = 16  # most bytes of JSON or CBOR, with the names of fields, for each byte as ROS wrote it
_TEXT_FREE_BYTES: Final = 64 << 10


def encoders_of(rule: Rule) -> Callable[[Channel], MessageEncoder]:
    """Return what makes the encoder of each channel of a topic; they share a compressor."""
    compress = rule.compress
    compressor = None if compress is None else BodyCompressor(compress.level, compress.dictionary or b"")
    return partial(ReducingEncoder, rule=rule, compressor=compressor)


class ReducingEncoder(MessageEncoder):
    """Encoder of one channel's messages."""

    __slots__ = ("_cloud", "_compressor", "_image")

    def __init__(self, channel: Channel, rule: Rule, compressor: BodyCompressor | None) -> None:
        super().__init__(channel, rule)
        self._compressor = compressor
        self._image: ImageReducer | None = None
        self._cloud: CloudReducer | None = None
        try:
            self._build(channel, rule)
        except DefinitionError as error:
            self.obstacle = Fault.UNKNOWN_TYPE, str(error)

    def encode(self, raw: bytes, quality: int) -> tuple[bytes, Step]:
        """Return the body of a message, and what was done to it."""
        steps = Step(0)
        if self._cloud is not None:
            raw = self._cloud.reduce(raw)
        elif self._image is not None:
            raw, is_file = self._image.reduce(raw, quality)
            steps = Step.IMAGE if is_file else steps
        body = self.serializer.encode(raw)
        if self._compressor is not None and (frame := self._compressor.compress(body)) is not None:
            return frame, steps | Step.ZSTD
        return body, steps

    def _build(self, channel: Channel, rule: Rule) -> None:
        picture = rule.image
        if picture is not None:
            try:
                check_pictures()
            except MissingExtraError as error:
                self.obstacle, picture = (Fault.NO_LIBRARY, str(error)), None
        if channel.type_name == IMAGE and (picture is not None or rule.region is not None):
            self._image = ImageReducer(channel, picture, rule.region)
        elif channel.type_name == CLOUD and (rule.voxel_m is not None or rule.region is not None):
            self._cloud = CloudReducer(channel, rule.voxel_m, rule.region)


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
