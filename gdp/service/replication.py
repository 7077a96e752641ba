"""Replication modes: how a service's requests are spread over its replicas.

Sans-I/O. Source: FogROS2-FT (all replicas, the first response wins); hedged requests after Dean and Barroso, "The Tail
at Scale", CACM 56(2), 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final


class Mode(Enum):
    """Which replicas get a request at first."""

    ALL = "all"  # every replica, by the tree: one copy on the client's link
    SOME = "some"  # ``copies`` of them, those that responded fastest recently
    HEDGED = "hedged"  # one; a second one after the 95th percentile of recent responses, within the budget
    NEAREST = "nearest"  # one, over the path of the least cost; the next one where it falls silent


@dataclass(frozen=True, slots=True)
class Replication:
    """The replication of a rule.

    Args:
        copies: with ``SOME``: how many replicas get each request.
        budget: with ``HEDGED``: most second copies, as a share of requests.
    """

    mode: Mode = Mode.ALL
    copies: int = 1
    budget: float = 0.02


ALL: Final = Replication()
NEAREST: Final = Replication(Mode.NEAREST)
