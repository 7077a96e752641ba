"""RtCert: a node permits one switch to attract its traffic.

Sans-I/O. Source: FogROS G, section on advertisements; docs/explanation/design.md, section 5.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Annotated

from gdp.crypto.identity import Identity
from gdp.crypto.keys import PublicKey
from gdp.crypto.schema import NAME, Body, Keyed
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.crypto.validity import VALIDITY, Validity
from gdp.errors import DropReason, StatementError
from gdp.names import Name
from gdp.trust.lru import Lru


@dataclass(frozen=True, slots=True)
class RtCert(Body):
    """The right of ``switch`` to attract the traffic of ``node``."""

    TYPE = StatementType.RTCERT
    node: Name
    switch: Annotated[Name, Keyed("switch", NAME)]
    validity: Annotated[Validity, VALIDITY]
    fingerprint: bytes = b""

    @staticmethod
    def make(identity: Identity, switch: Name, validity: Validity) -> bytes:
        """Return the node's signed statement."""
        return RtCert(identity.name, switch, validity).to_wire(identity.name, identity.key)

    @classmethod
    def given_by(cls, statement: Statement) -> dict[str, object]:
        """Return node and fingerprint."""
        return {"node": statement.signer, "fingerprint": statement.fingerprint}


class RtCertCache:
    """Cache of verified RtCerts: one serves all advertisements of a node through a switch."""

    def __init__(self, maximum: int) -> None:
        self._good: Lru[RtCert] = Lru(maximum)

    def verified(self, wire: bytes, node: Name, node_key: PublicKey) -> RtCert:
        """Return the RtCert if ``node``, whose key this is, signed it. Time is not checked.

        Raises:
            StatementError: MALFORMED, NOT_DELEGATED (another node's) or BAD_SIGNATURE.
        """
        entry = hashlib.sha256(node_key.compressed + wire).digest()
        known = self._good.get(entry)
        if known is None:
            statement = parse(wire)
            known = RtCert.from_statement(statement)
            if known.node != node:
                raise StatementError(DropReason.NOT_DELEGATED, "an RtCert of another node")
            statement.verify(node_key)
            self._good.put(entry, known)
        elif known.node != node:
            raise StatementError(DropReason.NOT_DELEGATED, "an RtCert of another node")
        return known
