"""Validity period: the one time check for certificates and delegations.

Sans-I/O. Clocks of honest machines differ. An expired certificate is accepted for ``CLOCK_SKEW_S`` more. A future one
is accepted ``CLOCK_SKEW_S`` before its start. The start keeps no certificate holder out, and a machine whose clock was
set back must not lose the certificates of the last hour.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final

from gdp.crypto.schema import Keyed, Spread, uint
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CLOCK_SKEW_S


@dataclass(frozen=True, slots=True)
class Validity:
    """A period of wall-clock time in whole seconds, both ends included."""

    not_before_unix_s: int
    not_after_unix_s: int

    @classmethod
    def lasting(cls, unix_s: float, duration_s: float) -> Validity:
        """Return the period that begins at ``unix_s``.

        Raises:
            LocalError: it would last less than a second, or begin before 1970.
        """
        if unix_s < 0 or duration_s < 1:
            raise LocalError("a validity begins after 1970 and lasts a second or longer")
        return cls(int(unix_s), int(unix_s + duration_s))

    def check(self, unix_s: float, what: str) -> None:
        """Return if ``unix_s`` lies within the period, with a tolerance for clock differences.

        Raises:
            StatementError: EXPIRED, or not valid yet; ``what`` names it for people.
        """
        if unix_s > self.not_after_unix_s + CLOCK_SKEW_S:
            raise StatementError(DropReason.EXPIRED, what)
        if unix_s < self.not_before_unix_s - CLOCK_SKEW_S:
            raise StatementError(DropReason.EXPIRED, f"{what}: not valid yet")


VALIDITY: Final = Spread((Keyed("from", uint()), Keyed("until", uint())), Validity, astuple)
