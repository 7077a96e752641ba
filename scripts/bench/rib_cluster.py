"""Cost of a name in a cluster that RIBs share: bytes, lookup time, and the gap after the death of a primary.

The cluster is ``scripts/start_cluster.sh``'s: three primaries with a replica each, TLS, on this machine. Every name has
an AdCert and an advertisement of its own, as a RIB would have accepted them. A lookup is the work of a RIB for a name
that is not in its memory: one round trip, and every signature verified. Then primaries are killed, one after the other.
Each row of ``gap`` is the time from the kill until a name of that primary can be read and written again.

    .venv/bin/python scripts/bench/rib_cluster.py                        # 1,000,000 names; about a quarter of an hour
    .venv/bin/python scripts/bench/rib_cluster.py --names 50000 --no-save
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

import yaml
from machine import machine_state
from report import percentile, progress
from rich.console import Console
from rich.table import Table

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import GdpError, LocalError, StoreError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.nodes.config import ClusterConfig
from gdp.rib.route import Route
from gdp.sansio import Timestamps
from gdp.stores.cluster import ClusterStore, load_functions
from gdp.stores.cluster_link import ClusterLink
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import Advertisement, sign_advertisement
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from gdp.trust.verifier import AdvertisementVerifier

ROOT: Final = Path(__file__).resolve().parents[2]
OUTPUT: Final = ROOT / "docs" / "benchmarks" / "rib_cluster.json"
START_CLUSTER: Final = ROOT / "scripts" / "start_cluster.sh"
NAMES: Final = 1_000_000
LOOKUPS: Final = 5_000
BATCH: Final = 256
LEASE_S: Final = 3_600.0
PATIENCE_S: Final = 30.0
LOOK_S: Final = 0.01
BYTES_GOAL, LOOKUP_GOAL_MS, GAP_GOAL_S = 1_000, 2.0, 2.0


@dataclass
class Measured:
    """Result of a run.

    Attributes:
        bytes_a_name: growth of the primaries' memory.
        lookup_ms: one figure a lookup.
        warm_ms: the same for a name that is in the RIB's memory.
        gap_s: one figure a killed primary.
        gone: names that were there and could not be read after the last kill.
    """

    names: int
    fill_s: float = 0.0
    bytes_a_name: float = 0.0
    lookup_ms: list[float] = field(default_factory=list)
    warm_ms: list[float] = field(default_factory=list)
    gap_s: list[float] = field(default_factory=list)
    gone: int = 0


class Field:
    """A domain whose owner lets one proxy publish any number of names."""

    def __init__(self) -> None:
        self.validity = Validity.lasting(time.time(), 86_400)
        self.authority = CertificateAuthority.create("bench", SigningKey.generate(), self.validity)
        self.switch, self.proxy = self._node(Role.SWITCH, "s"), self._node(Role.PROXY, "p")
        self.owner = SigningKey.generate()
        self.rtcert = RtCert.make(self.proxy, self.switch.name, self.validity)

    def _node(self, role: Role, label: str) -> Identity:
        return NodeKeys.generate(role, label).join(self.authority, self.validity)

    def verifier(self) -> AdvertisementVerifier:
        """Return a new verifier that trusts the domain."""
        return AdvertisementVerifier(Policy(self.authority.root))

    def about(self, number: int) -> Subject:
        """Return the subject of the name with this number."""
        return Subject.of(Metadata({"kind": "topic", "name": f"/topic/{number}"}), self.owner.public.compressed)

    def name(self, number: int) -> Name:
        """Return the name with this number."""
        return self.about(number).name

    def advertisement(self, number: int, sequence: int = 1) -> bytes:
        """Return a signed advertisement of the name with this number."""
        about = self.about(number)
        adcert = AdCert.make(
            self.owner, about.name, about, self.proxy.subject, {Right.PUBLISH}, self.validity, may_delegate=False
        )
        return sign_advertisement(
            self.proxy, Right.PUBLISH, about,
            rtcert=self.rtcert, sequence=sequence, incarnation=1, lease_s=LEASE_S, is_global=False, chain=(adcert,),
        )  # fmt: skip

    def route(self, advertisement: Advertisement, now: Timestamps) -> Route:
        """Return the route that a RIB makes of an advertisement."""
        domain = self.authority.root.domain
        expires_s = now.mono_s + LEASE_S
        return Route.of(
            advertisement, sender=self.switch.name, domain=domain, via=domain, transit=(), expires_s=expires_s
        )


def now() -> Timestamps:
    """Return this process's monotonic and wall-clock time."""
    return Timestamps(time.monotonic(), time.time())


def put(store: ClusterStore, field_: Field, numbers: range, sequence: int = 1) -> None:
    """Write names as a RIB does after verification.

    Raises:
        LocalError: the cluster rejected some.
    """
    verifier, at = field_.verifier(), now()
    store.prefetch([field_.name(number) for number in numbers], at)
    for number in numbers:
        store.put(field_.route(verifier.verify(field_.advertisement(number, sequence), at.unix_s), at))
    if refused := store.commit():
        raise LocalError(f"the cluster did not take {len(refused)} of {len(numbers)} names")


def fill(config: ClusterConfig, field_: Field, numbers: range) -> None:
    """Write many names, from a process of its own."""
    link = ClusterLink(config.address())
    store = ClusterStore(link, field_.verifier())
    for first in range(numbers.start, numbers.stop, BATCH):
        put(store, field_, range(first, min(first + BATCH, numbers.stop)))
    link.close()


def used_bytes(folder: Path, config: ClusterConfig) -> int:
    """Return the memory that the primaries use, in bytes; only the operator may query it."""
    asking = config.model_copy(update={"username": "admin", "password_file": folder / "admin.password"})
    link = ClusterLink(asking.address())
    used = sum(client.info("memory")["used_memory"] for client in link.primaries())
    link.close()
    return int(used)


def look_up(store: ClusterStore, name: Name) -> float:
    """Return the seconds that a lookup takes.

    Raises:
        LocalError: the name is missing.
    """
    begun_s = time.perf_counter()
    store.prefetch([name], now())
    routes = store.routes(name)
    took_s = time.perf_counter() - begun_s
    if len(routes) != 1:
        raise LocalError(f"{name.short} has {len(routes)} routes, not 1")
    return took_s


def kill(folder: Path, port: int) -> None:
    """Kill the server that listens on a port.

    Raises:
        LocalError: there is none.
    """
    for conf in folder.glob("*/server.conf"):
        if f"tls-port {port}\n" in conf.read_text():
            os.kill(int((conf.parent / "server.pid").read_text()), signal.SIGKILL)
            return
    raise LocalError(f"no server on port {port}")


def one_of_each_shard(config: ClusterConfig, field_: Field, names: int, dice: random.Random) -> list[int]:
    """Return a name of each primary: a shard has one replica, so it can lose one primary."""
    link, found = ClusterLink(config.address()), dict[tuple[str, int], int]()
    for number in dice.sample(range(names), min(names, 200)):
        found.setdefault(link.primary_of(field_.name(number)), number)
    link.close()
    return list(found.values())


def gap_after_death(folder: Path, config: ClusterConfig, field_: Field, number: int) -> float:
    """Kill the primary of a name and return the seconds until the name is read and written again."""
    link = ClusterLink(config.address())
    victim = link.primary_of(field_.name(number))
    kill(folder, victim[1])
    begun_s = time.monotonic()
    sequence = 1 + int(time.time() * 1_000)
    while time.monotonic() - begun_s < PATIENCE_S:
        try:
            store = ClusterStore(link, field_.verifier())  # the new RIB has nothing in memory
            look_up(store, field_.name(number))
            put(store, field_, range(number, number + 1), sequence)
            break
        except (StoreError, LocalError):
            time.sleep(LOOK_S)
    else:
        raise LocalError(f"no replica took over within {PATIENCE_S:g} s")
    took_s = time.monotonic() - begun_s
    link.close()
    return took_s


def measure(folder: Path, names: int, lookups: int, kills: int) -> Measured:
    """Fill a cluster, and measure."""
    said = subprocess.run([START_CLUSTER, folder], capture_output=True, text=True, check=False)
    if said.returncode:
        raise LocalError(said.stderr.strip())
    values = yaml.safe_load(Path(said.stdout.strip()).read_text())["store"]["cluster"]
    paths = {key: Path(values[key]) for key in ("password_file", "ca")}
    config = ClusterConfig(**{**values, "nodes": tuple(values["nodes"]), **paths})
    link = ClusterLink(config.address())
    load_functions(link)
    measured, field_, dice = Measured(names), Field(), random.Random(7)
    before, begun_s = used_bytes(folder, config), time.monotonic()
    half = names // 2
    progress(f"writing {names:,} names")
    workers = [
        multiprocessing.get_context("fork").Process(target=fill, args=(config, field_, numbers))
        for numbers in (range(half), range(half, names))
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    if any(worker.exitcode for worker in workers):
        raise LocalError("a process that wrote names failed; its last lines are above")
    measured.fill_s = time.monotonic() - begun_s
    measured.bytes_a_name = (used_bytes(folder, config) - before) / names
    progress(f"looking up {lookups:,} of them")
    store = ClusterStore(link, field_.verifier())
    gc.collect()
    for number in dice.sample(range(names), lookups):
        measured.lookup_ms.append(1_000 * look_up(store, field_.name(number)))
        measured.warm_ms.append(1_000 * look_up(store, field_.name(number)))
    link.close()
    for at, number in enumerate(one_of_each_shard(config, field_, names, dice)[:kills], 1):
        progress(f"killing primary {at} of {kills}")
        measured.gap_s.append(gap_after_death(folder, config, field_, number))
    link = ClusterLink(config.address())
    store = ClusterStore(link, field_.verifier())
    for number in dice.sample(range(names), lookups):
        try:
            look_up(store, field_.name(number))
        except (LocalError, StoreError):
            measured.gone += 1
    link.close()
    return measured


def summary(measured: Measured) -> dict[str, object]:
    """Return the record for the disk: percentiles in place of thousands of figures."""
    figures = {"lookup_ms": measured.lookup_ms, "warm_ms": measured.warm_ms}
    shares = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    of = {key: {label: percentile(each, share) for label, share in shares.items()} for key, each in figures.items()}
    return {**asdict(measured), **of, "lookups": len(measured.lookup_ms)}


def table(measured: Measured) -> Table:
    """Return the table to print."""
    shown = Table("what", "to reach", "got")
    shown.add_row(f"bytes a name, of {measured.names:,}", f"≤ {BYTES_GOAL:,}", f"{measured.bytes_a_name:,.0f}")
    for label, figures in (("lookup", measured.lookup_ms), ("lookup, in the RIB's memory", measured.warm_ms)):
        p50, p99 = percentile(figures, 0.5), percentile(figures, 0.99)
        shown.add_row(f"{label}, p50 / p99", f"p99 ≤ {LOOKUP_GOAL_MS:g} ms", f"{p50:.2f} / {p99:.2f} ms")
    gaps = ", ".join(f"{gap:.2f}" for gap in measured.gap_s)
    shown.add_row("primary killed, until its names are served", f"≤ {GAP_GOAL_S:g} s", f"{gaps} s")
    shown.add_row("names gone after that", "0", f"{measured.gone} of {len(measured.lookup_ms):,}")
    shown.add_row("written", "", f"{measured.names / measured.fill_s:,.0f}/s")
    return shown


def main() -> int:
    """Run the bench; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", type=int, default=NAMES)
    parser.add_argument("--lookups", type=int, default=LOOKUPS)
    parser.add_argument("--kills", type=int, default=2, help="primaries to kill, one after the other")
    parser.add_argument("--no-save", action="store_true", help=f"do not write {OUTPUT.name}")
    options = parser.parse_args()
    console, state = Console(stderr=True), machine_state()
    with tempfile.TemporaryDirectory(prefix="gdp-rib-cluster-") as made:
        folder = Path(made)
        try:
            measured = measure(folder, options.names, min(options.lookups, options.names), options.kills)
        except GdpError as error:
            console.print(f"error: {error}")
            return 1
        finally:
            subprocess.run([START_CLUSTER, "--stop", folder], check=False)
    Console().print(table(measured))
    if not options.no_save:
        OUTPUT.write_text(json.dumps({"machine": asdict(state), **summary(measured)}, indent=1) + "\n")
    return 0 if measured.gone == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
