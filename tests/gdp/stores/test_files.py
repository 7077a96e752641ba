"""Files that hold keys."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.stores.files import FILE_MAX_BYTES, private, public, read_private, read_public, write_all


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_all(tmp_path / "a" / "b", {"key": private(b"secret"), "pub": public(b"open")})
    assert read_private(tmp_path / "a" / "b" / "key") == b"secret"
    assert read_public(tmp_path / "a" / "b" / "pub") == b"open"


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_a_private_file_and_its_directory_are_for_their_owner_only(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        write_all(tmp_path / "new", {"key": private(b"secret")})
    finally:
        os.umask(before)
    assert mode(tmp_path / "new" / "key") == 0o600
    assert mode(tmp_path / "new") & 0o077 == 0


def test_a_private_file_is_private_from_its_first_byte_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    genuine = os.fsync

    def watching(handle: int) -> None:
        if stat.S_ISREG(mode := os.fstat(handle).st_mode):
            seen.append(stat.S_IMODE(mode))
        genuine(handle)

    monkeypatch.setattr(os, "fsync", watching)
    write_all(tmp_path, {"key": private(b"secret")})
    assert seen == [0o600]


def test_nothing_is_written_if_one_of_them_is_there(tmp_path: Path) -> None:
    (tmp_path / "b").write_bytes(b"old")
    with pytest.raises(LocalError, match="--force"):
        write_all(tmp_path, {"a": private(b"new"), "b": private(b"new")})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b"]
    assert (tmp_path / "b").read_bytes() == b"old"


def test_force_replaces_and_makes_private(tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(b"old")
    (tmp_path / "key").chmod(0o644)
    write_all(tmp_path, {"key": private(b"new")}, force=True)
    assert read_private(tmp_path / "key") == b"new"


def test_one_who_comes_first_in_the_last_moment_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "key").write_bytes(b"theirs")
    monkeypatch.setattr(os.path, "lexists", lambda path: False)
    with pytest.raises(LocalError, match="--force"):
        write_all(tmp_path, {"key": private(b"ours")})
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"theirs"]


def test_a_failure_in_the_middle_leaves_no_draft(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(LocalError, match="No space left"):
        write_all(tmp_path, {"key": private(b"secret")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("others", [0o640, 0o604, 0o660, 0o620, 0o644, 0o601])
def test_a_private_file_that_others_can_reach_is_not_read(tmp_path: Path, others: int) -> None:
    write_all(tmp_path, {"key": private(b"secret")})
    (tmp_path / "key").chmod(others)
    with pytest.raises(LocalError, match="chmod 600"):
        read_private(tmp_path / "key")


@pytest.mark.parametrize("name", ["absent", "."])
def test_what_is_no_file_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(LocalError, match=str(tmp_path)):
        read_public(tmp_path / name)


def test_a_file_too_long_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "big").write_bytes(bytes(FILE_MAX_BYTES + 1))
    with pytest.raises(LocalError, match="longer"):
        read_public(tmp_path / "big")
