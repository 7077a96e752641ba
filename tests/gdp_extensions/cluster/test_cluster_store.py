"""Store in a cluster: the promises of every store, and servers that fail."""

from __future__ import annotations

import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from redis._parsers.base import BaseParser

from gdp.config.config import ClusterConfig
from gdp.errors import DropReason, StoreError
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.sansio import Timestamps
from gdp_extensions.cluster.link import ClusterLink, _translated
from gdp_extensions.cluster.upkeep import ClusterUpkeep
from tests.gdp.stores import test_stores
from tests.gdp.stores.sites import Pair, Site, acks, answers
from tests.gdp_extensions.cluster.servers import START_CLUSTER, ClusterPair, cluster, frozen_server, kill_server

HAS_SERVER = shutil.which("redis-server") or shutil.which("valkey-server")


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    if not HAS_SERVER:
        pytest.skip("neither redis-server nor valkey-server is installed")
    with cluster(tmp_path_factory.mktemp("cluster")) as store:
        yield store


def config_of(store: Path) -> ClusterConfig:
    values = yaml.safe_load(store.read_text())["store"]["cluster"]
    paths = {key: Path(values[key]) for key in ("password_file", "ca")}
    return ClusterConfig(**{**values, "nodes": tuple(values["nodes"]), **paths})


@pytest.fixture
def pair(servers: Path) -> Iterator[Pair]:
    made = ClusterPair(Site(), config_of(servers))
    yield made
    made.close()


class TestCluster(test_stores.TestEveryStore):
    """Promises of every store."""


@pytest.mark.parametrize("ahead_s", [300.0, -300.0])
def test_the_clock_of_one_rib_ends_no_lease_and_prolongs_none(servers: Path, ahead_s: float) -> None:
    pair = ClusterPair(Site(), config_of(servers))
    site = pair.site

    def ask(rib: RibCore, wire: bytes, at: Timestamps) -> list[bool]:
        rib.receive_all([(wire, site.switch.name)], at)
        return [each.is_negative for each in answers(pair.take(rib))]

    wrong = Timestamps(site.now().mono_s, site.unix_s + ahead_s)
    pair.give(pair.one, site.relay("/read", 1))
    assert ask(pair.two, site.query("/read"), wrong) == [False]
    pair.two.receive_all([(site.relay("/written", 1, lease_s=2.0), site.switch.name)], wrong)
    assert [each.refused for each in acks(pair.take(pair.two))] == [None]
    assert ask(pair.one, site.query("/written"), site.now()) == [False]
    pair.wait_until(3.0)
    pair.stores[0]._cache.clear()
    assert ask(pair.one, site.query("/written"), site.now(3.0)) == [True]
    pair.close()


def test_of_two_writes_at_once_the_newer_wins_and_the_other_is_not_confirmed(servers: Path) -> None:
    pair = ClusterPair(Site(), config_of(servers))
    for rib in (pair.one, pair.two):
        pair.give(rib, pair.site.query("/a"))  # both agree that no node advertises it
    assert acks(pair.give(pair.one, pair.site.relay("/a", 9)))[0].refused is None
    assert acks(pair.give(pair.two, pair.site.relay("/a", 8))) == []
    (ack,) = acks(pair.give(pair.two, pair.site.relay("/a", 8)))
    assert (ack.refused, ack.sequence) == (DropReason.STALE, 9)
    pair.close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore:unclosed:ResourceWarning")
def test_a_rib_starts_while_a_primary_is_frozen_and_brings_it_the_functions_later(servers: Path) -> None:
    site, config = Site(), config_of(servers)
    link = ClusterLink(config)
    victim = link.primary_of(site.subject("/a").name)
    link.close()
    with frozen_server(servers.parent, victim[1]):
        upkeep = ClusterUpkeep(config, site.policy(), allow_unowned=False)
        was_complete = upkeep.is_complete
    at = site.now()
    upkeep.start(RibCore(site.ribs[0], site.policy(), upkeep.store, RibSettings()), at)
    deadline_s = time.monotonic() + 60
    while not upkeep.is_complete and time.monotonic() < deadline_s:
        at = Timestamps(at.mono_s + 1.0, at.unix_s + 1.0)
        upkeep.work(at)
        select.select([], [], [], 0.05)  # the servers agree asynchronously on the primary
    assert (was_complete, upkeep.is_complete) == (False, True)
    upkeep.close()


def test_a_rib_brings_its_functions_again_to_servers_that_lost_them(
    servers: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gdp_extensions.cluster.link.PROMPT_S", 30.0)  # a busy server flushes and loads late
    site, config = Site(), config_of(servers)
    upkeep = ClusterUpkeep(config, site.policy(), allow_unowned=False)
    rib = RibCore(site.ribs[0], site.policy(), upkeep.store, RibSettings())
    upkeep.start(rib, site.now())
    password = (servers.parent / "admin.password").read_text().strip()
    for client in (link := ClusterLink(config)).primaries():
        client.execute_command("AUTH", "admin", password)
        client.execute_command("FUNCTION FLUSH")
    for later_s, is_answered in ((0.0, False), (2.0, True)):
        rib.receive_all([(site.query("/a"), site.switch.name)], site.now(later_s))
        assert bool(rib.statements_to_send()) == is_answered
        upkeep.work(site.now(later_s + 1.0))
        assert upkeep.is_complete
    assert "a primary lacks the RIB's functions" in caplog.text
    upkeep.close()
    link.close()


@pytest.mark.parametrize(
    "word",
    ["MOVED 1 10.0.0.1:7000", "ASK 1 10.0.0.1:7000", "CLUSTERDOWN a", "READONLY a", "LOADING a", "TRYAGAIN a"],
)
def test_a_server_that_is_not_the_primary_now_is_no_fault_of_the_rib(word: str) -> None:
    assert isinstance(_translated(BaseParser.parse_error(word)), StoreError)


# redis-py leaves the socket of a TLS handshake that broke off to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore:unclosed:ResourceWarning")
def test_names_outlive_a_primary(servers: Path) -> None:
    config = config_of(servers)
    pair = ClusterPair(Site(), config)
    name = pair.site.subject("/a").name
    pair.give(pair.one, pair.site.relay("/a", 1))
    link = ClusterLink(config)
    primary = link.primary_of(name)
    kill_server(servers.parent, primary[1])
    pair.stores[1]._cache.clear()
    deadline_s = time.monotonic() + 60
    while not (found := answers(pair.give(pair.two, pair.site.query("/a")))) and time.monotonic() < deadline_s:
        time.sleep(0.05)  # the servers promote the replica asynchronously
    assert [each.is_negative for each in found] == [False]
    while not acks(pair.give(pair.one, pair.site.relay("/a", 2))):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    pair.close()
    link.close()


def test_names_outlive_a_restart_of_all_servers(servers: Path) -> None:
    """Valkey issue 3983: where the default user has no rights, servers drop what functions wrote as they read it."""
    site = Site()
    before = ClusterPair(site, config_of(servers))
    assert [each.refused for each in acks(before.give(before.one, site.relay("/a", 5)))] == [None]
    before.close()
    subprocess.run([START_CLUSTER, "--stop", servers.parent], check=True, timeout=60)
    subprocess.run([START_CLUSTER, servers.parent], check=True, timeout=120, stdout=subprocess.DEVNULL)
    after = ClusterPair(site, config_of(servers))
    assert [each.is_negative for each in answers(after.give(after.two, site.query("/a")))] == [False]
    (ack,) = acks(after.give(after.two, site.relay("/a", 4)))
    assert (ack.refused, ack.sequence) == (DropReason.STALE, 5)
    after.close()
