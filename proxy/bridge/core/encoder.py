"""Message encoder: from a local message to a body for the overlay.

Sans-I/O. ``proxy.bridge.core.decoder`` undoes it.
"""

from __future__ import annotations

from proxy.bridge.faults import Fault
from proxy.config.reduction import IMAGE
from proxy.config.rule import Rule
from proxy.serial.channel import Channel
from proxy.serial.serializer import Serializer
from proxy.wire.message import Step, TopicDescription


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

    __slots__ = ("obstacle", "serializer")

    def __init__(self, channel: Channel, rule: Rule) -> None:
        self.serializer = Serializer(channel, rule.encoding)
        self.obstacle: tuple[Fault, str] | None = None

    def encode(self, raw: bytes, quality: int) -> tuple[bytes, Step]:
        """Return the body of a message, and what was done to it.

        Args:
            raw: the message as ROS wrote it.
            quality: of JPEG, 1 to 100.
        """
        del quality
        return self.serializer.encode(raw), Step(0)
