"""Level and format of a command's log."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

_CODE = """
import logging
from gdp.cli.node import Format, Level, set_up_logging
set_up_logging(verbose={verbose}, level=Level({level!r}), form=Format({form!r}))
for name in ("gdp.nodes.switch", "pyroute2.core"):
    for level in (logging.DEBUG, logging.INFO, logging.WARNING):
        logging.getLogger(name).log(level, "said by %s", name)
try:
    raise ValueError("x")
except ValueError:
    logging.getLogger("gdp").exception("failed")
"""


def _logged(*, verbose: bool = False, level: str = "info", form: str = "text") -> list[str]:
    code = _CODE.format(verbose=verbose, level=level, form=form)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr.splitlines()


@pytest.mark.parametrize(
    ("verbose", "level", "ours", "theirs"), [(False, "info", 2, 1), (True, "info", 3, 1), (False, "error", 0, 0)]
)
def test_a_level_holds_for_us_and_libraries_are_heard_from_warnings_on(
    verbose: bool, level: str, ours: int, theirs: int
) -> None:
    lines = _logged(verbose=verbose, level=level)
    assert sum("said by gdp" in line for line in lines) == ours
    assert sum("said by pyroute2" in line for line in lines) == theirs


def test_a_log_in_json_has_one_object_a_line() -> None:
    *lines, last = map(json.loads, _logged(form="json"))
    assert [(each["level"], each["logger"]) for each in lines] == [
        ("info", "gdp.nodes.switch"),
        ("warning", "gdp.nodes.switch"),
        ("warning", "pyroute2.core"),
    ]
    assert lines[0]["message"] == "said by gdp.nodes.switch"
    assert lines[0]["time"].endswith("+00:00")
    assert "ValueError: x" in last["trace"]
