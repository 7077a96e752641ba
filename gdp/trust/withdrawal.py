"""Withdrawal: a node's statement that it advertises a name no more.

Sans-I/O. Source: BGP (RFC 4271, section 3.1, withdrawn routes). Its sequence number counts with those of the node's
advertisements, so that a late one ends nothing newer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gdp.crypto.schema import NAME, Body, Keyed, uint
from gdp.crypto.statements import Statement, StatementType, check_sequence
from gdp.limits import WITHDRAWAL_MAX_BYTES
from gdp.names import Name
from gdp.trust.right import RIGHT, Right


@dataclass(frozen=True, slots=True)
class Withdrawal(Body):
    """The name and the right that its signer advertises no more."""

    TYPE = StatementType.WITHDRAW
    MAX_BYTES = WITHDRAWAL_MAX_BYTES
    name: Annotated[Name, Keyed("n", NAME)]
    right: Annotated[Right, Keyed("right", RIGHT)]
    sequence: Annotated[int, Keyed("s", uint())]

    @classmethod
    def received(cls, statement: Statement, unix_s: float) -> Withdrawal:
        """Read a parsed statement; no signature is checked.

        Raises:
            StatementError: MALFORMED, or TOO_BIG to be forwarded.
        """
        withdrawal = cls.from_statement(statement)
        check_sequence(withdrawal.sequence, unix_s)
        return withdrawal
