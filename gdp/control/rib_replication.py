"""Entry of a RIB as it is sent to another RIB of the domain, which holds what any of them accepted.

Sans-I/O. Entries prove themselves; ``rib/replication.py`` equalises them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gdp.control.rib_statements import TRANSIT_MAX
from gdp.crypto.schema import CERT, FLAG, NAME, STATEMENT, FieldSet, Keyed, many, number, uint
from gdp.intervals import LEASE_MAX_S
from gdp.names import Name

Key = tuple[Name, Name]  # name, advertiser


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry(FieldSet):
    """An advertisement or a withdrawal as one RIB sends it to another.

    Args:
        statement: signed by its maker.
        membership: of the maker of a withdrawal, whose advertisement need not be known; empty for an advertisement.
        sender: the switch or RIB that relayed it.
        domain: domain of the advertisement's switch.
        via: the domain of ``sender``.
        transit: domains through which that domain lets its traffic pass.
        lease_s: what is left of the lease.
        is_from_upstream: received from the tier above.
        until_unix_s: when a withdrawal may be forgotten, because its advertisement is no longer provable; 0 for an
            advertisement.
    """

    statement: Annotated[bytes, Keyed("q", STATEMENT)]
    membership: Annotated[bytes, Keyed("m", CERT)]
    sender: Annotated[Name, Keyed("w", NAME)]
    domain: Annotated[Name, Keyed("d", NAME)]
    via: Annotated[Name, Keyed("v", NAME)]
    transit: Annotated[tuple[Name, ...], Keyed("x", many(NAME, TRANSIT_MAX))]
    lease_s: Annotated[float, Keyed("l", number(0, LEASE_MAX_S))]
    is_from_upstream: Annotated[bool, Keyed("u", FLAG)]
    until_unix_s: Annotated[int, Keyed("t", uint())] = 0
