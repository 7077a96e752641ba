"""Bench of advertisement verification: advertisements that one core verifies in a second.

Benchmark in one process, without a network.
Each advertisement is for another name, so the verifier has seen none of its own signatures. Four workloads::

    new        a new AdCert each, one owner: two signature checks       the wanted figure: at least 2,000/s
    owners     a new AdCert and another owner each: two checks and a key to decompress
    chain      two new AdCerts each (owner, gateway, proxy): three checks
    refresh    AdCerts known, a new sequence number: one check

Example:
    python scripts/bench/advertisement_verify.py --advertisements 2000 --json /tmp/verify.json
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from typing import Final

from domain import BenchDomain
from report import Rounds
from skeleton import Options, Outcome, command_line, run_bench

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.host.run_registry import RunRegistry
from gdp.trust.adcert import AdCert
from gdp.trust.right import Right
from gdp.trust.verifier import AdvertisementVerifier

TARGET_PER_S: Final = 2_000
RUNS: Final = 5
PROXIES: Final = 20
CASE: Final = "advertisements verified in a second of one core"
RATE: Final = "advertisements/s"
RIGHTS: Final = [Right.PUBLISH]


def advertisements(
    domain: BenchDomain, count: int, *, owners: bool = False, links: int = 1, sequences: int = 1
) -> list[list[bytes]]:
    """Return ``sequences`` lists of advertisements of the same ``count`` names, each newer than the list before."""
    rounds: list[list[bytes]] = [[] for _ in range(sequences)]
    gateway, validity = domain.proxies[0], domain.validity
    for number in range(count):
        key = SigningKey.generate() if owners else domain.owner
        subject, proxy = domain.subject(number, key), domain.proxy_of(number).subject
        first = proxy if links == 1 else gateway.subject
        chain = [AdCert.make(key, subject.name, subject, first, RIGHTS, validity, may_delegate=links > 1)]
        if links > 1:
            chain.append(AdCert.make(gateway.key, gateway.name, subject, proxy, RIGHTS, validity))
        for sequence, wires in enumerate(rounds):
            incarnation = secrets.randbits(64)
            wires.append(
                domain.advertisement(number, sequence=sequence, incarnation=incarnation, subject=subject, chain=chain)
            )
    return rounds


def new_verifier(domain: BenchDomain) -> AdvertisementVerifier:
    """Return a verifier with empty caches, in a process that has not yet decompressed a key."""
    PublicKey.from_compressed.cache_clear()
    return domain.verifier()


def rate(verifier: AdvertisementVerifier, wires: Sequence[bytes], unix_s: float) -> float:
    """Return the advertisements verified in a second of CPU time."""
    begun_s = time.process_time()
    for wire in wires:
        verifier.verify(wire, unix_s)
    return len(wires) / (time.process_time() - begun_s)


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure all workloads."""
    del runs
    unix_s, over = time.time(), Rounds()
    domain, count = BenchDomain(unix_s, PROXIES), options.advertisements

    def add(workload: str, wire: bytes, figure: Callable[[], float]) -> None:
        for _ in range(RUNS):
            over.add(workload, CASE, RATE, figure())
        over.add(workload, CASE, "bytes", len(wire))

    for workload, owners, links in (("new", False, 1), ("owners", True, 1), ("chain", False, 2)):
        (wires,) = advertisements(domain, count, owners=owners, links=links)
        add(workload, wires[0], lambda wires=wires: rate(new_verifier(domain), wires, unix_s))  # type: ignore[misc]
    first, *refreshed = advertisements(domain, count, sequences=RUNS + 1)
    verifier = new_verifier(domain)
    rate(verifier, first, unix_s)
    rounds = iter(refreshed)
    add("refresh", first[0], lambda: rate(verifier, next(rounds), unix_s))
    target = over.target("new, advertisements/s", "new", CASE, RATE, TARGET_PER_S)
    settings = {"advertisements": count, "runs": RUNS}
    return Outcome("advertisement_verify", "Verification", over, [target], settings, is_whole=False)


if __name__ == "__main__":
    parser = command_line(__doc__, has_record=True)
    parser.add_argument("--advertisements", type=int, default=2_000, help="in each run (default: %(default)s)")
    run_bench(parser, measure)
