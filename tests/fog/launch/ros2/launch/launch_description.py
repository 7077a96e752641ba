"""Description of a launch; visiting it returns its entities."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from .core import LaunchDescriptionEntity

if TYPE_CHECKING:
    from .core import LaunchContext


class LaunchDescription(LaunchDescriptionEntity):
    def __init__(
        self,
        initial_entities: Iterable[LaunchDescriptionEntity] | None = None,
        *,
        deprecated_reason: str | None = None,
    ) -> None:
        self._entities = list(initial_entities or ())

    @property
    def entities(self) -> list[LaunchDescriptionEntity]:
        return self._entities

    def add_action(self, action: LaunchDescriptionEntity) -> None:
        self._entities.append(action)

    def visit(self, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        return self._entities
