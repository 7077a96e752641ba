"""Audit of a node: its location, and the count of refused statements."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

import pytest

from gdp.errors import DropReason
from gdp.nodes.audit import NodeAudit, audit_folder
from gdp.sansio import Timestamps
from gdp.stores.audit_log import AuditLog, verify_audit
from gdp.trust.audit import AuditTrail


def test_a_node_audits_in_the_configured_folder_or_where_systemd_keeps_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert audit_folder(None) is None
    assert audit_folder(Path("kept")) == Path("kept")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/gdp:/var/lib/other")
    assert audit_folder(None) == Path("/var/lib/gdp/audit")
    assert audit_folder(Path("kept")) == Path("kept")


def test_refused_statements_are_counted_and_losses_on_the_way_are_not(tmp_path: Path) -> None:
    drops: Counter[DropReason] = Counter()
    audit = NodeAudit(AuditLog(tmp_path / "audit"), AuditTrail(), lambda: drops)
    for second in range(5):
        drops[DropReason.BAD_SIGNATURE] += 100_000
        drops[DropReason.NO_READER] += 1
        audit.write_pending(Timestamps(float(second), 1_800_000_000.0 + second))
    found = verify_audit(tmp_path / "audit")
    assert dict(found.events) == {("refused", "statements"): 500_000}
    assert found.lines == 5


def test_a_folder_that_is_gone_is_reported_once_and_the_node_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    drops: Counter[DropReason] = Counter()
    audit = NodeAudit(AuditLog(tmp_path / "audit"), AuditTrail(), lambda: drops)
    (tmp_path / "audit").rmdir()
    for second in range(3):
        drops[DropReason.REPLAYED] += 1
        audit.write_pending(Timestamps(float(second), 1_800_000_000.0))
    assert [each.levelno for each in caplog.records] == [logging.ERROR]
