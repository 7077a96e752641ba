"""What our reader gives of each recording below folders, next to the reader of its format: for suites of public files.

    python scripts/read_recordings.py rosbag2/rosbag2_tests/resources mcap/tests/conformance/data

MCAP has the ``mcap`` package, a database SQLite, a bag rosbags. Exit code 1: ours gives less of a recording and says
nothing of it, or fails otherwise than with a reason.
"""

from __future__ import annotations

import argparse
import sqlite3
import sys
from collections import Counter
from contextlib import closing
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.rosbag1 import Reader, ReaderError

from gdp.errors import GdpError
from proxy.recordings.reader import BagReader

UNREADABLE = (McapError, ReaderError, sqlite3.DatabaseError, OSError, ValueError)


def plain_count(path: Path) -> int:
    """Return how many messages the reader of the format gives, up to the first that it cannot read."""
    count = 0
    try:
        match path.suffix:
            case ".mcap":
                with path.open("rb") as file:
                    for record in StreamReader(file).records:
                        count += isinstance(record, Message)
            case ".db3":
                with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
                    ((count,),) = database.execute("SELECT count(*) FROM messages")
            case _:
                with Reader(path) as bag:
                    for _ in bag.messages():
                        count += 1
    except UNREADABLE:
        return count
    return count


def outcome_of(path: Path) -> tuple[str, str]:
    """Return a word for what our reader gave, and its reason."""
    expected = plain_count(path)
    try:
        with BagReader(path) as bag:
            given = sum(1 for _ in bag.messages())
            reason = bag.unread
    except GdpError as error:
        return "refused with a reason" if expected else "empty or unreadable for both", str(error)
    if given >= expected:
        return "all", reason
    return ("less, with a reason" if reason else "LESS, WITHOUT A WORD"), f"{given} of {expected}: {reason}"


def main() -> int:
    """Print how many recordings had each outcome, and what is not whole; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--quiet", action="store_true", help="print the numbers alone")
    arguments = parser.parse_args()
    outcomes = Counter[str]()
    for folder in arguments.folders:
        for path in sorted(each for each in folder.rglob("*") if each.suffix in (".mcap", ".db3", ".bag")):
            outcome, reason = outcome_of(path)
            outcomes[outcome] += 1
            if outcome != "all" and not arguments.quiet:
                print(f"{path.relative_to(folder)}: {outcome}: {reason.replace(str(path), path.name)[:200]}")
    for outcome, count in outcomes.most_common():
        print(f"{count:6}  {outcome}")
    return 1 if outcomes["LESS, WITHOUT A WORD"] else 0


if __name__ == "__main__":
    sys.exit(main())
