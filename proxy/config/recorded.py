"""Rules of ``proxy.yaml`` as they apply to a recording.

Sans-I/O. A recording has topics only, and its QoS does not decide what is reliable or latched. Unless the rule states
otherwise, its topics are reliable, and a recorded latched topic stays latched.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from proxy.config.rule import Rule

__all__ = ["RecordedRules"]


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
        """Return the rules about topics."""
        return cls(_topics(expose), _topics(imports))

    @property
    def recorded_topics(self) -> tuple[tuple[str, str], ...]:
        """Return local name and type of each topic that is recorded."""
        return tuple((rule.local, rule.type_name) for rule in self.imports)

    def endpoint_of(self, rule: Rule) -> int:
        """Return 0: the recording is the only endpoint."""
        del rule
        return 0


def _topics(rules: Iterable[Rule]) -> tuple[Rule, ...]:
    return tuple(rule for rule in rules if rule.kind == "topic")
