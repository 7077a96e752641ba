"""Message encoder that reduces as the rule states.

Sans-I/O. Order of the steps: region and voxels (the message stays of its kind), picture file, encoding, compression.
``proxy.bridge.core.decoder`` and ``expander`` undo the last three.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gdp.extras import MissingExtraError
from gdp_extensions.reduction.cloud import CloudReducer
from gdp_extensions.reduction.compression import BodyCompressor
from gdp_extensions.reduction.image import ImageReducer
from gdp_extensions.reduction.picture import check_pictures
from proxy.bridge.core.encoder import MessageEncoder
from proxy.bridge.faults import Fault
from proxy.config.reduction import CLOUD, IMAGE
from proxy.config.rule import Rule
from proxy.serial.channel import Channel
from proxy.serial.schema import DefinitionError
from proxy.wire.message import Step


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
