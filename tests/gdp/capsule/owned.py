"""A writer to whom an owner delegated a topic, and the descriptor of its capsule."""

from __future__ import annotations

from functools import cache

from gdp.capsule.descriptor import Descriptor
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.metadata import Metadata
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.owner import Owner
from gdp.trust.right import Right

NOW_S = 1_790_000_000
VALIDITY = Validity(NOW_S - 1_000, NOW_S + 1_000_000)


@cache
def writer() -> Identity:
    """Return the node that writes."""
    authority = CertificateAuthority.create("lab", SigningKey.generate(), VALIDITY)
    return NodeKeys.generate(Role.PROXY, "robot").join(authority, VALIDITY)


@cache
def owner(which: int = 0) -> Owner:
    """Return an owner of topics."""
    return Owner(SigningKey.generate(), bytes([which]) * 32)


@cache
def descriptor(topic: str = "/chatter", right: Right = Right.PUBLISH, which: int = 0) -> Descriptor:
    """Return the descriptor of a capsule of a topic, on which the writer has a right."""
    card = NodeDescriptor.from_wire(NodeDescriptor.make(writer()))
    delegation = owner(which).delegate(card, Metadata({"kind": "topic", "name": topic}), [right], [1], VALIDITY)
    return Descriptor(delegation.subject, writer().membership, delegation.chain, NOW_S * 1_000)
