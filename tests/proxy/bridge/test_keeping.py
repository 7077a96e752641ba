"""Topics that are kept: what their holder or the disk does not take is a fault of the local name."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.sansio import Timestamps
from proxy.bridge.faults import Fault, Faults
from proxy.bridge.keeping import TopicKeeper
from proxy.config.keep import Keep
from tests.proxy.bridge.sites import Sites

if TYPE_CHECKING:
    from gdp.session.keeping import CapsuleKeeper


class Kept:
    """Capsule of a topic that is kept."""

    name = Name(b"c" * 32)

    def __init__(self, topic: Name) -> None:
        self.ring = SimpleNamespace(descriptor=SimpleNamespace(topics=(topic,)))
        self.new: list[str] = []
        self.is_uploaded = True
        self.uploader = SimpleNamespace(is_refused=False)

    def poll_faults(self) -> list[str]:
        faults, self.new = self.new, []
        return faults


def test_what_is_not_kept_is_a_fault_until_the_holder_has_all(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    member = sites.add("nuc1/robot").member
    identity = next(each for each in sites.world.identities.values() if each.name == member.name)
    topic: Any = SimpleNamespace(name=Name(b"t" * 32))
    keeper, faults, kept = (
        TopicKeeper(member, identity, tmp_path, DelegationStore(tmp_path, identity)),
        Faults(),
        Kept(topic.name),
    )
    publisher: Any = None
    assert "0 delegations to call store" in keeper.keep("/scan", topic, publisher, Keep(to=("store",)), 1.0)
    capsules = SimpleNamespace(capsules=[kept], handle=lambda _now: None)
    keeper.capsules = cast("CapsuleKeeper", capsules)
    kept.new, kept.uploader.is_refused = ["the quota is full"], True
    for _ in range(2):
        keeper.handle(Timestamps(1.0, 1.0), faults)
        assert faults.of("/scan") == {"not-kept": (1, "the quota is full")}
    kept.uploader.is_refused = False
    keeper.handle(Timestamps(2.0, 2.0), faults)
    assert (faults.of("/scan"), faults.counts[Fault.NOT_KEPT.value]) == ({}, 1)


def test_a_message_a_lost_uplink_and_a_fault_mark_the_topics_whose_rules_state_them(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    member = sites.add("nuc1/robot").member
    identity = next(each for each in sites.world.identities.values() if each.name == member.name)
    keeper, faults = TopicKeeper(member, identity, tmp_path, DelegationStore(tmp_path, identity)), Faults()
    marked: list[tuple[str, str]] = []
    topics = {Name(local.encode().ljust(32)): local for local in ("/scan", "/image")}

    def kept(local: str) -> Any:
        return SimpleNamespace(mark=lambda name, _time_ns: marked.append((local, name)), name=local)

    paths = [True]
    held: Any = SimpleNamespace(
        topics={name: kept(local) for name, local in topics.items()},
        capsules=[],
        handle=lambda _now: None,
        keep=lambda *_: None,
        has_path=lambda _now_s: paths[0],
    )
    keeper.capsules = held
    events = {"/scan": ("/estop", "uplink-lost", "too-fast"), "/image": ("/estop",)}
    publisher: Any = None
    for name, local in topics.items():
        topic: Any = SimpleNamespace(name=name)
        keeper.keep(local, topic, publisher, Keep(to=("store",), when=events[local]), 1.0)
    assert "sunset is no event" in keeper.keep(
        "/scan", cast("Any", topic), publisher, Keep(to=("store",), when=("sunset",)), 1.0
    )

    def news() -> list[tuple[str, str]]:
        keeper.handle(Timestamps(1.0, 1.0), faults)
        found, marked[:] = list(marked), []
        return found

    assert sites.world.run_until_attached()
    assert news() == []
    keeper.handle_event("/estop", faults)
    keeper.handle_event("/odom", faults)
    assert news() == [("/scan", "/estop"), ("/image", "/estop")]
    faults.report("/image", Fault.TOO_FAST, "a slow path")
    faults.report("/image", Fault.CLOCK, "another machine")
    assert news() == [("/scan", "too-fast")]
    paths[0] = False
    assert news() == [("/scan", "uplink-lost")]
    assert news() == []
    paths[0] = True
    assert news() == []
    sites.world.network.set_link(sites.world.leads["nuc1/robot"], up=False)
    sites.world.network.run(30)
    assert news() == [("/scan", "uplink-lost")]
    assert news() == []
    assert keeper.mark("bumped", 2.0) == 2
    assert news() == [("/scan", "bumped"), ("/image", "bumped")]


@pytest.mark.parametrize(
    ("keys", "around_ns", "when"),
    [
        ({}, None, ()),
        ({"before": "60s", "after": 1}, (60_000_000_000, 1_000_000_000), ()),
        ({"when": "/estop"}, (60_000_000_000, 30_000_000_000), ("/estop",)),
        (
            {"before": "1.5s", "when": ["/estop", "uplink-lost"]},
            (1_500_000_000, 30_000_000_000),
            ("/estop", "uplink-lost"),
        ),
    ],
)
def test_windows_are_stated_by_seconds_and_events(
    keys: dict[str, object], around_ns: tuple[int, int] | None, when: tuple[str, ...]
) -> None:
    keep = Keep.model_validate({"to": "store", **keys})
    assert (keep.around_ns, keep.when) == (around_ns, when)
