"""Rights of a door in tests."""

from __future__ import annotations

from proxy.bridge.core.delegated_rules import DelegatedRules
from tests.proxy.bridge import known

__all__ = ["Everything", "goal_id"]


class Everything(DelegatedRules):
    """Rights to all names."""

    def __init__(self) -> None:
        super().__init__((), ())

    def may_read(self, topic: str, type_name: str) -> str:
        return ""

    def may_publish(self, topic: str, type_name: str) -> str:
        return ""

    def may_call(self, name: str, kind: str = "service") -> str:
        return ""

    def type_of(self, topic: str) -> str:
        return known.STRING


def goal_id() -> bytes:
    """Return the id of every goal."""
    return bytes(range(16))
