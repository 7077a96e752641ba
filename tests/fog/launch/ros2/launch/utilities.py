"""Texts and substitutions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    from .core import LaunchContext


class Substitution(Protocol):
    def perform(self, context: LaunchContext) -> str: ...


Part: TypeAlias = "str | Substitution"


def normalize_to_list_of_substitutions(said: Part | Iterable[Part]) -> list[Part]:
    if isinstance(said, str):
        return [said]
    return list(said) if isinstance(said, Iterable) else [said]


def perform_substitutions(context: LaunchContext, parts: Iterable[Part]) -> str:
    return "".join(part if isinstance(part, str) else part.perform(context) for part in parts)
