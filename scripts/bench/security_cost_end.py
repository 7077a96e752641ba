"""What one tree takes for a message and for an advertisement: a process of ``security_cost.py``, one line of JSON.

The tree is the one that ``PYTHONPATH`` names, this one or an earlier commit. Times are processor time of this process,
the least of a few blocks, so that what else runs on the machine shows little. A message is sealed in parts for an MTU
of 1,500 bytes and signed; opened, part by part, and its signature verified.
"""

from __future__ import annotations

import inspect
import json
import secrets
import sys
import time
from collections.abc import Callable, Iterable
from typing import Final

import rib_load

from gdp.crypto.envelope import Opener, Sealer
from gdp.crypto.keys import SigningKey
from gdp.frame.codec import decode
from gdp.frame.kinds import Kind
from gdp.nodes import membership

__all__: list[str] = []

SIZES: Final = (100, 10_000)
_MTU: Final = 1_500
_BLOCKS: Final = 7
_MESSAGES: Final = 300  # in a block


def least_us(work: Callable[[int], None], turns: Iterable[int]) -> float:
    """Return the microseconds of one call, in the best of the blocks that ``turns`` is cut into."""
    numbers, took_us = list(turns), []
    for at in range(0, len(numbers), _MESSAGES):
        block = numbers[at : at + _MESSAGES]
        begun_ns = time.process_time_ns()
        for number in block:
            work(number)
        took_us.append((time.process_time_ns() - begun_ns) / 1e3 / len(block))
    return min(took_us)


def of_messages(size: int) -> dict[str, float]:
    """Return what it takes to seal and to open one."""
    secret, source, topic, key = secrets.token_bytes(32), bytes(32), bytes(range(32)), SigningKey.generate()
    is_salted = "random_bytes" in inspect.signature(Sealer).parameters  # not before messages had salts
    salts = (membership.fresh_bytes,) if is_salted else ()
    sealer = Sealer(secret, 1, Kind.DATA, source, 1, topic, key, *salts)
    opener, public, message = Opener(secret, Kind.DATA, source, 1, topic), key.public, secrets.token_bytes(size)
    sealed: dict[int, list[bytes]] = {}
    digest = secrets.token_bytes(32)  # what it takes to verify one is the same for all
    signature = key.sign_digest(digest)

    def seal(number: int) -> None:
        sealed[number] = sealer.seal(number, 0, message, _MTU)[:]

    def unseal(number: int) -> None:
        for frame in sealed[number]:
            opener.open(decode(frame), frame)
        public.verify_digest(signature, digest)

    numbers = range(1, _BLOCKS * _MESSAGES + 1)
    return {
        f"seal {size:,} B, us": least_us(seal, numbers),
        f"open {size:,} B, us": least_us(unseal, numbers),
    }


def main() -> None:
    """Measure, and print; the first argument is a number of advertisements."""
    found = {key: value for size in SIZES for key, value in of_messages(size).items()}
    found["advertisements/s"] = rib_load.measure(int(sys.argv[1])).advertisements_per_s
    print(json.dumps(found))


if __name__ == "__main__":
    main()
