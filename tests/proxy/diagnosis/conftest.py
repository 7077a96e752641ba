"""Summary of the diagnoses of a run: how many faults were named rightly, and how many alarms were false."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.insiders.oracle import signing_oracle

_WAYS = {"directly": "every node asked directly", "by_frames": "far nodes asked by frames"}


@pytest.fixture(scope="module", autouse=True)
def _signatures() -> Iterator[None]:
    """Sign by the ideal scheme: no fault here is one of signatures."""
    with signing_oracle():
        yield


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    passed = [each.nodeid for each in terminalreporter.stats.get("passed", ()) if each.when == "call"]
    failed = [each.nodeid for each in terminalreporter.stats.get("failed", ())]
    for way, words in _WAYS.items():
        part = f"::test_a_fault_is_named_when_{'every' if way == 'directly' else 'far'}"
        right, wrong = (sum(part in each for each in ids) for ids in (passed, failed))
        wrong += sum("that_frames_cannot_tell" in each for each in passed if way == "by_frames")
        if right + wrong:
            terminalreporter.write_line(f"named rightly: {right} of {right + wrong} ({words})")
    fine, alarms = (sum("test_healthy.py" in each for each in ids) for ids in (passed, failed))
    if fine + alarms:
        terminalreporter.write_line(f"false alarms: {alarms} of {fine + alarms}")
