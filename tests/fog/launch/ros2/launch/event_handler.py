"""Base of event handlers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from .core import Event, LaunchContext, LaunchDescriptionEntity

Entities: TypeAlias = "Iterable[LaunchDescriptionEntity] | LaunchDescriptionEntity | None"


class BaseEventHandler:
    def __init__(self, *, matcher: Callable[[Event], bool], handle_once: bool = False) -> None:
        self._matcher = matcher

    def matches(self, event: Event) -> bool:
        return self._matcher(event)

    def handle(self, event: Event, context: LaunchContext) -> Entities:
        context.extend_locals({"event": event})
        return None
