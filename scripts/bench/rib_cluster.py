"""Cost of a name in a cluster that RIBs share: bytes, lookup time, and the gap after the death of a primary.

The cluster is ``scripts/start_cluster.sh``'s: three primaries with a replica each, TLS, on this machine. Every name has
an AdCert and an advertisement of its own, as a RIB would have accepted them. A lookup is the work of a RIB for a name
that is not in its memory: one round trip, and every signature verified. Then primaries are killed, one after the other.
Each row of ``gap`` is the time from the kill until a name of that primary can be read and written again.

    .venv/bin/python scripts/bench/rib_cluster.py                        # 1,000,000 names; about a quarter of an hour
    .venv/bin/python scripts/bench/rib_cluster.py --names 50000 --no-save
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import yaml
from domain import BenchDomain
from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.config.config import ClusterConfig
from gdp.errors import LocalError, StoreError
from gdp.host.run_registry import RunRegistry
from gdp.names import Name
from gdp.rib.route import Route
from gdp.sansio import Timestamps
from gdp.stores.cluster import ClusterStore, load_functions
from gdp.stores.cluster_link import ClusterLink

START_CLUSTER: Final = Path(__file__).resolve().parents[1] / "start_cluster.sh"
NAMES: Final = 1_000_000
LOOKUPS: Final = 5_000
BATCH: Final = 256
LEASE_S: Final = 3_600.0
PATIENCE_S: Final = 30.0
LOOK_S: Final = 0.01
WHO: Final = "cluster"
BYTES, FILL, GAP, LOST = (
    "bytes a name",
    "names written/s",
    "primary killed, until its names are served, s",
    "names lost",
)
LOOKUP, WARM = "lookup", "lookup in the RIB's memory"
BYTES_GOAL, LOOKUP_GOAL_MS, GAP_GOAL_S = 1_000, 2.0, 2.0


def now() -> Timestamps:
    """Return this process's monotonic and wall-clock time."""
    return Timestamps(time.monotonic(), time.time())


def put(store: ClusterStore, domain: BenchDomain, numbers: range, sequence: int = 1) -> None:
    """Write names as a RIB does after verification.

    Raises:
        LocalError: the cluster rejected some.
    """
    verifier, at = domain.verifier(), now()
    store.prefetch([domain.subject(number).name for number in numbers], at)
    for number in numbers:
        wire = domain.advertisement(number, sequence=sequence, lease_s=LEASE_S)
        own, expires_s = domain.authority.root.domain, at.mono_s + LEASE_S
        advertisement = verifier.verify(wire, at.unix_s)
        store.put(
            Route.of(advertisement, sender=domain.switch.name, domain=own, via=own, transit=(), expires_s=expires_s)
        )
    if refused := store.commit():
        raise LocalError(f"the cluster did not take {len(refused)} of {len(numbers)} names")


def fill(config: ClusterConfig, domain: BenchDomain, numbers: range) -> None:
    """Write many names, from a process of its own."""
    link = ClusterLink(config.address())
    store = ClusterStore(link, domain.verifier())
    for first in range(numbers.start, numbers.stop, BATCH):
        put(store, domain, range(first, min(first + BATCH, numbers.stop)))
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


def one_of_each_shard(config: ClusterConfig, domain: BenchDomain, names: int, dice: random.Random) -> list[int]:
    """Return a name of each primary: a shard has one replica, so it can lose one primary."""
    link, found = ClusterLink(config.address()), dict[tuple[str, int], int]()
    for number in dice.sample(range(names), min(names, 200)):
        found.setdefault(link.primary_of(domain.subject(number).name), number)
    link.close()
    return list(found.values())


def gap_after_death(folder: Path, config: ClusterConfig, domain: BenchDomain, number: int) -> float:
    """Kill the primary of a name and return the seconds until the name is read and written again."""
    link = ClusterLink(config.address())
    victim = link.primary_of(domain.subject(number).name)
    kill(folder, victim[1])
    begun_s = time.monotonic()
    sequence = 1 + int(time.time() * 1_000)
    while time.monotonic() - begun_s < PATIENCE_S:
        try:
            store = ClusterStore(link, domain.verifier())  # the new RIB has nothing in memory
            look_up(store, domain.subject(number).name)
            put(store, domain, range(number, number + 1), sequence)
            break
        except (StoreError, LocalError):
            time.sleep(LOOK_S)
    else:
        raise LocalError(f"no replica took over within {PATIENCE_S:g} s")
    took_s = time.monotonic() - begun_s
    link.close()
    return took_s


@contextmanager
def started_cluster() -> Iterator[tuple[Path, ClusterConfig]]:
    """Yield the folder and the configuration of a new cluster; stop it at the end.

    Raises:
        LocalError: it did not start.
    """
    with tempfile.TemporaryDirectory(prefix="gdp-rib-cluster-") as made:
        folder = Path(made)
        try:
            said = subprocess.run([START_CLUSTER, folder], capture_output=True, text=True, check=False)
            if said.returncode:
                raise LocalError(said.stderr.strip())
            values = yaml.safe_load(Path(said.stdout.strip()).read_text())["store"]["cluster"]
            paths = {key: Path(values[key]) for key in ("password_file", "ca")}
            yield folder, ClusterConfig(**{**values, "nodes": tuple(values["nodes"]), **paths})
        finally:
            subprocess.run([START_CLUSTER, "--stop", folder], check=False)


def filled(folder: Path, config: ClusterConfig, domain: BenchDomain, names: int, case: str, over: Rounds) -> None:
    """Write the names from two processes, and add the cost.

    Raises:
        LocalError: a process failed.
    """
    before, begun_s, half = used_bytes(folder, config), time.monotonic(), names // 2
    progress(f"writing {names:,} names")
    workers = [
        multiprocessing.get_context("fork").Process(target=fill, args=(config, domain, numbers))
        for numbers in (range(half), range(half, names))
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    if any(worker.exitcode for worker in workers):
        raise LocalError("a process that wrote names failed; its last lines are above")
    over.add(WHO, case, FILL, names / (time.monotonic() - begun_s))
    over.add(WHO, case, BYTES, (used_bytes(folder, config) - before) / names)


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Fill a cluster, look names up, kill primaries, and count the names that are lost."""
    del runs
    names, lookups = options.names, min(options.lookups, options.names)
    over, case, domain, dice = Rounds(), f"{names:,} names", BenchDomain(time.time()), random.Random(7)
    with started_cluster() as (folder, config):
        link = ClusterLink(config.address())
        load_functions(link)
        filled(folder, config, domain, names, case, over)
        progress(f"looking up {lookups:,} of them")
        store = ClusterStore(link, domain.verifier())
        gc.collect()
        took_ms: dict[str, list[float]] = {LOOKUP: [], WARM: []}
        for number in dice.sample(range(names), lookups):
            for times in took_ms.values():
                times.append(1_000 * look_up(store, domain.subject(number).name))
        link.close()
        for what, times in took_ms.items():
            for label, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0)):
                over.add(WHO, case, f"{what}, {label}, ms", percentile(times, share))
        for at, number in enumerate(one_of_each_shard(config, domain, names, dice)[: options.kills], 1):
            progress(f"killing primary {at} of {options.kills}")
            over.add(WHO, case, GAP, gap_after_death(folder, config, domain, number))
        link = ClusterLink(config.address())
        store, lost = ClusterStore(link, domain.verifier()), 0
        for number in dice.sample(range(names), lookups):
            try:
                look_up(store, domain.subject(number).name)
            except (LocalError, StoreError):
                lost += 1
        link.close()
        over.add(WHO, case, LOST, lost)
    targets = [
        over.target(column, WHO, case, column, goal, at_most=True)
        for column, goal in ((BYTES, BYTES_GOAL), (f"{LOOKUP}, p99, ms", LOOKUP_GOAL_MS), (GAP, GAP_GOAL_S), (LOST, 0))
    ]
    settings = {"names": names, "lookups": lookups, "primaries killed": options.kills}
    return Outcome("rib_cluster", "A cluster that RIBs share", over, targets, settings, has_failed=lost > 0)


if __name__ == "__main__":
    parser = command_line(__doc__, has_record=True)
    parser.add_argument("--names", type=int, default=NAMES, help="(default: %(default)s)")
    parser.add_argument("--lookups", type=int, default=LOOKUPS, help="(default: %(default)s)")
    parser.add_argument("--kills", type=int, default=2, help="primaries to kill, one after the other")
    run_bench(parser, measure)
