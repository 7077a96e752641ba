"""Values that are known when a description is launched."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .core import LaunchContext


class LaunchConfiguration:
    def __init__(self, variable_name: str, *, default: str | None = None) -> None:
        self.variable_name = variable_name
        self.default = default

    def perform(self, context: LaunchContext) -> str:
        if (value := context.launch_configurations.get(self.variable_name, self.default)) is None:
            raise RuntimeError(f"launch configuration '{self.variable_name}' does not exist")
        return value


class LocalSubstitution:
    def __init__(self, expression: str) -> None:
        self.expression = expression

    def perform(self, context: LaunchContext) -> str:
        name, _, key = self.expression.partition("['")
        return str(getattr(context.locals, name)[key.rstrip("']")])
