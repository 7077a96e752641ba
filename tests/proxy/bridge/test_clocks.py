"""Machines whose clocks differ: stamps by the reader's clock, latencies, and a warning."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest
from rosbags.typesys import Stores, get_typestore

from gdp.message.clock_offset import ClockEstimate
from gdp.ports.plane import Plane
from proxy.bridge.faults import Fault
from proxy.node.proxy_state import ProxyState
from tests.proxy.bridge.known import TRANSFORMS
from tests.proxy.bridge.sites import SERVER, Ear, Machine, Sites

AHEAD_S: Final = 2.5
ROBOT: Final = "nuc1/robot"
_STORE: Final = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def know_clock(machine: Machine, bound_s: float) -> None:
    """Let a machine know that every other clock is ahead."""
    clock = ClockEstimate(AHEAD_S, bound_s)
    machine.member.diagnostics.clock_of = lambda *_: clock  # type: ignore[method-assign]


def transform(at_ns: int) -> bytes:
    types = _STORE.types
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    pose = types["geometry_msgs/msg/Transform"](zero, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(at_ns, 10**9)), "map")
    message = types[TRANSFORMS]([types["geometry_msgs/msg/TransformStamped"](header, "base", pose)])
    return bytes(_STORE.serialize_cdr(message, TRANSFORMS))


def stamp_ns(raw: bytes) -> int:
    message: Any = _STORE.deserialize_cdr(raw, TRANSFORMS)
    stamp = message.transforms[0].header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


@pytest.mark.parametrize(("rule", "moved_s"), [("", 0.0), (", stamps: as-sent", 0.0), (", stamps: local", AHEAD_S)])
def test_stamps_come_by_the_readers_clock_where_the_rule_says_so(sites: Sites, rule: str, moved_s: float) -> None:
    robot = sites.add(ROBOT, expose=[f"name: /tf, type: {TRANSFORMS}"])
    server = sites.add(SERVER, imports=[f"name: /tf, type: {TRANSFORMS}{rule}"])
    know_clock(server, 0.01)
    ear, publication = Ear(server.graph, "/tf", TRANSFORMS), robot.graph.publish("/localizer", "/tf", TRANSFORMS)
    assert sites.run(3, robot.is_read)
    now_ns = time.time_ns()
    robot.graph.now_ns = lambda: now_ns
    for at_ns in (now_ns, 12_345_000_000):  # the second one by the clock of a simulation
        publication.publish(transform(at_ns))
    assert sites.run(1, lambda: len(ear.heard) == 2)
    assert [stamp_ns(raw) for raw in ear.heard] == [now_ns - int(moved_s * 1e9), 12_345_000_000]


@pytest.mark.parametrize(("bound_s", "corrected_s"), [(0.01, AHEAD_S), (AHEAD_S + 1, 0.0)])
def test_latencies_are_corrected_where_the_clocks_differ_for_certain(
    sites: Sites, bound_s: float, corrected_s: float
) -> None:
    robot = sites.add(ROBOT, expose=[f"name: /tf, type: {TRANSFORMS}"])
    server = sites.add(SERVER, imports=[f"name: /tf, type: {TRANSFORMS}"])
    know_clock(server, bound_s)
    ear, publication = Ear(server.graph, "/tf", TRANSFORMS), robot.graph.publish("/localizer", "/tf", TRANSFORMS)
    assert sites.run(3, robot.is_read)
    before_s, robot.graph.now_ns = time.monotonic(), time.time_ns
    publication.publish(transform(0))
    assert sites.run(1, lambda: len(ear.heard) == 1)
    took_s = time.monotonic() - before_s
    (stats,) = server.bridge.stats
    assert -1e-3 <= stats.latencies_ms[-1] / 1e3 - corrected_s <= took_s + 1e-3


def test_a_clock_by_which_transforms_do_not_fit_is_warned_of_once_with_both_machines(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server = sites.add(ROBOT), sites.add(SERVER)
    identity, other = (sites.world.identities[each.label] for each in (server, robot))
    plane = cast(Plane, SimpleNamespace(ports={}))
    state = ProxyState(identity, sites.world.policy(identity.root.label), plane, server.member, 0.0, {})
    clocks: list[ClockEstimate] = []
    server.member.diagnostics.clocks = lambda now: [(other.member, each) for each in clocks]  # type: ignore[method-assign]
    for offset_s, bound_s, warnings in (
        (0.3, 0.25, 0), (-2.5, 0.02, 1), (-2.5, 0.02, 1), (0.0, 0.02, 1), (0.2, 0.02, 2),
    ):  # fmt: skip
        clocks[:] = [ClockEstimate(offset_s, bound_s)]
        with caplog.at_level(logging.WARNING):
            state.refresh(sites.world.network.now)
        assert state.context.faults.counts[Fault.CLOCK.value] == warnings
    first, second = (record.getMessage() for record in caplog.records)
    assert first.startswith("nuc1-robot: clock: its clock is 2.500 s behind that of nuc5-server, to 0.020 s")
    assert "0.200 s ahead of" in second
