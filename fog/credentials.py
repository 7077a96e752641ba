"""Record of a machine's credentials: holder, end of validity, and fingerprints for revocation.

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
        fingerprints: of its memberships, in hex, for their revocation.
    """

    proxy: str
    until_unix_s: float
    fingerprints: tuple[str, ...] = ()
