"""Seam of reductions: the extension makes messages smaller, and rates and quality follow the path.

Sans-I/O. What is not reduced needs no extension.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, Protocol, TypeAlias

from gdp.errors import DropReason, RemoteError
from gdp.extras import Seam
from gdp.message.loss import Losses
from proxy.bridge.core.encoder import MessageEncoder
from proxy.config.rule import Rule
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage, TopicDescription

Restore: TypeAlias = "Callable[[bytes], bytes]"


class Adaptation:
    """Adaptation of one topic to its path, which sends every message in the quality of its rule."""

    __slots__ = ("_quality",)

    def __init__(self, quality: int) -> None:
        self._quality = quality

    @property
    def quality(self) -> int:
        """Return the JPEG quality of the next message, 1 to 100."""
        return self._quality

    def may_send(self, losses: Losses, acknowledged: int, path_bytes_s: float | None, now_s: float) -> bool:
        """Return whether a message that comes now may leave.

        Args:
            losses: messages that were given up, and why.
            acknowledged: messages that have left for good: confirmed, or of a best-effort topic sent.
            path_bytes_s: bytes a second that the path gives the topic; None: not measured.
        """
        del losses, acknowledged, path_bytes_s, now_s
        return True

    def handle_sent(self, count: int, size_bytes: int, now_s: float) -> None:
        """Count a message that was published; ``count``: as ``Publisher.publish`` returns it."""

    def handle_refused(self, now_s: float) -> None:
        """Count a message that the path had no space for."""


class MessageExpander:
    """Expander of one channel's bodies, which undoes no step."""

    __slots__ = ("_steps",)

    def __init__(self, description: TopicDescription) -> None:
        self._steps = description.steps

    def expand(self, message: RosMessage) -> tuple[bytes, Restore | None]:
        """Return the body as the encoding has it, and what restores the decoded message; None: nothing has to.

        Raises:
            RemoteError: a step that the description does not state, or a body that is no frame or too long.
        """
        if message.steps & ~self._steps:
            raise RemoteError(DropReason.MALFORMED, "a step that the description does not state")
        return message.body, None


class _Reduction(Protocol):
    RestoringExpander: Callable[[TopicDescription, Channel, int], MessageExpander]

    def encoders_of(self, rule: Rule) -> Callable[[Channel], MessageEncoder]: ...

    def adaptation_of(self, rule: Rule) -> Adaptation: ...


_REDUCTIONS: Final[Seam[_Reduction]] = Seam("gdp.reduction", {"reduction": "images"})


def _reduction() -> _Reduction:
    return _REDUCTIONS.get("reduction", "a reduced topic")


def encoders_of(rule: Rule) -> Callable[[Channel], MessageEncoder]:
    """Return what makes the encoder of each channel of a topic."""
    is_whole = rule.compress is None and rule.region is None and rule.image is None and rule.voxel_m is None
    return partial(MessageEncoder, rule=rule) if is_whole else _reduction().encoders_of(rule)


def adaptation_of(rule: Rule) -> Adaptation:
    """Return the adaptation that a rule states."""
    return Adaptation(rule.quality) if rule.adapt is None else _reduction().adaptation_of(rule)


def expander_of(description: TopicDescription, source: Channel, max_bytes: int) -> MessageExpander:
    """Return the expander of a channel.

    Args:
        source: the channel, as its publisher describes it.
        max_bytes: of a message as ROS wrote it.

    Raises:
        RemoteError: the description contains a dictionary that is none.
        DefinitionError: images are reduced, and the channel has no usable definition.
    """
    if not description.steps:
        return MessageExpander(description)
    return _reduction().RestoringExpander(description, source, max_bytes)
