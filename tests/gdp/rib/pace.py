"""Processor time of a RIB for each statement: new and renewed advertisements, and queries.

    PYTHONPATH=scripts:scripts/bench python -m tests.gdp.rib.pace

Signatures are ideal, so the time is that of the RIB itself; ``--real`` signs and verifies by ECDSA. Making the
statements is not counted.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from statistics import median

from gdp.control.rib_statements import Query
from gdp.metadata import Metadata
from tests.gdp.rib.test_core import START, relay, rib
from tests.gdp.trust.world import LAB, SWITCH, adcert, advertisement
from tests.insiders.oracle import signing_oracle


def _ms_each(receive: Callable[[bytes], object], statements: Sequence[bytes]) -> float:
    began = time.process_time()
    for each in statements:
        receive(each)
    return (time.process_time() - began) * 1e3 / len(statements)


def rates(count: int) -> tuple[float, float, float]:
    """Return the milliseconds of a new advertisement, a renewed one and a query, over so many names."""
    topics = [LAB.subject(Metadata({"kind": "topic", "name": f"/t{number}", "type": "a/B"})) for number in range(count)]
    fresh, renewed = (
        [relay(advertisement(subject=each, chain=[adcert(subject=each)], sequence=turn)) for each in topics]
        for turn in (1, 2)
    )
    queries = [Query(each.name, 0.0).to_wire(SWITCH.name, SWITCH.key, SWITCH.membership) for each in topics]
    core = rib()

    def receive(statement: bytes) -> None:
        core.receive(statement, SWITCH.name, START)
        if not core.statements_to_send():
            raise SystemExit("the RIB did not answer")

    return _ms_each(receive, fresh), _ms_each(receive, renewed), _ms_each(receive, queries)


def main() -> int:
    """Print the medians and ranges of the rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500, help="names (500)")
    parser.add_argument("--rounds", type=int, default=5, help="runs, of which the median counts (5)")
    parser.add_argument("--real", action="store_true", help="sign and verify by ECDSA")
    options = parser.parse_args()
    with nullcontext() if options.real else signing_oracle():
        rounds = [rates(options.count) for _ in range(options.rounds)]
    for what, values in zip(("new advertisement", "renewed", "query"), zip(*rounds, strict=True), strict=True):
        print(f"{what:20}{median(values):7.3f} ms ({min(values):.3f}-{max(values):.3f})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
