"""Servers of a cluster, and two RIBs that share it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gdp.config.config import ClusterConfig
from gdp.rib.outbox import OutgoingStatement
from gdp.trust.verifier import AdvertisementVerifier
from gdp_extensions.cluster.link import ClusterLink
from gdp_extensions.cluster.store import ClusterStore, load_functions
from tests.gdp.stores.sites import Pair, Site

START_CLUSTER = Path(__file__).parents[3] / "scripts" / "start_cluster.sh"


class ClusterPair(Pair):
    """Two RIBs that share a cluster."""

    def __init__(self, site: Site, config: ClusterConfig) -> None:
        self.links = [ClusterLink(config) for _ in range(2)]
        load_functions(self.links[0])
        self.stores = [ClusterStore(link, AdvertisementVerifier(site.policy())) for link in self.links]
        super().__init__(site, (self.stores[0], self.stores[1]))
        for store in self.stores:
            store.changed()  # begin to listen
        self._begun_s = time.monotonic()

    def sync(self, later_s: float = 0.0) -> list[OutgoingStatement]:
        select.select([self.links[1]], [], [], 5.0)
        self.two.changed(self.stores[1].changed(), self.site.now(later_s))
        return self.take(self.two)

    def wait_until(self, later_s: float) -> None:
        time.sleep(max(self._begun_s + later_s - time.monotonic(), 0.0))

    def close(self) -> None:
        for link in self.links:
            link.close()


@contextmanager
def cluster(folder: Path) -> Iterator[Path]:
    """Run six servers; yield the file with their addresses."""
    started = subprocess.run([START_CLUSTER, folder], capture_output=True, text=True, check=False, timeout=120)
    try:
        assert started.returncode == 0, started.stderr
        yield Path(started.stdout.strip())
    finally:
        subprocess.run([START_CLUSTER, "--stop", folder], check=True, timeout=60)


def kill_server(folder: Path, port: int) -> None:
    """Kill the server that listens on a port."""
    os.kill(_pid_of_server(folder, port), signal.SIGKILL)


@contextmanager
def frozen_server(folder: Path, port: int) -> Iterator[None]:
    """Stop the server that listens on a port for this time."""
    pid = _pid_of_server(folder, port)
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def _pid_of_server(folder: Path, port: int) -> int:
    for conf in folder.glob("*/server.conf"):
        if f"tls-port {port}\n" in conf.read_text():
            return int((conf.parent / "server.pid").read_text())
    raise AssertionError(f"no server on port {port}")
