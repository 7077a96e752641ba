"""Message encoder: from a local message to a body for the overlay, reduced as the rule states.

Sans-I/O. Order of the steps: region and voxels (the message stays of its kind), picture file, encoding, compression.
``proxy.bridge.core.decoder`` and ``proxy.bridge.core.expander`` undo the last three.
"""

from __future__ import annotations

from proxy.bridge.faults import Fault
from proxy.config.rule import Rule
from gdp_extensions.reduction.cloud import CLOUD, CloudReducer
from gdp_extensions.reduction.compression import BodyCompressor
from gdp_extensions.reduction.image import IMAGE, ImageReducer
from gdp_extensions.reduction.picture import HAS_LIBRARY, NO_LIBRARY
from proxy.serial.channel import Channel
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Serializer
from proxy.wire.message import Step, TopicDescription

__all__ = ["MessageEncoder", "compressor_of", "description_of"]


def compressor_of(rule: Rule) -> BodyCompressor | None:
    """Return the compressor of a topic's bodies; None where the rule states none."""
    return None if rule.compress is None else BodyCompressor(rule.compress.level, rule.compress.dictionary or b"")


def description_of(rule: Rule, channels: tuple[Channel, ...]) -> TopicDescription:
    """Return the description of a rule's messages for their readers."""
    dictionary = rule.compress.dictionary if rule.compress is not None else None
    has_images = any(channel.type_name == IMAGE for channel in channels)
    image = rule.image if has_images else None
    return TopicDescription(rule.encoding, channels, rule.compress is not None, dictionary or b"", image)


class MessageEncoder:
    """Encoder of one channel's messages.

    Attributes:
        obstacle: why messages are not reduced as the rule states; None where they are.
    """

    __slots__ = ("_cloud", "_compressor", "_image", "obstacle", "serializer")

    def __init__(self, channel: Channel, rule: Rule, compressor: BodyCompressor | None) -> None:
        self.serializer = Serializer(channel, rule.encoding)
        self._compressor = compressor
        self._image: ImageReducer | None = None
        self._cloud: CloudReducer | None = None
        self.obstacle: tuple[Fault, str] | None = None
        try:
            self._build(channel, rule)
        except DefinitionError as error:
            self.obstacle = Fault.UNKNOWN_TYPE, str(error)

    def encode(self, raw: bytes, quality: int) -> tuple[bytes, Step]:
        """Return the body of a message, and what was done to it.

        Args:
            raw: the message as ROS wrote it.
            quality: of JPEG, 1 to 100.
        """
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
        region = None if rule.region is None else rule.region.bounds
        picture = rule.image
        if picture is not None and not HAS_LIBRARY:
            self.obstacle, picture = (Fault.NO_LIBRARY, NO_LIBRARY), None
        if channel.type_name == IMAGE and (picture is not None or region is not None):
            self._image = ImageReducer(channel, picture, region)
        elif channel.type_name == CLOUD and (rule.voxel_m is not None or region is not None):
            self._cloud = CloudReducer(channel, rule.voxel_m, region)
