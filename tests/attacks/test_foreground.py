"""Attacks of other users of a host on programs that run in the foreground."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest

from gdp.enrolment import supervisor
from gdp.enrolment.programs import MachineProgram


def test_a91_a_program_runs_no_module_from_the_folder_in_which_it_was_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``sudo gdp up DIR --no-systemd`` in ``/tmp``: ``python -m`` would import from there first."""
    planted = tmp_path / "planted"
    (tmp_path / "gdp").mkdir()
    (tmp_path / "gdp" / "__init__.py").write_text(f"open({str(planted)!r}, 'w').close()\n")
    monkeypatch.chdir(tmp_path)

    async def run() -> int:
        program = MachineProgram(name="version", title="version", argv=(sys.executable, "-m", "gdp.names"))
        return await (await supervisor._start(program)).wait()

    assert asyncio.run(run()) == 0
    assert not planted.exists()


def test_a_relative_path_of_modules_stays_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_module.py").write_text("")
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "own_module.py").write_text("raise SystemExit(7)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "lib")

    async def run() -> int:
        program = MachineProgram(name="own", title="own", argv=(sys.executable, "-m", "own_module"))
        return await (await supervisor._start(program)).wait()

    assert asyncio.run(run()) == 7
