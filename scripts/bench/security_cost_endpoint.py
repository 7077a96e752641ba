"""Cost of a message and of an advertisement in one tree: a process of ``security_cost.py``.

The tree is the one that ``PYTHONPATH`` names, this one or an earlier commit. Its first line lists, in JSON, the names
of its measurements. For each name on standard input it measures once and prints the figure: processor time of this
process. A message is sealed in parts for an MTU of 1,500 bytes and signed; opened, part by part, and a signature
verified.
"""

from __future__ import annotations

import json
import secrets
import sys
import time
from collections.abc import Callable, Iterable
from itertools import count, islice
from typing import Final

import rib_load

from gdp.crypto.envelope import Opener, Sealer
from gdp.crypto.keys import SigningKey
from gdp.frame.codec import decode
from gdp.frame.kinds import Kind
from gdp.nodes import membership

SIZES: Final = (100, 10_000)
_MTU: Final = 1_500
_MESSAGES: Final = 100
_ADVERTISEMENTS: Final = 200


def mean_us(work: Callable[[int], object], numbers: Iterable[int]) -> float:
    """Return the microseconds of one call."""
    turns = list(numbers)
    begun_ns = time.process_time_ns()
    for number in turns:
        work(number)
    return (time.process_time_ns() - begun_ns) / 1e3 / len(turns)


def of_messages(size: int) -> dict[str, Callable[[], float]]:
    """Return the measurements of sealing and opening."""
    secret, source, topic, key = secrets.token_bytes(32), bytes(32), bytes(range(32)), SigningKey.generate()
    sealer = Sealer(
        secret=secret,
        epoch=1,
        kind=Kind.DATA,
        source=source,
        incarnation=1,
        destination=topic,
        signer=key,
        random_bytes=membership.fresh_bytes,
    )
    opener, public, message = Opener(secret, Kind.DATA, source, 1, topic), key.public, secrets.token_bytes(size)
    numbers, digest = count(1), secrets.token_bytes(32)
    signature = key.sign_digest(digest)  # the cost to verify one is the same for all

    def seal(number: int) -> list[bytes]:
        return sealer.seal(number, 0, message, _MTU)[:]

    sealed = [seal(number) for number in islice(numbers, _MESSAGES)]

    def unseal(at: int) -> None:
        for frame in sealed[at]:
            opener.open(decode(frame), frame)
        public.verify_digest(signature, digest)

    return {
        f"seal {size:,} B, us": lambda: mean_us(seal, islice(numbers, _MESSAGES)),
        f"open {size:,} B, us": lambda: mean_us(unseal, range(_MESSAGES)),
    }


def main() -> None:
    """Measure the requested figures."""
    measures = {name: measure for size in SIZES for name, measure in of_messages(size).items()}
    measures["advertisements/s"] = lambda: rib_load.measure(_ADVERTISEMENTS).advertisements_per_s
    print(json.dumps(list(measures)), flush=True)
    for line in sys.stdin:
        print(measures[line.rstrip("\n")](), flush=True)


if __name__ == "__main__":
    main()
