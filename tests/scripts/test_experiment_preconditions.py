"""Data, folder, load and repository that an experiment or a bench needs: what lacks ends it before it measures."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import availability
import machine
import pytest
import table1
import uplink
from machine import MachineState, machine_state
from report import Rounds, write_json
from skeleton import Outcome, command_line, parse, perform

from tests.pages import ROOT

DATA = ROOT / "scripts" / "data"
QUIET = replace(machine_state(), load_before=0.0, commit="123456789abc", cores=2)
BUSY = replace(QUIET, load_before=1.5)
Ends = Callable[[Callable[[], object]], str]


@pytest.fixture
def ends(capsys: pytest.CaptureFixture[str]) -> Ends:
    """Return a function that runs a command, which ends with status 2, and returns its one line."""

    def run(command: Callable[[], object]) -> str:
        with pytest.raises(SystemExit) as ended:
            command()
        assert ended.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return run


def on(monkeypatch: pytest.MonkeyPatch, state: MachineState) -> None:
    """Let experiments and benches find a machine in this state."""
    for module in ("experiment", "skeleton"):
        monkeypatch.setattr(f"{module}.machine_state", lambda: state)


def test_every_data_file_has_the_checksum_that_is_listed() -> None:
    lines = (DATA / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
    listed = {path: digest for digest, path in (line.split() for line in lines)}
    files = {str(path.relative_to(DATA)): path for kind in DATA.iterdir() if kind.is_dir() for path in kind.iterdir()}
    del files["uplinks/COPYING"]
    assert files.keys() <= listed.keys()
    assert {path for path in listed if path not in files} <= {path for path in listed if path.startswith("planning/")}
    for path, file in files.items():
        assert hashlib.sha256(file.read_bytes()).hexdigest() == listed[path], path


def test_the_wheel_and_the_sdist_hold_no_data() -> None:
    assert 'include = ["gdp*", "proxy*", "fog*"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert not (ROOT / "MANIFEST.in").exists()  # which alone could add other folders to the sdist


def test_a_command_without_its_data_says_which_file_and_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ends: Ends
) -> None:
    on(monkeypatch, QUIET)
    monkeypatch.setattr(machine.data_folder, "__defaults__", (tmp_path,))
    said = ends(lambda: availability.main(["--out", str(tmp_path / "out")]))
    assert f"no {tmp_path}/spot/aws_*.json: git checkout -- scripts/data restores it" in said
    assert not list((tmp_path / "out").iterdir())
    monkeypatch.setattr("sys.argv", ["uplink.py", "--quick", "--rates", "Radio", "--traces", str(tmp_path)])
    assert f"no recording {tmp_path}/Radio.up" in ends(lambda: perform(parse(uplink.arguments()), uplink.measure))


def test_problems_that_are_not_here_are_fetched_by_a_command_that_is_named(tmp_path: Path) -> None:
    with pytest.raises(machine.RefusedError, match=r"no .*/planning/Home.cfg: scripts/data/fetch.sh fetches it"):
        machine.data_folder("planning", ["Home.cfg"], tmp_path)


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_only_files_with_the_listed_checksum_are_fetched(tmp_path: Path) -> None:
    (tmp_path / "data" / "planning").mkdir(parents=True)
    shutil.copy(DATA / "fetch.sh", tmp_path / "data")
    digest = hashlib.sha256(b"mesh").hexdigest()
    (tmp_path / "data" / "SHA256SUMS").write_text(f"{digest}  planning/Home.cfg\n{digest}  spot/a\n", encoding="utf-8")

    def fetch() -> subprocess.CompletedProcess[str]:
        argv = [str(tmp_path / "data" / "fetch.sh"), str(tmp_path)]
        return subprocess.run(argv, capture_output=True, text=True, check=False)

    assert (fetch().returncode, len(fetch().stderr.splitlines())) == (2, 1)
    for text in ("other", "mesh"):
        (tmp_path / "Home.cfg").write_text(text, encoding="utf-8")
        assert (fetch().returncode == 0) == (text == "mesh")
        assert (tmp_path / "data" / "planning" / "Home.cfg").exists() == (text == "mesh")


def test_a_folder_that_cannot_be_written_is_found_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ends: Ends
) -> None:
    on(monkeypatch, QUIET)
    monkeypatch.setattr(table1, "applications", lambda: pytest.fail("measured"))
    (tmp_path / "file").touch()
    said = ends(lambda: table1.main(["--out", str(tmp_path / "file" / "out")]))
    assert f"{tmp_path}/file/out cannot be written (Not a directory): choose another folder" in said


def test_a_busy_machine_writes_no_page_but_runs_quickly_or_marks_its_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ends: Ends
) -> None:
    on(monkeypatch, BUSY)
    monkeypatch.setattr("plot.save", lambda figure, path, **_: path.touch())
    said = ends(lambda: availability.main(["--out", str(tmp_path)]))
    assert "the load before, 1.50, exceeds half of 2 cores" in said
    assert "--allow-load" in said
    assert not list(tmp_path.iterdir())
    availability.main(["--quick", "--json"])
    monkeypatch.setattr(availability, "RECOVERIES", ("34s",))
    availability.main(["--allow-load", "--out", str(tmp_path)])
    assert str(BUSY) in (tmp_path / "availability.md").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "availability.json").read_text(encoding="utf-8"))["machine"] == asdict(BUSY)


def test_a_bench_on_a_busy_machine_writes_no_record_but_marks_rows_where_that_is_allowed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ends: Ends, capsys: pytest.CaptureFixture[str]
) -> None:
    on(monkeypatch, BUSY)
    monkeypatch.setattr("skeleton.OUTPUT", tmp_path / "docs")
    record = tmp_path / "record.json"

    def run(*words: str, is_whole: bool = True) -> None:
        def measure(options: object) -> Outcome:
            over = Rounds()
            over.add("bridge", "case", "s", 1.0)
            return Outcome("bench", "Bench", over, [], {})

        parser = command_line("", quick={"rounds": 1}, has_record=True)
        parser.set_defaults(is_whole=lambda _: is_whole)
        perform(parse(parser, words), measure)

    assert "exceeds half of 2 cores" in ends(run)
    assert "exceeds half of 2 cores" in ends(lambda: run("--json", str(record), is_whole=False))
    run(is_whole=False)
    run("--quick")
    run("--no-save")
    assert not record.exists()
    assert not list((tmp_path / "docs").iterdir())
    run("--json", str(record), "--allow-load")
    stamp = {"date": BUSY.date, "commit": BUSY.commit, "load_before": 1.5}
    assert json.loads(record.read_text(encoding="utf-8"))["measured"] == {"bridge": stamp}
    assert "bridge (load 1.5)" in capsys.readouterr().out


def test_a_row_that_is_kept_keeps_its_own_commit_and_load(tmp_path: Path) -> None:
    over = [Rounds(), Rounds()]
    for found, name, state in zip(over, ("old", "new"), (replace(BUSY, commit="0ld"), QUIET), strict=True):
        found.add(name, "case", "s", 1.0)
        write_json(tmp_path / "record.json", "bench", state, {}, found, keeps=True)
    measured = json.loads((tmp_path / "record.json").read_text(encoding="utf-8"))["measured"]
    assert {name: (each["commit"], each["load_before"]) for name, each in measured.items()} == {
        "old": ("0ld", 1.5),
        "new": (QUIET.commit, 0.0),
    }


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this tree is no clone")
def test_a_machine_names_the_commit_of_its_code_and_whether_code_was_changed() -> None:
    found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert found.startswith(machine_state().commit.removesuffix("-dirty"))


def test_a_tree_without_git_writes_no_page_but_runs_quickly(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    for part in ("scripts", "gdp", "fog", "proxy", "gdp_extensions"):
        shutil.copytree(ROOT / part, tree / part, ignore=shutil.ignore_patterns("__pycache__", "data"))
    argv = [sys.executable, str(tree / "scripts/experiments/table1.py")]
    environment = {**os.environ, "PYTHONPATH": f"{tree}{os.pathsep}{tree / 'scripts'}"}
    ran = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False)
    (line,) = ran.stderr.splitlines()
    assert ran.returncode == 2
    assert f"{tree} is no git repository: clone it by git, or use --quick" in line
    assert not (tree / "docs" / "experiments" / "table1.md").exists()
    assert subprocess.run([*argv, "--quick"], env=environment, capture_output=True, check=False).returncode == 0
