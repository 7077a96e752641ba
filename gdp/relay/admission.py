"""Admission of clients at a border: for whom it relays, and the sentences in which it refuses.

Sans-I/O. Every client has proven the possession of a membership's key before this decision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gdp.crypto.certificates import Membership
from gdp.errors import DropReason, GdpError, StatementError
from gdp.names import Name

Verify = Callable[[bytes, float], Membership]  # certificate, DER, and unix second; raises StatementError

_SENTENCES = {
    DropReason.EXPIRED: "the certificate of {whom} is not valid now: has it expired, or is a clock wrong? ({detail})",
    DropReason.REVOKED: "the membership of {whom} was revoked",
    DropReason.WRONG_DOMAIN: "the domain of {whom} is not trusted here (domain.trusts)",
}


class RelayRefusedError(GdpError):
    """The other end of a connection is not accepted; the text is a sentence for people at both ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientAdmission:
    """For whom a border relays.

    Args:
        own_domain: labels in ``allow`` count for this domain alone, because other domains choose their own.
        allow: labels of members of the own domain, and names in hex; None: all switches of trusted domains.
        clients_max: connected clients at most; half of them may be of other domains.
    """

    own_domain: Name
    allow: frozenset[str] | None
    clients_max: int

    def check(self, member: Membership, connected: Mapping[Name, Name]) -> None:
        """Return if this verified switch may connect.

        Args:
            connected: connected client -> its domain; a new connection of one of them replaces the old one.

        Raises:
            RelayRefusedError: the border does not relay for it, or has too many clients.
        """
        if self.allow is not None and not self._is_allowed(member):
            raise RelayRefusedError(f"the border does not relay for {member.label} (relay allow)")
        if member.name in connected:
            return
        if len(connected) >= self.clients_max:
            raise RelayRefusedError(f"the border has its {self.clients_max} clients already (relay clients_max)")
        others = sum(each != self.own_domain for each in connected.values())
        if member.domain != self.own_domain and others >= self._others_max:
            raise RelayRefusedError(
                f"the border has its {self._others_max} clients of other domains already (relay clients_max)"
            )

    @property
    def _others_max(self) -> int:
        """Return how many clients of other domains there may be: they issue as many memberships as they like."""
        return max(self.clients_max // 2, 1)

    def _is_allowed(self, member: Membership) -> bool:
        allow = self.allow or ()
        return member.name.to_text() in allow or (member.domain == self.own_domain and member.label in allow)


def verified_switch(certificate: bytes, verify: Verify, unix_s: float) -> Membership:
    """Return the membership of a switch or leaf.

    Args:
        certificate: that the other end presented in the handshake, DER.

    Raises:
        RelayRefusedError: it is not valid, or of another role.
    """
    try:
        member = verify(certificate, unix_s)
    except StatementError as error:
        sentence = _SENTENCES.get(error.reason, "the certificate of {whom} is not valid: {detail}")
        raise RelayRefusedError(
            sentence.format(whom="the other end", detail=error.detail or error.reason.label)
        ) from error
    if not member.role.is_switch:
        raise RelayRefusedError(f"{member.label} is a {member.role.value}; only a switch or a leaf connects to a relay")
    return member


def verified_border(certificate: bytes, expected: Name, verify: Verify, unix_s: float) -> Membership:
    """Return the membership of the border that a client dialled.

    Raises:
        RelayRefusedError: as ``verified_switch``, or it is another switch.
    """
    member = verified_switch(certificate, verify, unix_s)
    if member.name != expected:
        raise RelayRefusedError(
            f"the endpoint is switch {member.label} ({member.name.short}), not the expected {expected.short}:"
            " correct peer or endpoints"
        )
    return member
