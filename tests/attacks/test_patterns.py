"""Cost of matching names of the local graph against the operator's patterns."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gdp.ros_names import is_pattern

_CPU_S = 5  # a thousand times the measured time; a pattern that backtracks needs hours

_MATCH = f"""
import resource, sys
from gdp.ros_names import matches
resource.setrlimit(resource.RLIMIT_CPU, ({_CPU_S}, {_CPU_S}))
print(matches(sys.argv[1], sys.argv[2]))
"""


def _match(pattern: str, name: str) -> str:
    assert is_pattern(pattern)
    done = subprocess.run([sys.executable, "-c", _MATCH, pattern, name], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("pattern", "name"),
    [("/a*a*b", "/" + "a" * 500), ("/a*a*a*a*b", "/" + "a" * 100), ("/a*a*a*a*a*b", "/" + "a" * 60)],
)
def test_a69_a_name_made_for_a_pattern_with_several_stars_costs_little(pattern: str, name: str) -> None:
    assert _match(pattern, name) == "False"


@pytest.mark.parametrize("pattern", ["/**/image", "/robot*/**/camera/*_raw", "/*/*/*/*", "/**/arm/**/joint*"])
def test_a75_patterns_as_people_write_them_cost_little_for_any_name(pattern: str) -> None:
    assert _match(pattern, "/a" * 255) == "False"
