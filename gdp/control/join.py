"""A request of one switch to the next towards a publisher: let this tree grow (or shrink) here.

Place: pure. A recorded join or leave moves nothing: each names the present sessions of both ends and counts up within
them. So a sender that has restarted is heard at once, whatever its clock says.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.control.hello import ECHO_BYTES, NONCE_BYTES
from gdp.control.query import TRANSIT_MAX
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.limits import FRAME_MAX_BYTES, LEASE_MAX_S
from gdp.names import ZERO, Name

__all__ = ["Join"]


@dataclass(frozen=True, slots=True)
class Join:
    """One tree: a topic from one publisher.

    Args:
        switch: where the publisher is attached.
        domain: of that switch.
        allowed: domains that both ends let the traffic pass.
        mtu: smallest on the way down from here, in bytes after the Ethernet header.
        lease_s: how long the branch stands unless renewed; 0 takes it down (LEAVE).
        evidence: the signed claim of a reader further down; whoever passes a join on checks it.
        session: echo of the receiver's port (``echo_of``), so that no other member can hand the join on to it.
        sequence: rises with every join and leave of the sender within its session.
        version: sequence number of ``proof``; the newest decides.
        backup_for: the switch below that has the tree another way, and wants copies only while that way is broken;
            ``ZERO`` in an ordinary join. Source: the secondary join of RFC 7431.
        sender_session: nonce of the sender's port.
        proof: the signed claim of the publisher, which says that it is at ``switch``; empty in a leave.
    """

    topic: Name
    publisher: Name
    switch: Name
    domain: Name
    allowed: frozenset[Name]
    mtu: int
    lease_s: float
    evidence: bytes
    session: bytes
    sequence: int
    version: int = 0
    backup_for: Name = ZERO
    sender_session: bytes = bytes(NONCE_BYTES)
    proof: bytes = b""

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "n": self.topic,
            "p": self.publisher,
            "w": self.switch,
            "d": self.domain,
            "x": sorted(self.allowed)[:TRANSIT_MAX],
            "m": self.mtu,
            "l": float(self.lease_s),
            "e": self.evidence,
            "i": self.session,
            "s": self.sequence,
            "v": self.version,
            "b": self.backup_for,
            "o": self.sender_session,
            "c": self.proof,
        }
        return sign(StatementType.JOIN, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Join:
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        return cls(
            fields.name("n"),
            fields.name("p"),
            fields.name("w"),
            fields.name("d"),
            frozenset(fields.names("x", TRANSIT_MAX)),
            fields.uint("m", FRAME_MAX_BYTES),
            fields.number("l", 0, LEASE_MAX_S),
            fields.bytes_("e"),
            fields.bytes_("i", ECHO_BYTES),
            fields.uint("s"),
            fields.uint("v"),
            fields.optional_name("b"),
            fields.bytes_("o", NONCE_BYTES),
            fields.bytes_("c"),
        )
