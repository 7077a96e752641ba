"""Search for the configuration of a machine's switch."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.config.found_config import find_switch_config
from gdp.errors import LocalError


def _made(*parts: str | Path) -> Path:
    path = Path(*parts) / "switch.yaml"
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.write_text("identity: switch\n")
    return path


def test_a_file_here_precedes_those_in_folders(tmp_path: Path) -> None:
    _made(tmp_path, "robot")
    here = _made(tmp_path)
    assert find_switch_config([], tmp_path, []) == here


def test_the_only_one_of_a_lab_or_of_a_joined_domain_is_found(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    joined = _made(tmp_path, "var", "lab")
    folders = [tmp_path / "var", tmp_path / "none"]
    assert find_switch_config([], tmp_path / "here", folders) == joined
    robot = _made(tmp_path, "here", "robot")
    assert find_switch_config([], tmp_path / "here", [tmp_path / "none"]) == robot
    with pytest.raises(LocalError, match=r"several identities are here: robot/switch.yaml, /.*--config robot/"):
        find_switch_config([], tmp_path / "here", folders)


def test_without_any_the_error_names_the_command_that_makes_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "robot")
    with pytest.raises(LocalError, match=r"make one: gdp lab robot --iface eth0$"):
        find_switch_config(["eth0", "eth1"], tmp_path, [])


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    _made(tmp_path, "robot").parent.chmod(0o777)
    with pytest.raises(LocalError, match="lets others replace"):
        find_switch_config([], tmp_path, [])
