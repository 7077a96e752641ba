"""Rules of ``proxy.yaml`` as they apply to a recording.

Sans-I/O. A recording has topics only, and it is exact: ``max_hz`` omits none of its messages, and each message that
arrives is recorded, whatever its size. Keys that change messages (``image: jpeg``, ``voxel_m``, ``region``, ``adapt``)
do not apply; ``compress`` and ``image: png`` do. A replayed topic has the name that all machines use: ``remap`` does
not apply. QoS does not decide what is reliable or latched. Unless the rule states otherwise, a recording's topics are
reliable, and a recorded latched topic stays latched.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from gdp.limits import MESSAGE_MAX_BYTES
from proxy.config.rule import Rule

_UNLIMITED: Final[dict[str, object]] = {"max_hz": None, "max_bytes": MESSAGE_MAX_BYTES}
_EXACT: Final[dict[str, object]] = {"remap": None, "max_hz": None, **dict.fromkeys(("voxel_m", "region", "adapt"))}


@dataclass(frozen=True, slots=True)
class RecordedRules:
    """Rules about the topics of one recording.

    Args:
        expose: topics of a replayed recording that leave this machine.
        imports: topics that are recorded.
    """

    expose: tuple[Rule, ...] = ()
    imports: tuple[Rule, ...] = ()

    @classmethod
    def of(cls, *, expose: Iterable[Rule] = (), imports: Iterable[Rule] = ()) -> RecordedRules:
        """Return the rules about topics, without the limits that a recording does not have."""
        return cls(
            tuple(_exact(rule) for rule in expose if rule.kind == "topic"),
            tuple(rule.of_recording(_UNLIMITED) for rule in imports if rule.kind == "topic"),
        )

    def endpoint_of(self, rule: Rule) -> int:
        """Return 0: the recording is the only endpoint."""
        del rule
        return 0


def _exact(rule: Rule) -> Rule:
    """Return the rule without what would change or omit messages."""
    image = None if rule.image == "jpeg" else rule.image
    return rule.of_recording({**_EXACT, "image": image})
