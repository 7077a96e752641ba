"""A desk knows the offset of a robot's clock over a recorded LTE uplink that the robot fills."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest

from gdp.client.clock_exchange import ClockExchange
from gdp.client.participant import Participant
from gdp.intervals import TICK_S
from gdp.sansio import ReceivedFrame, Timestamps
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Topology
from tests.journeys.flows import Flow, advertise
from tests.lanes import nightly

UPLINKS: Final = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "uplinks"
ROBOT, DESK = "s0/robot", "s1/desk"
AHEAD_S, DRIFT = 2.5, 40e-6  # of the robot's clocks
BEGUN_S: Final = 1_000.0  # of the simulation's clock
OPPORTUNITY_BYTES: Final = 1_514  # that leave at each millisecond of a recording
ERROR_MAX_S: Final = 0.005
SETTLED_S: Final = 10.0  # after the first exchange
pytestmark = pytest.mark.momentary("the offset is known within seconds, and outlives any lease")
LOAD: Final = {  # rate, bytes, reliable, urgent
    "/image": (15, 80_000, False, False),
    "/imu": (50, 320, False, False),
    "/odom": (30, 700, True, False),
    "/tf": (50, 200, False, True),
}


@dataclass(slots=True)
class RecordedLink(SimLink):
    """A link that carries frames when a recorded one did; recordings repeat."""

    recordings: dict[bytes, Sequence[int]] = field(default_factory=dict)  # milliseconds, by receiver
    left: dict[bytes, tuple[int, int]] = field(default_factory=dict)  # opportunity in use, and its bytes

    def leaves_s(self, to: bytes, size: int, now_s: float) -> float:
        """Queue a frame; return when its last byte has left."""
        recording = self.recordings[to]
        at, left = self.left.get(to, (0, 0))
        if self._opportunity_s(recording, at) < now_s:
            rounds, at_ms = divmod(1e3 * (now_s - BEGUN_S), recording[-1])
            at, left = int(rounds) * len(recording) + bisect_left(recording, at_ms), OPPORTUNITY_BYTES
        while size > left:
            size, at, left = size - left, at + 1, OPPORTUNITY_BYTES
        self.left[to] = at, left - size
        self.free_s[to] = self._opportunity_s(recording, at)
        return self.free_s[to]

    def _opportunity_s(self, recording: Sequence[int], at: int) -> float:
        rounds, at = divmod(at, len(recording))
        return BEGUN_S + 1e-3 * (rounds * recording[-1] + recording[at])


class WithOwnClocks:
    """A core whose clocks are ahead, and drift."""

    def __init__(self, core: Participant) -> None:
        self._core = core

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)

    def seconds(self, now_s: float) -> float:
        """Return what its monotonic clock shows."""
        return now_s + DRIFT * (now_s - BEGUN_S)

    def now(self, now: Timestamps) -> Timestamps:
        """Return what its clocks show."""
        mono_s = self.seconds(now.mono_s)
        return Timestamps(mono_s, now.unix_s + AHEAD_S + mono_s - now.mono_s)

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        self._core.add_port(index, mac, mtu, cost, self.now(now))

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        self._core.receive(arrivals, self.now(now))

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        self._core.port_changed(port, up, self.now(now))

    def handle_timer(self, now: Timestamps) -> None:
        self._core.handle_timer(self.now(now))

    def get_timer(self) -> float | None:
        due_s = self._core.get_timer()
        return None if due_s is None else BEGUN_S + (due_s - BEGUN_S) / (1 + DRIFT) + 1e-9

    def frames_to_send(self, now_s: float) -> Any:
        return self._core.frames_to_send(self.seconds(now_s))

    def frames_sent(self, now_s: float) -> None:
        self._core.frames_sent(self.seconds(now_s))


class Uplink:
    """A robot behind a recorded link, a desk that reads what it publishes, and errors of the offset by second."""

    def __init__(self, name: str) -> None:
        topology = Topology(
            (),
            (DomainPlan("home", ("s0", "s1")),),
            (Attachment("s1", "rib", "rib"), Attachment("s0", "proxy", "robot"), Attachment("s1", "proxy", "desk")),
        )
        self.world = world = Simulation(topology=topology, keepalive_ms=None)
        world.network.connect("s0", "s1", RecordedLink(0.02, fifo_s=1.0, recordings=_Recordings(name)))
        self.robot, self.desk = world.members[ROBOT], world.members[DESK]
        self.clocks = WithOwnClocks(self.robot)
        world.network.replace(ROBOT, self.clocks)
        assert world.run_until_attached()
        flows = {
            topic: advertise(world, topic, ROBOT, reliable=reliable, urgent=urgent)
            for topic, (_, _, reliable, urgent) in LOAD.items()
        }
        for flow in flows.values():
            flow.read_by(DESK)
        assert world.network.run(10, lambda: all(flow.is_read_by(1) for flow in flows.values()))
        for topic, (rate, size, _, _) in LOAD.items():
            self._publish(flows[topic], rate, size)
        self.exchange = ClockExchange(self.desk)
        self.errors_s: list[tuple[float, float, float]] = []  # second, error, stated bound
        self._look()

    def _publish(self, flow: Flow, rate: int, size: int) -> None:
        network = self.world.network
        flow.publisher.publish(bytes(size))
        self.robot.flush(self.clocks.seconds(network.now.mono_s))
        network.send_pending(ROBOT)
        network.call(1 / rate, partial(self._publish, flow, rate, size))

    def _look(self) -> None:
        now = self.world.network.now
        self.desk.poll_messages()
        self.exchange.work(now)
        self.world.network.send_pending(DESK)
        clock = self.desk.diagnostics.clock_of(self.robot.name, now)
        if clock is not None:
            error_s = abs(clock.offset_s - (self.clocks.now(now).unix_s - now.unix_s))
            self.errors_s.append((now.mono_s - BEGUN_S, error_s, clock.bound_s))
        self.world.network.call(TICK_S, self._look)


class _Recordings(dict[bytes, Sequence[int]]):
    """The recordings of both directions, by receiver: the switch of the robot is the first one to send."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._files = [UPLINKS / f"{name}.{way}" for way in ("up", "down")]

    def __missing__(self, to: bytes) -> Sequence[int]:
        self[to] = [int(line) for line in self._files.pop(0).read_text().split()]
        return self[to]


@pytest.mark.skipif(not UPLINKS.is_dir(), reason="the recorded uplinks are not there (expected in ../shared/data)")
@pytest.mark.parametrize(
    ("name", "length_s"),
    [("Verizon-LTE-short", 18), *nightly(("Verizon-LTE-short", 120), ("ATT-LTE-driving-2016", 120))],
)
def test_the_offset_over_a_loaded_lte_uplink_is_known_to_five_milliseconds(name: str, length_s: int) -> None:
    uplink = Uplink(name)
    uplink.world.network.run(length_s)
    assert all(error_s <= bound_s for _, error_s, bound_s in uplink.errors_s), uplink.errors_s
    late = [each for each in uplink.errors_s if each[0] > uplink.errors_s[0][0] + SETTLED_S]
    assert len(late) > (length_s - SETTLED_S) / TICK_S / 2
    assert max(error_s for _, error_s, _ in late) <= ERROR_MAX_S, late
