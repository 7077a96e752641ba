"""``gdp wireshark``, as called by a person."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp_extensions.dissector.dissector import dissector
from gdp_extensions.dissector.wireshark import _plugin_folder
from tests.gdp_extensions.dissector.tshark import needs_tshark


@pytest.fixture(autouse=True)
def _at_a_home_without_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))


def _wireshark(*words: str) -> int:
    try:
        main(["wireshark", *words])
    except SystemExit as leaving:
        return int(leaving.code or 0)
    return 0


def test_it_prints_the_dissector(capsys: pytest.CaptureFixture[str]) -> None:
    assert _wireshark() == 0
    assert capsys.readouterr().out == dissector()


def test_it_is_installed_and_replaces_itself_but_no_file_of_another(capsys: pytest.CaptureFixture[str]) -> None:
    assert _wireshark("--install", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    path = Path(result["dissector"])
    assert (path.read_text(), result["replaced"]) == (dissector(), False)
    path.write_text(path.read_text() + "-- earlier version\n")
    assert _wireshark("--install") == 0
    assert path.read_text() == dissector()
    path.write_text("-- of another\n")
    assert _wireshark("--install") == 2
    assert "--force" in capsys.readouterr().err
    assert _wireshark("--install", "--force") == 0


def test_it_goes_to_a_file_or_into_the_folder_of_plugins_but_not_both(tmp_path: Path) -> None:
    assert _wireshark("-o", str(tmp_path / "mine.lua")) == 0
    assert (tmp_path / "mine.lua").read_text() == dissector()
    assert _wireshark("--install", "-o", str(tmp_path / "other.lua")) == 2


def test_without_tshark_the_usual_folder_is_taken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert _plugin_folder() == tmp_path / ".local/lib/wireshark/plugins"


@needs_tshark
def test_tshark_loads_the_installed_dissector() -> None:
    assert _wireshark("--install") == 0
    result = subprocess.run(
        ["tshark", "-G", "protocols"], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    assert "Global Data Plane\tGDP\tgdp" in result
