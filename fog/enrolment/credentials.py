"""What of a machine's keys is remembered: whose they are, until when, and how to take them back.

Place: pure.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["IssuedCredentials"]


@dataclass(frozen=True, slots=True)
class IssuedCredentials:
    """What a machine was enrolled with; until it is, only when all of it will run out.

    Args:
        proxy: the name of its proxy in the overlay, 64 hex digits: who serves, if it does; empty: not enrolled yet.
        until_unix_s: when its certificates and delegations run out.
        fingerprints: of its memberships, in hex, to take them back by.
    """

    proxy: str
    until_unix_s: float
    fingerprints: tuple[str, ...] = ()
