"""Control groups of the ring's machines, where the system refuses them."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.cgroups import Cgroup
from gdp.host.run_registry import RunRegistry
from lab.cores import MachineCores


def test_where_the_system_refuses_weights_no_group_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(group: Cgroup, cores: int) -> None:
        """Refuse the second machine's weight, as a kernel without the controller does."""
        if group.name.endswith("-nuc2"):
            raise LocalError("no weight here")

    removed: list[str] = []
    monkeypatch.setattr(Cgroup, "make", lambda _: True)
    monkeypatch.setattr(Cgroup, "limit_cpu", lambda *_: None)
    monkeypatch.setattr(Cgroup, "share_cpu", refuse)
    monkeypatch.setattr(Cgroup, "remove", lambda group: removed.append(group.name))
    run = RunRegistry(tmp_path / "runs").start()
    try:
        with pytest.raises(LocalError, match="no weight here"):
            MachineCores(run, {"nuc1": 2, "nuc2": 4, "nuc3": 4})
        assert removed == [f"gdp-{run.id}-nuc1", f"gdp-{run.id}-nuc2"]
        assert set(removed) == set(run.record.cgroups)
    finally:
        run.end()
