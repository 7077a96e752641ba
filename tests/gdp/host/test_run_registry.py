"""Records of runs, and the clean-up of dead ones by the next start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.mounts import mount_tmpfs
from gdp.host.processes import Process
from gdp.host.run_registry import Record, Run, RunRegistry


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunRegistry:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return RunRegistry(tmp_path / "runs")


def rewrite(run: Run, folder: Path, change: Callable[[Record], None]) -> None:
    path = folder / "runs" / f"{run.id}.json"
    record = Record.from_text(path.read_text())
    change(record)
    path.write_text(record.to_text())


def orphan(record: Record) -> None:
    record.owner = Process(record.owner.pid, record.owner.started - 1)


def test_a_run_under_way_is_left_alone(runs: RunRegistry) -> None:
    run = runs.start()
    assert runs.sweep() == []
    assert runs.take_down() == []
    assert run.directory.is_dir()
    run.end()


def test_the_end_of_a_run_leaves_nothing(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    (run.directory / "keys").mkdir()
    (run.directory / "keys" / "a").write_text("secret")
    run.end()
    assert list(tmp_path.rglob("*")) == []


def test_a_folder_that_two_processes_remove_at_once_is_gone(
    runs: RunRegistry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = runs.start()
    for name in ("a", "b", "keys/c", "keys/d"):
        (run.directory / name).parent.mkdir(exist_ok=True)
        (run.directory / name).write_text("secret")
    unlink = os.unlink

    def unlink_second(path: str, *, dir_fd: int | None = None) -> None:
        with suppress(FileNotFoundError):
            unlink(path, dir_fd=dir_fd)
        unlink(path, dir_fd=dir_fd)

    monkeypatch.setattr(os, "unlink", unlink_second)
    run.end()
    assert list(tmp_path.rglob("*")) == []


def test_a_directory_for_records_that_another_run_removed_is_made_again(runs: RunRegistry, tmp_path: Path) -> None:
    first = runs.start()
    first.end()
    with_record = runs.start()
    assert len(list((tmp_path / "runs").iterdir())) == 1
    with_record.end()
    assert not (tmp_path / "runs").exists()
    assert not runs.all()
    assert not runs.sweep()


def test_only_this_user_sees_a_run(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    assert run.directory.stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "runs" / f"{run.id}.json").stat().st_mode & 0o777 == 0o600
    run.end()


def test_the_run_of_a_killed_process_is_swept_with_its_processes(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    with subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"], start_new_session=True) as left:
        run.note_process(left.pid)
        rewrite(run, tmp_path, orphan)
        assert runs.sweep() == [run.id]
        assert left.wait(5) != 0
    assert not run.directory.exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount")
def test_what_a_run_mounted_is_unmounted_with_it(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    disk = run.directory / "disk"
    run.plan_mount(disk)
    mount_tmpfs(disk, 1 << 20)
    (disk / "file").write_text("text")
    rewrite(run, tmp_path, orphan)
    assert runs.sweep() == [run.id]
    assert not run.directory.exists()
    assert str(disk) not in Path("/proc/self/mounts").read_text()


def test_a_kept_run_outlives_its_process_until_it_is_taken_down(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    with subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"], start_new_session=True) as left:
        run.note_process(left.pid)
        run.retain()
        rewrite(run, tmp_path, orphan)
        assert runs.sweep() == []
        assert left.poll() is None
        assert runs.take_down() == [run.id]
        assert left.wait(5) != 0


def test_a_kept_run_whose_processes_all_died_is_swept(runs: RunRegistry) -> None:
    run = runs.start()
    run.retain()
    assert runs.sweep() == [run.id]


def test_after_a_boot_no_process_is_touched_on_the_word_of_an_old_record(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    with subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"], start_new_session=True) as stranger:
        run.note_process(stranger.pid)
        rewrite(run, tmp_path, lambda record: setattr(record, "boot", "another"))
        assert runs.sweep() == [run.id]
        assert stranger.poll() is None
        stranger.kill()


def test_a_record_that_cannot_be_read_is_left_alone(runs: RunRegistry, tmp_path: Path) -> None:
    unexpected = tmp_path / "runs" / "abc.json"
    for text in ("", "[]", "{}", json.dumps({"run": "abc", "owner": 1, "processes": []})):
        unexpected.write_text(text)
        assert runs.sweep() == []
    assert unexpected.exists()


def test_a_record_whose_writer_was_killed_is_swept(runs: RunRegistry, tmp_path: Path) -> None:
    run = runs.start()
    of_a_run, of_none, young = (tmp_path / "runs" / f"{name}.new" for name in (run.id, "abc", "def"))
    for each in (of_a_run, of_none, young):
        each.touch()
    for each in (of_a_run, of_none):
        os.utime(each, (1.0, 1.0))
    assert runs.sweep() == []
    assert [each.exists() for each in (of_a_run, of_none, young)] == [True, False, True]
    rewrite(run, tmp_path, orphan)
    assert runs.sweep() == [run.id]
    assert [each.exists() for each in (of_a_run, young)] == [False, True]


def test_records_that_others_could_have_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    os.chmod(tmp_path / "open", 0o777)
    with pytest.raises(LocalError, match="must belong to this user alone"):
        RunRegistry(tmp_path / "open")
