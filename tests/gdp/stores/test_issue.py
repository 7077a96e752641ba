"""Domains, nodes, owners and delegations on disk, as made by the command and the simulation."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from gdp.crypto.certificates import Role
from gdp.crypto.x509_profile import to_pem
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.issue import (
    admit,
    admit_node,
    delegate,
    delegate_route,
    install_delegation,
    install_membership,
    make_domain,
    make_node,
    make_node_keys,
    make_owner,
)
from gdp.stores.keyring import (
    load_card,
    load_delegation,
    load_delegations,
    load_domain,
    load_identity,
    load_node_keys,
    load_owner,
    load_public_key,
    load_root,
    save_delegation,
)
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.verifier import AdvertisementVerifier

NOW = 1_800_000_000.0
CAMERA = Metadata({"kind": "topic", "name": "/camera/image"})
PRIVATE = {"root.key", "owner.key", "master.key", "node.key", "kem.key", "issued.jsonl", "audit.jsonl"}


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Domain ``school`` with a proxy ``robot``, and an owner ``lab``."""
    make_domain(tmp_path / "school", "school", unix_s=NOW)
    make_node(tmp_path / "robot", Role.PROXY, "robot", tmp_path / "school", more={"site": "roof"}, unix_s=NOW)
    make_owner(tmp_path / "lab")
    return tmp_path


def test_everything_comes_back_from_its_directory(keys: Path) -> None:
    assert load_domain(keys / "school").root == load_root(keys / "robot" / "root.crt")
    assert load_owner(keys / "lab").key.public == load_public_key(keys / "lab" / "owner.pub")
    identity = load_identity(keys / "robot", NOW)
    assert (identity.role, identity.label, identity.root) == (Role.PROXY, "robot", load_root(keys / "school/root.crt"))
    assert load_card(keys / "robot" / "node.card").name == identity.name


def test_private_files_are_private_and_the_others_are_not(keys: Path) -> None:
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in keys.rglob("*") if path.is_file()}
    assert {name for name, mode in modes.items() if mode == 0o600} == PRIVATE


def test_a_second_call_replaces_nothing(keys: Path) -> None:
    before = {path: path.read_bytes() for path in keys.rglob("*") if path.is_file()}
    with pytest.raises(LocalError):
        make_domain(keys / "school", "school")
    with pytest.raises(LocalError):
        make_owner(keys / "lab")
    with pytest.raises(LocalError):
        make_node(keys / "robot", Role.PROXY, "robot", keys / "school")
    with pytest.raises(LocalError):
        admit_node(keys / "school", keys / "robot", unix_s=NOW)
    assert {path: path.read_bytes() for path in keys.rglob("*") if path.is_file()} == before


def test_a_delegation_leads_to_an_advertisement_that_is_accepted(keys: Path) -> None:
    given = delegate(keys / "lab", keys / "robot/node.card", CAMERA, [Right.PUBLISH], [0, 1], unix_s=NOW)
    install_delegation(keys / "robot", given, unix_s=NOW)
    (found,) = load_delegations(keys / "robot" / "delegations")
    identity = load_identity(keys / "robot", NOW)
    advertisement = UnverifiedAdvertisement(
        subject=found.subject,
        right=Right.PUBLISH,
        rtcert=delegate_route(keys / "robot", Name(b"s" * 32), days=1, unix_s=NOW),
        sequence=1,
        incarnation=1,
        lease_ms=60_000,
        is_global=False,
        chain=found.chain,
    ).signed(identity)
    policy = Policy(load_root(keys / "school" / "root.crt"))
    assert AdvertisementVerifier(policy).verify(advertisement, NOW).name == CAMERA.name(
        load_owner(keys / "lab").key.public.compressed
    )
    assert set(found.open(identity)) == {0, 1}


def test_a_delegation_file_is_private_and_does_not_tell_the_topic_by_its_name(keys: Path) -> None:
    given = delegate(keys / "lab", keys / "robot/node.card", CAMERA, [Right.READ], unix_s=NOW)
    path = save_delegation(keys / "out", given)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.name == f"{given.name.to_text()}.delegation"
    with pytest.raises(LocalError):
        save_delegation(keys / "out", given)
    assert save_delegation(keys / "out", given, force=True) == path


def test_a_delegation_to_another_node_is_not_installed(keys: Path) -> None:
    make_node(keys / "other", Role.PROXY, "other", keys / "school", unix_s=NOW)
    given = delegate(keys / "lab", keys / "robot/node.card", CAMERA, [Right.READ], unix_s=NOW)
    with pytest.raises(StatementError) as caught:
        install_delegation(keys / "other", given, unix_s=NOW)
    assert caught.value.reason is DropReason.NOT_FOR_US
    assert load_delegations(keys / "other" / "delegations") == []


def test_a_node_elsewhere_is_admitted_by_its_request(keys: Path) -> None:
    made = make_node_keys(keys / "far", Role.RIB, "far")
    member = admit(keys / "school", (keys / "far" / "node.csr").read_bytes(), unix_s=NOW)
    root = load_root(keys / "school" / "root.crt")
    install_membership(keys / "far", to_pem(member.wire), root, unix_s=NOW)
    assert load_identity(keys / "far", NOW).name == made.subject.name


def test_the_membership_of_another_node_is_not_installed(keys: Path) -> None:
    make_node_keys(keys / "far", Role.RIB, "far")
    root = load_root(keys / "school" / "root.crt")
    with pytest.raises(LocalError, match="another key"):
        install_membership(keys / "far", (keys / "robot" / "node.crt").read_bytes(), root, unix_s=NOW)


def test_a_membership_ends_with_the_root_at_the_latest(keys: Path) -> None:
    make_domain(keys / "short", "short", days=1, unix_s=NOW)
    identity = make_node(keys / "node", Role.SWITCH, "node", keys / "short", days=365, unix_s=NOW)
    assert identity.member.not_after_unix_s == identity.root.validity.not_after_unix_s


def test_an_expired_root_admits_no_node(keys: Path) -> None:
    make_domain(keys / "short", "short", days=1, unix_s=NOW)
    with pytest.raises(LocalError, match="run out"):
        make_node(keys / "node", Role.SWITCH, "node", keys / "short", unix_s=NOW + 100_000)


def test_an_identity_that_has_run_out_is_not_loaded(keys: Path) -> None:
    with pytest.raises(LocalError, match="expired"):
        load_identity(keys / "robot", NOW + 400 * 86_400)


@pytest.mark.parametrize("name", ["node.key", "kem.key", "node.crt", "root.crt", "node.json"])
def test_a_broken_file_is_named(keys: Path, name: str) -> None:
    path = keys / "robot" / name
    path.write_bytes(b"nonsense")
    with pytest.raises(LocalError, match=name):
        load_identity(keys / "robot", NOW)


@pytest.mark.parametrize(
    "text", ["[]", "{}", '{"kind": "king", "name": "x"}', '{"kind": ["proxy"], "name": "x"}', "[" * 100_000]
)
def test_a_description_of_no_node_is_named(keys: Path, text: str) -> None:
    (keys / "robot" / "node.json").write_text(text)
    with pytest.raises(LocalError, match=r"node\.json"):
        load_node_keys(keys / "robot")


def test_metadata_changed_by_hand_no_longer_fit_the_membership(keys: Path) -> None:
    path = keys / "robot" / "node.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "site": "cellar"}))
    with pytest.raises(LocalError, match="otherwise"):
        load_identity(keys / "robot", NOW)


def test_a_broken_delegation_is_named(keys: Path) -> None:
    given = delegate(keys / "lab", keys / "robot/node.card", CAMERA, [Right.READ], unix_s=NOW)
    path = save_delegation(keys / "out", given)
    path.write_bytes(b"nonsense")
    with pytest.raises(LocalError, match=path.name):
        load_delegation(path)
    with pytest.raises(LocalError, match=path.name):
        load_delegations(keys / "out")
