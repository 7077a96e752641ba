"""Rollover of a root by commands: each step may be interrupted, and only a successor is trusted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.stores.issue import make_domain, make_node
from gdp.stores.keyring import load_domain, load_owner, load_root
from gdp.stores.ledger import read_ledger
from gdp.stores.rollover import begin_rollover, finish_rollover, trust_successor


def gdp(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, object]:
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words), "--json"])
    said = capsys.readouterr()
    assert not ended.value.code, said.err
    return dict(json.loads(said.out.splitlines()[-1]))


@pytest.fixture
def domain(tmp_path: Path) -> Path:
    make_domain(tmp_path / "school", "school")
    make_node(tmp_path / "node", Role.PROXY, "robot", tmp_path / "school", days=20)
    return tmp_path / "school"


def test_a_domain_rolls_over_by_commands(domain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = load_root(domain / "root.crt").domain
    gdp(capsys, "cert", "rollover", "begin", "--domain", domain, "--overlap-days", "10")
    gdp(capsys, "cert", "trust", domain / "next/root.crt", "--root", tmp_path / "node/root.crt")
    gdp(capsys, "cert", "rollover", "finish", "--domain", domain)
    said = gdp(capsys, "cert", "renew", "--domain", domain, "--node", tmp_path / "node", "--before-days", "30")
    assert said["renewed"] is True
    assert gdp(capsys, "domain", "show", domain / "root.crt")["domain"] == name.to_text()
    assert load_domain(domain).root.domain == name
    assert (domain / "retired/root-1.key").stat().st_mode & 0o777 == 0o600
    assert not (domain / "next").exists()
    assert len(read_ledger(domain)) == 2


def test_a_membership_elsewhere_is_renewed_by_its_certificate(
    domain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "renewed.crt"
    gdp(capsys, "cert", "renew", "--domain", domain, "--cert", tmp_path / "node/node.crt", "--out", out)
    gdp(capsys, "cert", "install", tmp_path / "node", "--cert", out, "--root", domain / "root.crt", "--force")


def test_two_rollovers_do_not_begin_at_once(domain: Path) -> None:
    begin_rollover(domain, days=100, overlap_days=1)
    with pytest.raises(LocalError, match="already"):
        begin_rollover(domain, days=100, overlap_days=1)


def test_a_rollover_that_was_cut_off_is_finished_later(domain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heir = begin_rollover(domain, days=100, overlap_days=1)
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        finish_rollover(domain)
    monkeypatch.undo()
    finish_rollover(domain)
    assert load_domain(domain).key.public == heir.key.public
    assert [each.name for each in (domain / "retired").iterdir()] == ["root-1.key"]


def test_a_successor_of_a_successor_is_trusted_by_who_has_the_first(domain: Path, tmp_path: Path) -> None:
    for _ in range(2):
        begin_rollover(domain, days=100, overlap_days=1)
        finish_rollover(domain)
    assert len(trust_successor(domain / "root.crt", tmp_path / "node/root.crt").predecessors) == 2


def test_only_a_successor_is_trusted(domain: Path, tmp_path: Path) -> None:
    make_domain(tmp_path / "twin", "school")
    with pytest.raises(LocalError, match="not vouched for"):
        trust_successor(tmp_path / "twin/root.crt", tmp_path / "node/root.crt")
    with pytest.raises(LocalError, match="no rollover has begun"):
        finish_rollover(domain)


def test_an_owner_is_succeeded_by_commands(domain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    owner, heir, given = tmp_path / "owner", tmp_path / "heir", tmp_path / "a.delegation"
    topic = ["--kind", "topic", "--name", "/a", "--type", "std_msgs/msg/Empty", "--card", tmp_path / "node/node.card"]
    gdp(capsys, "keygen", "owner", owner)
    gdp(capsys, "delegate", "name", "--owner", owner, *topic, "--right", "read", "--out", given)
    said = gdp(capsys, "cert", "succeed", "--owner", owner, "--to", heir, "--delegation", given)
    assert (heir / "owner.pub").read_bytes() == (owner / "owner.pub").read_bytes()
    assert len(load_owner(heir).successions) == 1 == len(said["names"])  # type: ignore[arg-type]
    gdp(capsys, "delegate", "name", "--owner", heir, *topic, "--right", "read", "--out", given, "--force")
    gdp(capsys, "delegate", "install", given, "--node", tmp_path / "node")
    gdp(capsys, "delegate", "revoke", given, "--owner", heir, "--out", tmp_path / "a.revoke")
