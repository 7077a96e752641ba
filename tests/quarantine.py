"""Plugin of every run: a test in quarantine that fails runs once more, at once; of any other test a failure counts.

The mark ``quarantined("reason")`` puts a test there, with all its parameters. At most five may be there.
"""

from __future__ import annotations

import pytest
from _pytest.runner import runtestprotocol

MARK = "quarantined"
TESTS_MAX = 5


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a mark without a reason, and too many marked tests."""
    marks = {each.nodeid.partition("[")[0]: mark for each in items if (mark := each.get_closest_marker(MARK))}
    for test, mark in marks.items():
        if not any(isinstance(reason, str) and reason.strip() for reason in mark.args):
            raise pytest.UsageError(f"{test}: {MARK} needs a reason")
    if len(marks) > TESTS_MAX:
        raise pytest.UsageError(f"{len(marks)} tests are {MARK}, at most {TESTS_MAX}: {', '.join(marks)}")


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a marked test again that failed, with fixtures of its own; only the last outcome is reported."""
    if item.get_closest_marker(MARK) is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports = runtestprotocol(item, log=False, nextitem=nextitem)
    if any(each.failed for each in reports):
        item._initrequest()  # type: ignore[attr-defined]  # of a function
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
    for each in reports:
        item.ihook.pytest_runtest_logreport(report=each)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
