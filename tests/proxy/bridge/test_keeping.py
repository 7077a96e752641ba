"""Topics that are kept: what their holder or the disk does not take is a fault of the local name."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

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
    """A topic that is kept."""

    def __init__(self) -> None:
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
    keeper, faults, kept = (
        TopicKeeper(member, identity, tmp_path, DelegationStore(tmp_path, identity)),
        Faults(),
        Kept(),
    )
    topic: Any = SimpleNamespace(name=Name(b"t" * 32))
    publisher: Any = None
    assert "0 delegations to call store" in keeper.keep("/scan", topic, publisher, Keep(to=("store",)), 1.0)
    capsules = SimpleNamespace(topics={topic.name: kept}, ended={}, handle=lambda _now: None)
    keeper.capsules = cast("CapsuleKeeper", capsules)
    kept.new, kept.uploader.is_refused = ["the quota is full"], True
    for _ in range(2):
        keeper.handle(Timestamps(1.0, 1.0), faults)
        assert faults.of("/scan") == {"not-kept": (1, "the quota is full")}
    kept.uploader.is_refused = False
    keeper.handle(Timestamps(2.0, 2.0), faults)
    assert (faults.of("/scan"), faults.counts[Fault.NOT_KEPT.value]) == ({}, 1)
