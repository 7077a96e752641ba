"""Descriptor of a capsule: what its name digests, and the proof that its writer may publish its topics.

Sans-I/O. The name is that of the metadata ``{kind: capsule, topic, writer, begun}`` under the key of the topic's owner;
with several topics, ``topics`` is the SHA-256 of their names, and the first one's owner counts. A writer whose disk was
lost, or that keeps another topic in it, begins another capsule, with another name, so its log never forks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.certificates import Unverified
from gdp.crypto.keys import PublicKey
from gdp.crypto.schema import CERTIFICATE, FieldSet, Keyed, inner, many, uint
from gdp.crypto.subject import NAMED_SUBJECT, Subject
from gdp.errors import DropReason, StatementError
from gdp.limits import CHAIN_MAX
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.adcert import CHAIN, AdCertCache, Chain
from gdp.trust.right import Right

TOPICS_MAX: Final = 64
_TIME_MAX_MS: Final = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class TopicRight(FieldSet):
    """A topic, and AdCerts from its owner to the writer."""

    topic: Annotated[Subject, NAMED_SUBJECT]
    chain: Annotated[tuple[bytes, ...], Keyed("chain", CHAIN)]


@dataclass(frozen=True, slots=True)
class Descriptor(FieldSet):
    """What identifies a capsule.

    Attributes:
        topic: whose messages it holds, the first of several.
        certificate: the writer's membership, DER.
        chain: AdCerts from the topic's owner to the writer.
        begun_ms: when the writer began it, Unix milliseconds.
        more: the other topics.
    """

    topic: Annotated[Subject, NAMED_SUBJECT]
    certificate: Annotated[bytes, CERTIFICATE]
    chain: Annotated[tuple[bytes, ...], Keyed("chain", CHAIN)]
    begun_ms: Annotated[int, Keyed("begun", uint(_TIME_MAX_MS))]
    more: Annotated[
        tuple[TopicRight, ...],
        Keyed("more", many(inner(TopicRight), TOPICS_MAX - 1, is_cut=False), absent=(), is_omitted=True),
    ] = ()

    @classmethod
    def of_topics(cls, rights: Sequence[TopicRight], certificate: bytes, begun_ms: int) -> Descriptor:
        """Return that of a capsule of one or more topics."""
        return cls(rights[0].topic, certificate, rights[0].chain, begun_ms, tuple(rights[1:]))

    @property
    def rights(self) -> tuple[TopicRight, ...]:
        """Return the topics with their chains."""
        return (TopicRight(self.topic, self.chain), *self.more)

    @property
    def topics(self) -> tuple[Name, ...]:
        """Return the names of the topics."""
        return tuple(each.topic.name for each in self.rights)

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
        of = {"topic": self.topic.name.to_text()}
        if self.more:
            of = {"topics": hashlib.sha256(b"".join(self.topics)).hexdigest()}
        return Metadata({"kind": "capsule", **of, "writer": self.writer.owner_key.hex(), "begun": self.begun_ms})

    @property
    def name(self) -> Name:
        """Return the capsule's name. Raises ``StatementError``: BAD_CERTIFICATE."""
        return self.metadata.name(self.topic.owner_key)

    def check_right(self, unix_s: float) -> None:
        """Return if the owner of each topic lets the writer publish it now.

        Raises:
            StatementError: NOT_DELEGATED, EXPIRED, BAD_SIGNATURE, BAD_CERTIFICATE, WRONG_NAME or MALFORMED.
        """
        writer = self.writer
        for each in self.rights:
            if not each.chain and each.topic.owner_key != writer.owner_key:
                raise StatementError(DropReason.NOT_DELEGATED, "no delegation from the topic's owner")
            Chain.traverse(each.chain, each.topic, writer, AdCertCache(CHAIN_MAX)).check(Right.PUBLISH, unix_s)
