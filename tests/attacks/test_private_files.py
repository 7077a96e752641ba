"""Private files of other users: a key that another user wrote is not accepted."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fog.site import open_site
from gdp.config.config import ClusterConfig
from gdp.errors import LocalError
from gdp.host.run_registry import RunRegistry
from gdp.stores.files import private, read_private, write_all
from gdp.stores.issue import make_domain
from gdp.stores.keyring import load_domain
from tests.attacks.owners import UNKNOWN, give_away


def key(folder: Path) -> Path:
    write_all(folder, {"root.key": private(b"secret")})
    return folder / "root.key"


def test_a48_a_private_key_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = key(tmp_path / "lab")
    give_away(path, monkeypatch)
    with pytest.raises(LocalError, match=r"root\.key: belongs to user"):
        read_private(path)


def test_a48_a_link_is_not_followed_to_a_private_key(tmp_path: Path) -> None:
    path = key(tmp_path / "lab")
    (tmp_path / "lab" / "link.key").symlink_to(path)
    with pytest.raises(LocalError, match=r"link\.key"):
        read_private(tmp_path / "lab" / "link.key")


def test_a48_a_private_key_in_a_folder_that_all_may_write_is_refused(tmp_path: Path) -> None:
    make_domain(tmp_path / "lab", "lab")
    (tmp_path / "lab").chmod(0o777)
    with pytest.raises(LocalError, match="chmod go-w"):
        load_domain(tmp_path / "lab")
    (tmp_path / "lab").chmod(0o1777)  # as /tmp: no user can replace another user's file
    load_domain(tmp_path / "lab")


def test_a48_a_private_key_in_a_folder_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = key(tmp_path / "lab")
    give_away(path.parent, monkeypatch)
    with pytest.raises(LocalError, match="belongs to user"):
        read_private(path)


def test_a48_no_private_key_is_written_where_others_may_replace_it(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab").chmod(0o777)
    with pytest.raises(LocalError, match="chmod go-w"):
        make_domain(tmp_path / "lab", "lab")
    assert list((tmp_path / "lab").iterdir()) == []


def test_a48_a_pipe_in_place_of_a_private_key_holds_nothing_up(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "root.key", 0o600)
    with pytest.raises(LocalError, match="regular file"):
        read_private(tmp_path / "root.key")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root trusts who called sudo")
def test_a48_root_by_sudo_reads_the_keys_of_who_called_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = key(tmp_path / "lab")
    os.chown(path, UNKNOWN, UNKNOWN)
    monkeypatch.setenv("SUDO_UID", str(UNKNOWN))
    assert read_private(path) == b"secret"


def test_a49_root_takes_no_folder_of_another_user_as_its_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "state").mkdir()
    give_away(tmp_path / "state", monkeypatch)
    with pytest.raises(LocalError, match="must belong to this user alone"):
        open_site(None, tmp_path / "state")
    assert list((tmp_path / "state").iterdir()) == []


def test_a49_a_site_that_all_may_write_to_is_refused(tmp_path: Path) -> None:
    open_site(None, tmp_path / "state")
    (tmp_path / "state").chmod(0o777)
    with pytest.raises(LocalError, match="must belong to this user alone"):
        open_site(None, tmp_path / "state")


def test_a49_a_folder_of_records_is_refused_by_the_same_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs").mkdir()
    give_away(tmp_path / "runs", monkeypatch)
    with pytest.raises(LocalError, match="must belong to this user alone"):
        RunRegistry(tmp_path / "runs")


def test_a48_the_password_of_a_store_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "password"
    path.write_text("secret\n")
    path.chmod(0o644)
    config = ClusterConfig(nodes=("[::1]:6379",), password_file=path)
    with pytest.raises(LocalError, match="chmod 600"):
        config.password()
    path.chmod(0o600)
    assert config.password() == "secret"
