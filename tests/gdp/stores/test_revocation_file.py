"""File of revocations: synced entries come back verified; a broken file, or another user's folder, is no source."""

from __future__ import annotations

import os
import sqlite3
import stat
from pathlib import Path

import pytest

from gdp.crypto.statements import Statement, parse
from gdp.errors import LocalError
from gdp.nodes.revocation_upkeep import RevocationUpkeep
from gdp.sansio import Timestamps
from gdp.stores.revocation_file import RevocationFile
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import OPERATOR, Revocations
from tests.gdp.trust.world import CAMERA, CLOUD, LAB, NOW, SCHOOL

AT = Timestamps(0.0, NOW)
ROOTS = {each.root.key.compressed: each.root.domain for each in (SCHOOL, CLOUD)}


def of_school(number: int, until: int = NOW + 1_000) -> Statement:
    return parse(Revocation.make(SCHOOL.key, SCHOOL.root.subject, number.to_bytes(32, "big"), until))


def of_lab(number: int) -> Statement:
    return parse(LAB.revoke(CAMERA, number.to_bytes(32, "big"), NOW + 1_000))


def begun(folder: Path, revoked: Revocations, at: Timestamps = AT) -> RevocationUpkeep:
    upkeep = RevocationUpkeep(folder, revoked)
    upkeep.restore(at)
    upkeep.start()
    return upkeep


def written(folder: Path, *statements: Statement) -> Revocations:
    revoked = Revocations(ROOTS)
    upkeep = begun(folder, revoked)
    for at, statement in enumerate(statements):
        revoked.receive_revocation(statement, str(at).encode(), AT, lambda _: True)
    upkeep.work(AT)
    upkeep.close()
    return revoked


def read(folder: Path, at: Timestamps = AT, roots: object = ROOTS) -> Revocations:
    revoked = Revocations(roots)  # type: ignore[arg-type]
    upkeep = RevocationUpkeep(folder, revoked)
    upkeep.restore(at)
    upkeep.close()
    return revoked


def test_what_was_kept_comes_back_with_its_origin(tmp_path: Path) -> None:
    before = written(tmp_path, of_school(1), of_lab(2))
    after = read(tmp_path)
    keys = set(before.keys())
    assert set(after.keys()) == keys
    assert {after.kept(key) for key in keys} == {before.kept(key) for key in keys}
    assert {kept.origin for key in keys if (kept := after.kept(key)) is not None} == {OPERATOR, b"1"}


def test_only_this_user_may_read_the_file(tmp_path: Path) -> None:
    written(tmp_path, of_school(1))
    assert stat.S_IMODE((tmp_path / "revocations").stat().st_mode) == 0o600


def test_files_that_sqlite_makes_next_to_it_are_private_and_the_mask_of_the_process_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    masks = list[int]()
    monkeypatch.setattr(os, "umask", masks.append)
    file = RevocationFile(tmp_path)
    database = file._open()
    database.execute("BEGIN IMMEDIATE")
    database.execute("INSERT INTO revocations VALUES (x'00', 0, x'00', 0, x'00')")
    database.commit()
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    database.close()
    assert modes == {"revocations": 0o600, "revocations-wal": 0o600}
    assert masks == []


def test_what_a_killed_node_had_synced_comes_back(tmp_path: Path) -> None:
    revoked = Revocations(ROOTS)
    upkeep = begun(tmp_path, revoked)
    revoked.receive_revocation(of_school(1), b"a", AT, lambda _: True)
    upkeep.work(AT)
    upkeep.close()
    for path in tmp_path.iterdir():  # a copy of the state that a kill would leave behind
        (tmp_path / "left").mkdir(exist_ok=True, mode=0o700)
        (tmp_path / "left" / path.name).write_bytes(path.read_bytes()) if path.is_file() else None
    assert len(read(tmp_path / "left")) == 1


def test_what_has_run_out_is_forgotten_by_the_file_too(tmp_path: Path) -> None:
    written(tmp_path, of_school(1, NOW + 10), of_school(2, NOW + 9_000))
    assert len(read(tmp_path, Timestamps(0.0, NOW + 5_000))) == 1
    with sqlite3.connect(tmp_path / "revocations") as database:
        assert database.execute("SELECT count(*) FROM revocations").fetchone() == (1,)
    database.close()


def test_a_changed_statement_is_refused_and_the_rest_comes_back(tmp_path: Path) -> None:
    written(tmp_path, of_school(1), of_school(2))
    with sqlite3.connect(tmp_path / "revocations") as database:
        key, wire = database.execute("SELECT key, statement FROM revocations").fetchone()
        database.execute("UPDATE revocations SET statement = ? WHERE key = ?", (wire[:-1] + b"x", key))
    database.close()
    assert len(read(tmp_path)) == 1


def test_a_domain_that_is_trusted_no_more_does_not_speak_from_the_file(tmp_path: Path) -> None:
    written(tmp_path, of_school(1), of_lab(2))
    assert len(read(tmp_path, roots={CLOUD.root.key.compressed: CLOUD.root.domain})) == 1


def test_a_file_that_is_no_database_is_put_aside(tmp_path: Path) -> None:
    (tmp_path / "revocations").write_bytes(b"no database" * 1_000)
    assert len(read(tmp_path)) == 0
    assert (tmp_path / "revocations.broken").exists()
    written(tmp_path, of_school(1))
    assert len(read(tmp_path)) == 1


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(LocalError, match="others"):
        RevocationUpkeep(tmp_path, Revocations(ROOTS))


def test_without_a_folder_nothing_is_written(tmp_path: Path) -> None:
    revoked = Revocations(ROOTS)
    upkeep = RevocationUpkeep(None, revoked)
    upkeep.restore(AT)
    upkeep.start()
    revoked.receive_revocation(of_school(1), b"a", AT, lambda _: True)
    upkeep.work(AT)
    upkeep.close()
    assert revoked.changes is None
    assert list(tmp_path.iterdir()) == []
