"""Two machines with real ROS 2 graphs; their bridges are in this process, the overlay in memory follows real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.right import Right
from lab.process import until
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Faults
from proxy.endpoints.core.endpoint import proxy_node_name
from proxy.endpoints.ros2 import Ros2Endpoint
from tests.proxy.bridge.sites import Granted, Sites
from tests.proxy.endpoints.ros2_net import CONFINED

_PATIENCE_S = 30.0
_PAUSE_S = 0.005
_STEP_S = 0.05  # of the overlay's time between two turns of the bridges
_RIGHTS = frozenset({Right.PUBLISH, Right.READ}), frozenset({Right.SERVE}), frozenset({Right.CALL})


class Machine:
    """A bridge in one domain, which is delegated whatever it lacks."""

    def __init__(self, sites: Sites, label: str, domain: int, expose: Sequence[str], imports: Sequence[str]) -> None:
        self.member = sites.world.members[label]
        self.endpoint = Ros2Endpoint(domain, proxy_node_name(self.member.name.to_text()))
        self.context = BridgeContext(self.member, Traffic(), Faults())
        self.config = sites.config(expose, imports)
        self.given: dict[Name, tuple[Metadata, set[Right]]] = {}
        self._sites = sites
        self.far: Machine | None = None
        self.bridge = Bridge(self.context, self.config, [self.endpoint], self._held())

    def work(self, now_s: float) -> None:
        """Do what the proxy's loop does, and get the delegations that are missing."""
        self.bridge.work(now_s)
        if lacking := self.bridge.undelegated:
            self.grant(lacking)
            for spec in lacking:  # a pattern of nodes has one name, which its exposer alone knows
                if spec.rule.kind == "node" and spec.is_exposed and self.far is not None:
                    self.far.grant([spec._replace(is_exposed=False)])
        self.member.flush(now_s)

    def grant(self, lacking: Sequence[FlowSpec]) -> None:
        """Delegate what flows lack."""
        for spec in lacking:
            metadata = spec.rule.metadata_of(spec.local, spec.type_name)
            topic, serve, call = _RIGHTS
            rights = topic if spec.rule.kind == "topic" else serve if spec.is_exposed else call
            self.given.setdefault(spec.name, (metadata, set()))[1].update(rights)
        self.bridge.reload(self.config, self._held())

    def _held(self) -> Granted:
        return Granted(self._sites._folder, [self._sites._topic(self.member, *each) for each in self.given.values()])


class Ros2Sites:
    """A robot and a station.

    Args:
        domains: of their graphs.
        expose: the robot's rules.
        imports: the station's.
        gives: what the station exposes.
    """

    def __init__(
        self,
        folder: Path,
        domains: tuple[int, int],
        expose: Sequence[str],
        imports: Sequence[str],
        gives: Sequence[str] = (),
    ) -> None:
        self.sites = Sites(folder)
        self.sites.run(0.1)
        self.robot = Machine(self.sites, "nuc1/robot", domains[0], expose, ())
        self.station = Machine(self.sites, "nuc5/server", domains[1], gives, imports)
        self.robot.far = self.station
        self.machines = {"nuc1/robot": self.robot, "nuc5/server": self.station}
        self._last_s = time.monotonic()

    def until(self, is_met: Callable[[], object], what: object = "it did not come about") -> None:
        """Run both machines until a condition holds."""
        until(is_met, what, _PATIENCE_S, meanwhile=self.step)

    def step(self) -> None:
        """Let the overlay follow real time; on a busy machine it falls behind, so that nothing times out."""
        for label, machine in self.machines.items():
            machine.work(self.sites.now_s)
            self.sites.world.network.send_pending(label)
        time.sleep(_PAUSE_S)
        now_s = time.monotonic()
        self.sites.run(min(now_s - self._last_s, _STEP_S))
        self._last_s = now_s

    def close(self) -> None:
        """Leave both graphs."""
        for machine in self.machines.values():
            machine.bridge.close()
            machine.endpoint.shut_down()


@contextmanager
def ros2_sites(
    folder: Path, domains: tuple[int, int], expose: Sequence[str], imports: Sequence[str], gives: Sequence[str] = ()
) -> Iterator[Ros2Sites]:
    """Run a robot and a station."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in CONFINED.items():
            patch.setenv(name, value)
        sites = Ros2Sites(folder, domains, expose, imports, gives)
        try:
            yield sites
        finally:
            sites.close()
