#!/usr/bin/env python3
"""Decision on tests that fail once and pass on a rerun: only a quarantined test may do so.

    scripts/rerun_check.py --first first.xml --rerun rerun.xml     files of pytest --junit-xml
    scripts/rerun_check.py --list                                  print the quarantine list

``tests/quarantine.yaml`` holds at most five entries with ``test`` (file.py::name, without parameters) and ``reason``.
Exit status: 0 every failure passed on the rerun and is quarantined, 1 a failure counts, 2 wrong input.
"""

from __future__ import annotations

import argparse
import sys
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

QUARANTINE = Path(__file__).resolve().parent.parent / "tests" / "quarantine.yaml"
ENTRIES_MAX = 5


class QuarantineError(Exception):
    """The quarantine list or a report is not as expected; the text names the file."""


def read_quarantine(path: Path) -> dict[str, str]:
    """Return the reason of each quarantined test.

    Raises ``QuarantineError``: not a list of tests with reasons, a test twice, or too many.
    """
    try:
        entries = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise QuarantineError(f"{path}: {error}") from error
    if not isinstance(entries, list):
        raise QuarantineError(f"{path}: expected a list of entries with test and reason")
    reasons: dict[str, str] = {}
    for number, entry in enumerate(entries, 1):
        if not isinstance(entry, dict) or entry.keys() != {"test", "reason"}:
            raise QuarantineError(f"{path}: entry {number}: expected the keys test and reason")
        test, reason = entry["test"], entry["reason"]
        if not isinstance(test, str) or "::" not in test or not isinstance(reason, str) or not reason.strip():
            raise QuarantineError(f"{path}: entry {number}: test is file.py::name and reason is not empty")
        if test in reasons:
            raise QuarantineError(f"{path}: entry {number}: {test} is listed twice")
        reasons[test] = reason
    if len(reasons) > ENTRIES_MAX:
        raise QuarantineError(f"{path}: {len(reasons)} entries, at most {ENTRIES_MAX}")
    return reasons


def read_outcomes(path: Path) -> dict[str, bool]:
    """Return whether each test of a JUnit file passed, by file and name with parameters; skipped counts as passed.

    Raises ``QuarantineError``: the file is missing or not a JUnit file.
    """
    try:
        root = ET.parse(path).getroot()  # written by pytest on this machine
    except (OSError, ET.ParseError) as error:
        raise QuarantineError(f"{path}: {error}") from error
    outcomes: dict[str, bool] = {}
    for case in root.iter("testcase"):
        test = f"{case.get('classname', '')}::{case.get('name', '')}"
        passed = case.find("failure") is None and case.find("error") is None
        outcomes[test] = passed and outcomes.get(test, True)
    return outcomes


def junit_name(test: str) -> str:
    """Return ``tests/a/test_b.py::C::name`` as JUnit files of pytest write it: ``tests.a.test_b.C::name``."""
    file, *classes, name = test.split("::")
    return ".".join([file.removesuffix(".py").replace("/", "."), *classes]) + f"::{name}"


def counted_failures(first: Mapping[str, bool], rerun: Mapping[str, bool], quarantined: Sequence[str]) -> list[str]:
    """Return one line for each failure of the first run that fails the whole run."""
    forgiven = {junit_name(test) for test in quarantined}
    found: list[str] = []
    for test, passed in first.items():
        if passed:
            continue
        if test not in rerun:
            found.append(f"{test}: failed, and the rerun did not run it")
        elif not rerun[test]:
            found.append(f"{test}: failed twice")
        elif test.partition("[")[0] not in forgiven:
            found.append(f"{test}: failed, then passed on the rerun; fix it, or list it in {QUARANTINE.name}")
    return [
        *found,
        *(f"{test}: failed in the rerun only" for test, ok in rerun.items() if not ok and test not in first),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    head, _, text = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=head, epilog=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=Path, help="JUnit file of the first run")
    parser.add_argument("--rerun", type=Path, help="JUnit file of the rerun")
    parser.add_argument("--list", action="store_true", help="print the quarantine list")
    options = parser.parse_args(argv)
    try:
        quarantined = read_quarantine(QUARANTINE)
        if options.list:
            for test, reason in quarantined.items():
                print(f"{test}: {reason}")
            return 0
        if options.first is None or options.rerun is None:
            parser.error("--first and --rerun are required")
        first = read_outcomes(options.first)
        found = counted_failures(first, read_outcomes(options.rerun), list(quarantined))
    except QuarantineError as error:
        print(f"rerun_check: {error}", file=sys.stderr)
        return 2
    if not found and all(first.values()):
        found = [f"{options.first}: pytest failed, but no test did"]
    for line in found:
        print(f"rerun_check: {line}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
