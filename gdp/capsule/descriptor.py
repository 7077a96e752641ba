"""Descriptor of a capsule: what its name digests, and the proof that its writer may publish the topic.

Sans-I/O. The name is that of the metadata ``{kind: capsule, topic, writer, begun}`` under the key of the topic's owner.
A writer whose disk was lost begins another capsule, with another name, so its log never forks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.certificates import Unverified
from gdp.crypto.keys import PublicKey
from gdp.crypto.schema import CERTIFICATE, FieldSet, Keyed, uint
from gdp.crypto.subject import NAMED_SUBJECT, Subject
from gdp.errors import DropReason, StatementError
from gdp.limits import CHAIN_MAX
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.adcert import CHAIN, AdCertCache, Chain
from gdp.trust.right import Right

_TIME_MAX_MS: Final = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class Descriptor(FieldSet):
    """What identifies a capsule.

    Attributes:
        topic: whose messages it holds.
        certificate: the writer's membership, DER.
        chain: AdCerts from the topic's owner to the writer.
        begun_ms: when the writer began it, Unix milliseconds.
    """

    topic: Annotated[Subject, NAMED_SUBJECT]
    certificate: Annotated[bytes, CERTIFICATE]
    chain: Annotated[tuple[bytes, ...], Keyed("chain", CHAIN)]
    begun_ms: Annotated[int, Keyed("begun", uint(_TIME_MAX_MS))]

    @property
    def writer(self) -> Subject:
        """Return the writer's name and what proves it. Raises ``StatementError``: BAD_CERTIFICATE."""
        return Unverified.from_wire(self.certificate).subject

    @property
    def key(self) -> PublicKey:
        """Return the writer's key. Raises ``StatementError``: BAD_CERTIFICATE."""
        return Unverified.from_wire(self.certificate).key

    @property
    def metadata(self) -> Metadata:
        """Return the metadata that the name digests. Raises ``StatementError``: BAD_CERTIFICATE."""
        topic, writer = self.topic.name.to_text(), self.writer.owner_key.hex()
        return Metadata({"kind": "capsule", "topic": topic, "writer": writer, "begun": self.begun_ms})

    @property
    def name(self) -> Name:
        """Return the capsule's name. Raises ``StatementError``: BAD_CERTIFICATE."""
        return self.metadata.name(self.topic.owner_key)

    def check_right(self, unix_s: float) -> None:
        """Return if the topic's owner lets the writer publish it now.

        Raises:
            StatementError: NOT_DELEGATED, EXPIRED, BAD_SIGNATURE, BAD_CERTIFICATE, WRONG_NAME or MALFORMED.
        """
        writer = self.writer
        if not self.chain and self.topic.owner_key != writer.owner_key:
            raise StatementError(DropReason.NOT_DELEGATED, "no delegation from the topic's owner")
        Chain.traverse(self.chain, self.topic, writer, AdCertCache(CHAIN_MAX)).check(Right.PUBLISH, unix_s)
