"""Identity of a node: its keys, its membership, its domain's root.

Sans-I/O; ``gdp/stores/files`` reads and writes its directory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gdp.crypto.ca import CertificateAuthority, request_membership
from gdp.crypto.certificates import Membership, Role, Root
from gdp.crypto.kem import KemPrivateKey
from gdp.crypto.keys import SigningKey
from gdp.crypto.schema import Body
from gdp.crypto.statements import StatementType, sign
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.names import Name


@dataclass(frozen=True, slots=True)
class NodeKeys:
    """A node that belongs to no domain yet.

    Args:
        digest: of the metadata of its name.
        kem: opens secrets that are sealed to it.
    """

    role: Role
    label: str
    digest: bytes
    key: SigningKey
    kem: KemPrivateKey

    @classmethod
    def generate(
        cls, role: Role, label: str, more: Mapping[str, str | int] | None = None, key: SigningKey | None = None
    ) -> NodeKeys:
        """Return new keys from the system's randomness; ``more`` is added to the node's metadata.

        Args:
            key: its signing key, if there is one already, as in a token.

        Raises:
            LocalError: metadata of the wrong form, or a library without the KEM.
        """
        digest = node_metadata(role, label, more).digest()
        return cls(role, label, digest, key or SigningKey.generate(), KemPrivateKey.generate())

    @property
    def subject(self) -> Subject:
        """Return the node's name and what proves it."""
        return Subject(self.digest, self.key.public.compressed)

    def request(self) -> bytes:
        """Return the request for a membership: PKCS #10, PEM."""
        return request_membership(self.key, self.role, self.label, self.digest)

    def join(self, authority: CertificateAuthority, validity: Validity) -> Identity:
        """Return the node as a member of the authority's domain."""
        return self.admitted(authority.issue(self.request(), validity), authority.root)

    def admitted(self, membership: Membership, root: Root) -> Identity:
        """Return the node with a membership that was issued elsewhere.

        Raises:
            LocalError: it is another node's, of another domain, or not as requested.
        """
        identity = Identity(membership, root, self.key, self.kem)
        if (membership.subject, membership.role, membership.label) != (self.subject, self.role, self.label):
            raise LocalError("the membership certificate names role, label or metadata otherwise")
        return identity


@dataclass(slots=True)
class Identity:
    """A node that can prove its identity. Membership and root may be renewed while it runs, keys and name not.

    Raises:
        LocalError: the parts do not belong together.
    """

    member: Membership
    root: Root
    key: SigningKey
    kem: KemPrivateKey

    def __post_init__(self) -> None:
        if self.member.key != self.key.public:
            raise LocalError("the membership certificate is for another key")
        if self.member.domain != self.root.domain:
            raise LocalError("the membership certificate is of another domain")

    def renew(self, member: Membership, root: Root) -> None:
        """Replace the membership by a newer one of the same node, which every statement carries from now on.

        Raises:
            LocalError: it is another node's, of another domain or role; nothing has changed then.
        """
        if (member.subject, member.role, member.domain) != (self.subject, self.role, self.root.domain):
            raise LocalError("the membership certificate is another node's, or names another role or domain")
        if root.domain != member.domain:
            raise LocalError("the root is another domain's")
        self.member, self.root = member, root

    @property
    def membership(self) -> bytes:
        """Return the membership certificate, DER, as statements carry it."""
        return self.member.wire

    @property
    def name(self) -> Name:
        """Return the node's name."""
        return self.member.name

    @property
    def subject(self) -> Subject:
        """Return the node's name and what proves it."""
        return self.member.subject

    @property
    def role(self) -> Role:
        """Return the node's role in its domain."""
        return self.member.role

    @property
    def label(self) -> str:
        """Return the node's name for people."""
        return self.member.label

    def signed(self, body: Body) -> bytes:
        """Return a statement of this node that carries its membership, so that who does not know it can verify it."""
        return body.to_wire(self.name, self.key, self.membership)

    def sign(self, type_: StatementType, body: Mapping[str, object]) -> bytes:
        """Return a statement of this node. Raises ``LocalError``: the body cannot be written, or is too long."""
        return sign(type_, body, self.name, self.key)


def node_metadata(role: Role, label: str, more: Mapping[str, str | int] | None = None) -> Metadata:
    """Return the metadata of a node's name.

    Raises:
        LocalError: ``more`` is of the wrong form, or contains kind or name.
    """
    extra = dict(more or {})
    if extra.keys() & {"kind", "name"}:
        raise LocalError("a node's kind and name are its role and label")
    return Metadata({"kind": role.value, "name": label, **extra})
