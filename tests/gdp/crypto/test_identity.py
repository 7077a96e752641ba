"""Identity of a node, as the node itself holds it."""

from __future__ import annotations

import pytest

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys, node_metadata
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, parse
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.metadata import Metadata

SPAN = Validity(1_000, 2_000)
SCHOOL = CertificateAuthority.create("school", SigningKey.generate(), SPAN)
ROBOT = NodeKeys.generate(Role.PROXY, "robot", {"site": "roof"})
MEMBER = ROBOT.join(SCHOOL, SPAN)


def test_a_node_has_the_name_of_its_metadata_and_key() -> None:
    metadata = Metadata({"kind": "proxy", "name": "robot", "site": "roof"})
    assert MEMBER.name == ROBOT.subject.name == metadata.name(ROBOT.key.public.compressed)


def test_what_a_node_signs_its_membership_verifies() -> None:
    statement = parse(MEMBER.sign(StatementType.HELLO, {"seq": 1}))
    assert statement.signer == MEMBER.name
    statement.verify(MEMBER.member.key)


def test_the_membership_of_another_node_is_refused() -> None:
    other = NodeKeys.generate(Role.PROXY, "robot").join(SCHOOL, SPAN)
    with pytest.raises(LocalError, match="another key"):
        Identity(other.member, SCHOOL.root, ROBOT.key, ROBOT.kem)


def test_the_root_of_another_domain_is_refused() -> None:
    cloud = CertificateAuthority.create("cloud", SigningKey.generate(), SPAN)
    with pytest.raises(LocalError, match="another domain"):
        ROBOT.admitted(MEMBER.member, cloud.root)


def test_a_nodes_metadata_do_not_name_its_kind_twice() -> None:
    with pytest.raises(LocalError):
        node_metadata(Role.RIB, "a", {"kind": "switch"})


def test_a_repr_shows_nothing_private() -> None:
    assert repr(ROBOT.kem.wire) not in repr(MEMBER)
    assert "private" not in repr(MEMBER)
