"""Control groups, where the system permits their creation."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.cgroups import Cgroup
from gdp.host.run_registry import RunRegistry

_PATIENCE_S = 10.0
_BUSY_NS = 1_000_000_000


@pytest.fixture
def group() -> Iterator[Cgroup]:
    made = Cgroup(f"gdp-test-{os.getpid()}")
    if not made.make():
        made.remove()
        pytest.skip("cgroups with bounds on processor time and memory cannot be made here")
    yield made
    made.remove()


@pytest.fixture
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(["sleep", "1000"], start_new_session=True) as process:
        yield process
        process.kill()


def found(name: str) -> list[Path]:
    return list(Path("/sys/fs/cgroup").glob(f"**/{name}"))


def test_a_group_is_removed_with_all_that_is_in_it(group: Cgroup, sleeper: subprocess.Popen[bytes]) -> None:
    group.add(sleeper.pid)
    group.remove()
    assert sleeper.wait(_PATIENCE_S) == -signal.SIGKILL
    assert found(group.name) == []
    group.remove()


def test_a_bound_on_memory_holds(group: Cgroup) -> None:
    group.limit_memory(64 << 20)
    code = "import sys; sys.stdin.readline(); bytearray(256 << 20)"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as greedy:
        group.add(greedy.pid)
        greedy.communicate(b"go\n", timeout=_PATIENCE_S)
    assert greedy.returncode == -signal.SIGKILL
    group.limit_memory(None)


def test_groups_that_compete_get_time_by_their_cores(group: Cgroup) -> None:
    """Two busy processes on one processor, of which one group has three cores' worth and the other one."""
    other = Cgroup(f"{group.name}-other")
    processor = str(min(os.sched_getaffinity(0)))
    busy = [sys.executable, "-c", "while True: pass"]
    try:
        assert other.make()
        group.share_cpu(3)
        other.share_cpu(1)
        with ExitStack() as stack:
            spent = []
            for each in (group, other):
                process = stack.enter_context(subprocess.Popen(["taskset", "-c", processor, *busy]))
                stack.callback(process.kill)
                each.add(process.pid)
                spent.append(Path(f"/proc/{process.pid}/schedstat"))
            begun = [int(path.read_text().split()[0]) for path in spent]
            end_s = time.monotonic() + _PATIENCE_S
            used = [0, 0]
            while sum(used) < _BUSY_NS and time.monotonic() < end_s:
                time.sleep(0.02)
                used = [int(path.read_text().split()[0]) - at for path, at in zip(spent, begun, strict=True)]
        assert used[0] > 1.7 * used[1]
    finally:
        other.remove()


def test_bounds_are_set_and_taken_off(group: Cgroup) -> None:
    small = (0.025, {"1000 40000", "1000"})  # a longer period, because the kernel takes no quota below 1 ms
    for cpus, reported in ((0.5, {"10000 20000", "10000"}), small, (None, {"max 20000", "-1"})):
        group.limit_cpu(cpus)
        files = [path for folder in found(group.name) for path in folder.glob("cpu.[mc]*")]
        values = {path.read_text().strip() for path in files if path.name in ("cpu.max", "cpu.cfs_quota_us")}
        assert values <= reported
        assert values


def test_a_bound_that_cannot_be_set_is_refused() -> None:
    with pytest.raises(LocalError, match="no bound on processor time"):
        Cgroup("gdp-never-made").limit_cpu(1.0)
    with pytest.raises(LocalError):
        Cgroup("gdp-never-made").share_cpu(1)


def test_what_was_never_made_is_removed_without_complaint() -> None:
    Cgroup("gdp-never-made").kill()
    Cgroup("gdp-never-made").remove()


def test_a_group_that_somebody_else_removes_meanwhile_is_killed_without_complaint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = Cgroup("gdp-never-made")
    monkeypatch.setattr(group, "_find", lambda _: tmp_path / "removed" / "cgroup.kill")
    group.kill()


def test_a_run_takes_its_group_down(
    group: Cgroup, sleeper: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    runs = RunRegistry(tmp_path / "runs")
    run = runs.start()
    run.plan_cgroup(group.name)
    group.add(sleeper.pid)
    run.retain()
    assert [record.cgroups for record in runs.all()] == [[group.name]]
    runs.resume(run.id).end()
    assert sleeper.wait(_PATIENCE_S) == -signal.SIGKILL
    assert found(group.name) == []
    with pytest.raises(LocalError, match="no run"):
        runs.resume(run.id)


def test_a_group_is_found_from_a_mount_namespace_without_cgroups(group: Cgroup) -> None:
    # as with ip netns exec, which mounts another /sys
    if subprocess.run(["unshare", "--mount", "true"], check=False, capture_output=True).returncode:
        pytest.skip("mount namespaces cannot be made here")
    code = f"from gdp.host.cgroups import Cgroup; Cgroup({group.name!r}).remove()"
    hidden = 'umount --lazy --recursive /sys/fs/cgroup; exec "$@"'
    argv = ["unshare", "--mount", "--propagation", "private", "sh", "-c", hidden, "sh", sys.executable, "-c", code]
    subprocess.run(argv, check=True)
    assert not any(folder.exists() for folder in group._folders.values())
