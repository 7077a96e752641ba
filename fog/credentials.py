"""Record of a machine's credentials: holder and end of validity.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["IssuedCredentials"]


@dataclass(frozen=True, slots=True)
class IssuedCredentials:
    """Credentials issued to a machine; before enrolment only the end of their validity is known.

    Args:
        proxy: overlay name of the machine's proxy, 64 hex digits; empty: not enrolled yet.
        until_unix_s: end of validity of its certificates and delegations.
    """

    proxy: str
    until_unix_s: float
