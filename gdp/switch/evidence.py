"""Verification of locations: from a signed statement to the location of a node.

Sans-I/O. A RIB's response and a switch's relay both carry the node's own advertisement. It names the switch by an
RtCert and is verified here as everywhere. Only the domain and its transit rest on the signer alone.
"""

from __future__ import annotations

from gdp.control.join import Join
from gdp.control.query import Response
from gdp.control.relayed_statement import RelayedStatement
from gdp.crypto.certificates import Role
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.errors import DropReason, StatementError
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.switch.name_cache import Location
from gdp.trust.advertisement import Advertisement
from gdp.trust.domain import Policy
from gdp.trust.right import HEARS
from gdp.trust.verifier import AdvertisementVerifier

__all__ = ["Evidence"]


class Evidence:
    """Verifies where nodes are; what is not valid, or is about something else, raises ``StatementError``.

    Args:
        verifier: shared with the other parts of the switch, so that a known advertisement is cheap.
    """

    def __init__(self, policy: Policy, verifier: AdvertisementVerifier) -> None:
        self._policy = policy
        self._verifier = verifier

    def from_answer(self, response: Response, now: Timestamps) -> Location:
        """Return the location in a response whose signature was verified."""
        advertisement = self._verifier.verify(response.advertisement, now.unix_s)
        if advertisement.name != response.name or advertisement.node != response.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "an answer about something else than its advertisement")
        return _place(advertisement, response.domain, frozenset(response.transit), response.lease_s, now)

    def from_forwarded_answer(self, statement: Statement, now: Timestamps) -> Location:
        """Return the location in a response that was forwarded; any RIB of a trusted domain may have issued it.

        Raises:
            StatementError: it is not valid, or contains no location.
        """
        fields = statement.expect(StatementType.ANSWER)
        member = self._policy.verify_sender(statement, now.unix_s)
        if not (member.role.is_switch or member.role is Role.RIB):
            raise StatementError(DropReason.BAD_CERTIFICATE, "an answer from a node without the right to give it")
        statement.verify(member.key)
        response = Response.from_fields(fields)
        if not response.advertisement:
            raise StatementError(DropReason.MALFORMED, "a redirect to nowhere")
        return self.from_answer(response, now)

    def from_relay(self, statement: Statement, now: Timestamps) -> Location:
        """Return the location that a switch reports of a node that is attached to it."""
        relayed = RelayedStatement.from_fields(statement.expect(StatementType.RELAY))
        member = self._policy.verify_sender(statement, now.unix_s)
        if not member.role.is_switch:
            raise StatementError(DropReason.BAD_CERTIFICATE, "a relay that is not from a switch")
        statement.verify(member.key)
        advertisement = self._verifier.verify_statement(parse(relayed.statement), now.unix_s)
        if advertisement.switch != member.name:
            raise StatementError(DropReason.NOT_DELEGATED, "the RtCert names another switch")
        return _place(advertisement, member.domain, frozenset(relayed.transit), advertisement.lease_s, now)

    def of_join(self, join: Join, now: Timestamps) -> Advertisement:
        """Return the reader's advertisement of a join with a lease; the publisher's proves where the join leads."""
        reader = self._verifier.verify(join.evidence, now.unix_s)
        if reader.right not in HEARS or reader.name != join.topic:
            raise StatementError(DropReason.NOT_DELEGATED, "a join without a reader's advertisement")
        publisher = self._verifier.verify(join.proof, now.unix_s)
        proven = publisher.name, publisher.node, publisher.right, publisher.switch, publisher.sequence
        if proven != (join.topic, join.publisher, HEARS[reader.right], join.switch, join.version):
            raise StatementError(DropReason.NOT_DELEGATED, "a join to where the publisher's advertisement is not")
        if (join.path == 2 or join.route) and min(reader.paths, publisher.paths) < 2:
            raise StatementError(DropReason.NOT_DELEGATED, "two paths that reader and publisher do not both ask for")
        return reader

    def still_holds(self, advertisement: Advertisement, now: Timestamps) -> bool:
        """Return whether the certificates of a verified advertisement are still valid."""
        try:
            self._verifier.recheck(advertisement, now.unix_s)
        except StatementError:
            return False
        return True


def _place(
    advertisement: Advertisement, domain: Name, transit: frozenset[Name], lease_s: float, now: Timestamps
) -> Location:
    return Location(
        name=advertisement.name,
        advertiser=advertisement.node,
        right=advertisement.right,
        switch=advertisement.switch,
        domain=domain,
        transit=transit,
        advertisement=advertisement.wire,
        expires_s=now.mono_s + lease_s,
        proof=advertisement,
        stale_until_s=now.mono_s + advertisement.valid_until_unix_s - now.unix_s,
    )
