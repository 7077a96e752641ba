"""What every node is given at its start: the marks of its new life, randomness, and how it greets.

Place: pure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gdp.limits import DEAD_S, HELLO_S

__all__ = ["NodeSettings"]


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """The start of a switch, a RIB or a member.

    Args:
        incarnation: 64 random bits, new at each start.
        first_sequence: above every sequence number of an earlier life; wall-clock milliseconds do.
        random_bytes: source of nonces.
        hello_s: between two hellos on a port.
        dead_s: a neighbour silent for so long is gone.
    """

    incarnation: int
    first_sequence: int
    random_bytes: Callable[[int], bytes]
    hello_s: float = HELLO_S
    dead_s: float = DEAD_S
