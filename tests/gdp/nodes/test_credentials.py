"""Running node that loads replaced certificates from disk, and rejects invalid ones."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from gdp.config.schema import Domain
from gdp.crypto.certificates import Role
from gdp.nodes.credentials import Credentials, watched_folders
from gdp.nodes.membership import load_policy
from gdp.sansio import Timestamps
from gdp.stores.files import public, write_all
from gdp.stores.issue import make_domain, make_node, renew_node
from gdp.stores.keyring import load_identity, load_root
from gdp.stores.rollover import begin_rollover, finish_rollover, trust_successor

NOW = 1_800_000_000.0
DAY_S = 86_400.0


class Site:
    def __init__(self, home: Path) -> None:
        self.domain, self.node = home / "school", home / "node"
        make_domain(self.domain, "school", unix_s=NOW)
        make_node(self.node, Role.PROXY, "robot", self.domain, days=30, unix_s=NOW)
        self.config = Domain.model_construct(root=self.node / "root.crt", trusts=(), transit=None)
        self.identity = load_identity(self.node, NOW)
        self.policy = load_policy(self.config)
        self.credentials = Credentials(self.node, self.config, self.identity, self.policy)

    def look(self, unix_s: float = NOW) -> None:
        self.credentials.reload_changed(Timestamps(0.0, unix_s))


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_a_renewed_membership_is_taken_up(site: Site) -> None:
    before = site.identity.member
    site.look()
    assert site.identity.member is before
    renewed = renew_node(site.domain, site.node, days=300, unix_s=NOW + DAY_S)
    site.look(NOW + DAY_S)
    assert site.identity.member == renewed != before
    assert site.identity.key.public == before.key


def test_what_lasts_longer_is_not_renewed(site: Site) -> None:
    assert renew_node(site.domain, site.node, before_days=7, unix_s=NOW) is None
    assert renew_node(site.domain, site.node, before_days=7, unix_s=NOW + 24 * DAY_S) is not None


def test_what_has_run_out_is_renewed(site: Site) -> None:
    assert renew_node(site.domain, site.node, unix_s=NOW + 60 * DAY_S) is not None


def test_another_nodes_certificate_is_refused(site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = site.identity.member
    make_node(tmp_path / "other", Role.PROXY, "other", site.domain, unix_s=NOW)
    write_all(site.node, {"node.crt": public((tmp_path / "other/node.crt").read_bytes())}, force=True)
    site.look()
    assert not caplog.records, "it may be half of a change"
    site.look()
    site.look()
    assert [each.levelno for each in caplog.records] == [logging.ERROR], "logged once"
    assert site.identity.member is before


def test_a_root_rolls_over_while_the_node_runs(site: Site) -> None:
    begin_rollover(site.domain, days=3_650, overlap_days=30, unix_s=NOW)
    trust_successor(site.domain / "next/root.crt", site.node / "root.crt")
    site.look()
    assert len(site.policy.roots[site.policy.own].predecessors) == 1
    finish_rollover(site.domain)
    renewed = renew_node(site.domain, site.node, unix_s=NOW)
    site.look()
    assert renewed is not None
    assert site.identity.member.issuer_key == load_root(site.domain / "root.crt").key.compressed
    assert load_identity(site.node, NOW + 40 * DAY_S).member == renewed


def test_an_unvouched_root_is_not_accepted(site: Site, tmp_path: Path) -> None:
    make_domain(tmp_path / "twin", "school", unix_s=NOW)
    before = site.policy.roots
    write_all(site.node, {"root.crt": public((tmp_path / "twin/root.crt").read_bytes())}, force=True)
    site.look()
    site.look()
    assert site.policy.roots is before


def test_a_membership_that_ends_soon_is_reported_once(site: Site, caplog: pytest.LogCaptureFixture) -> None:
    site.look(NOW + 20 * DAY_S)
    assert not caplog.records
    site.look(NOW + 25 * DAY_S)
    site.look(NOW + 26 * DAY_S)
    (record,) = caplog.records
    assert "gdp cert renew" in record.getMessage()


def test_a_node_may_read_again_its_own_folder_and_folders_of_certificates_only(site: Site, tmp_path: Path) -> None:
    write_all(tmp_path / "roots", {"cloud.crt": public(b"")})
    trusts = (tmp_path / "roots/cloud.crt", site.domain / "root.crt")
    config = Domain.model_construct(root=site.node / "root.crt", trusts=trusts, transit=None)
    found = watched_folders(site.node, config)
    assert set(found) == {site.node, tmp_path / "roots", site.domain / "root.crt", site.node / "root.crt"}
