"""Summary of the diagnoses of a run: how many faults were named rightly, and how many alarms were false."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.insiders.oracle import signing_oracle


@pytest.fixture(autouse=True)
def _signatures() -> Iterator[None]:
    """Sign by the ideal scheme: no fault here is one of signatures."""
    with signing_oracle():
        yield


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    passed = [each.nodeid for each in terminalreporter.stats.get("passed", ()) if each.when == "call"]
    failed = [each.nodeid for each in terminalreporter.stats.get("failed", ())]
    right, wrong = (sum("::test_a_fault_is_named" in each for each in ids) for ids in (passed, failed))
    if right + wrong:
        terminalreporter.write_line(f"named rightly, directly and by frames: {right} of {right + wrong}")
    fine, alarms = (sum("test_healthy.py" in each for each in ids) for ids in (passed, failed))
    if fine + alarms:
        terminalreporter.write_line(f"false alarms: {alarms} of {fine + alarms}")
