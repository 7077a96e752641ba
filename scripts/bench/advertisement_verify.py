"""Bench of advertisement verification: advertisements that one core verifies in a second.

Benchmark in one process, without a network.
Each advertisement is for another name, so the verifier has seen none of its own signatures. Four workloads::

    new        a new AdCert each, one owner: two signature checks       the wanted figure: at least 2,000/s
    owners     a new AdCert and another owner each: two checks and a key to decompress
    chain      two new AdCerts each (owner, gateway, proxy): three checks
    refresh    AdCerts known, a new sequence number: one check

Example:
    python scripts/bench/advertisement_verify.py --advertisements 2000 --json verify.json
"""

from __future__ import annotations

import argparse
import json
import platform
import secrets
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.metadata import Metadata
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import sign_advertisement
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from gdp.trust.verifier import AdvertisementVerifier

TARGET_PER_S = 2_000
RUNS = 5
PROXIES = 20


class Field:
    """A domain with a switch and some proxies that sign the advertisements."""

    def __init__(self, unix_s: float) -> None:
        self.unix_s = unix_s
        self.validity = Validity.lasting(unix_s, 3_600)
        self.authority = CertificateAuthority.create("bench", SigningKey.generate(), self.validity)
        self.switch = self._node(Role.SWITCH, "switch")
        self.proxies = [self._node(Role.PROXY, f"proxy{i}") for i in range(PROXIES)]
        self.rtcerts = [RtCert.make(proxy, self.switch.name, self.validity) for proxy in self.proxies]

    def verifier(self) -> AdvertisementVerifier:
        """Return a verifier with empty caches, in a process that has not yet decompressed a key."""
        PublicKey.from_compressed.cache_clear()
        return AdvertisementVerifier(Policy(self.authority.root))

    def advertisements(
        self, count: int, *, owners: bool = False, links: int = 1, sequences: int = 1
    ) -> list[list[bytes]]:
        """Return ``sequences`` lists of advertisements on the same ``count`` names, each newer than the list before."""
        owner = SigningKey.generate()
        gateway = self.proxies[0]
        rounds: list[list[bytes]] = [[] for _ in range(sequences)]
        for i in range(count):
            key = SigningKey.generate() if owners else owner
            subject = Subject.of(Metadata({"kind": "topic", "name": f"/bench/{i}"}), key.public.compressed)
            at = i % PROXIES
            chain = self._chain(key, subject, gateway, self.proxies[at], links)
            for sequence, wires in enumerate(rounds):
                wires.append(self._advertisement(at, subject, chain, sequence))
        return rounds

    def _node(self, role: Role, label: str) -> Identity:
        return NodeKeys.generate(role, label).join(self.authority, self.validity)

    def _chain(self, key: SigningKey, subject: Subject, gateway: Identity, proxy: Identity, links: int) -> list[bytes]:
        rights = [Right.PUBLISH]
        if links == 1:
            return [AdCert.make(key, subject.name, subject, proxy.subject, rights, self.validity)]
        return [
            AdCert.make(key, subject.name, subject, gateway.subject, rights, self.validity, may_delegate=True),
            AdCert.make(gateway.key, gateway.name, subject, proxy.subject, rights, self.validity),
        ]

    def _advertisement(self, at: int, subject: Subject, chain: Sequence[bytes], sequence: int) -> bytes:
        return sign_advertisement(
            self.proxies[at],
            Right.PUBLISH,
            subject,
            rtcert=self.rtcerts[at],
            sequence=sequence,
            incarnation=secrets.randbits(64),
            lease_s=60.0,
            is_global=True,
            chain=chain,
        )


def rate(verifier: AdvertisementVerifier, wires: Sequence[bytes], unix_s: float) -> float:
    """Return the advertisements verified in a second of CPU time."""
    begin = time.process_time()
    for wire in wires:
        verifier.verify(wire, unix_s)
    return len(wires) / (time.process_time() - begin)


def fresh_rate(field: Field, wires: Sequence[bytes]) -> float:
    """Return the rate of a verifier with empty caches."""
    return rate(field.verifier(), wires, field.unix_s)


def median_of(measure: Callable[[], float]) -> dict[str, float]:
    """Return median, lowest and highest of several runs."""
    rates = [measure() for _ in range(RUNS)]
    return {"median": statistics.median(rates), "lowest": min(rates), "highest": max(rates)}


def run(count: int) -> dict[str, dict[str, float]]:
    """Measure all workloads."""
    field = Field(time.time())
    results: dict[str, dict[str, float]] = {}
    for name, owners, links in (("new", False, 1), ("owners", True, 1), ("chain", False, 2)):
        (wires,) = field.advertisements(count, owners=owners, links=links)
        results[name] = median_of(partial(fresh_rate, field, wires))
        results[name]["bytes"] = len(wires[0])
    first, *refreshed = field.advertisements(count, sequences=RUNS + 1)
    verifier = field.verifier()
    rate(verifier, first, field.unix_s)
    rounds = iter(refreshed)
    results["refresh"] = median_of(lambda: rate(verifier, next(rounds), field.unix_s))
    results["refresh"]["bytes"] = len(first[0])
    return results


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--advertisements", type=int, default=2_000, help="advertisements in each run")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    options = parser.parse_args()
    results = run(options.advertisements)
    table = Table(title=f"claims verified per second of one core, median of {RUNS} (target {TARGET_PER_S}, 'new')")
    for column in ("workload", "median", "lowest", "highest", "bytes"):
        table.add_column(column, justify="left" if column == "workload" else "right")
    for name, figures in results.items():
        table.add_row(name, *(f"{figures[each]:,.0f}" for each in ("median", "lowest", "highest", "bytes")))
    Console().print(table)
    if options.json is not None:
        settings = {"claims": options.advertisements, "runs": RUNS, "python": platform.python_version()}
        options.json.write_text(json.dumps({"settings": settings, "claims_per_s": results}, indent=2) + "\n")


if __name__ == "__main__":
    main()
