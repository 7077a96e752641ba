"""Rights of a door in tests."""

from __future__ import annotations

from tests.proxy.bridge import known

__all__ = ["Everything"]


class Everything:
    """Rights to all names."""

    def may_read(self, topic: str, type_name: str) -> str:
        return ""

    def may_publish(self, topic: str, type_name: str) -> str:
        return ""

    def may_call(self, service: str) -> str:
        return ""

    def type_of(self, topic: str) -> str:
        return known.STRING
