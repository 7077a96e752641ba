"""Report of one change or one upkeep of a node's sharing."""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.errors import GdpError
from gdp.sharing.issued import IssuedDelegation
from gdp.sharing.state import Offer

__all__ = ["ShareReport"]


@dataclass(slots=True)
class ShareReport:
    """What was done, and what could not be done.

    Args:
        is_running: whether the proxy runs and has taken the change; None: nothing had to change.
        granted: delegations that were issued.
        received: offers that came.
        problems: texts; what they are about is tried again at the next upkeep.
    """

    is_running: bool | None = None
    granted: list[IssuedDelegation] = field(default_factory=list)
    received: list[Offer] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def add_problem(self, error: GdpError) -> None:
        """Add the text of an error, unless it is there already."""
        if str(error) not in self.problems:
            self.problems.append(str(error))
