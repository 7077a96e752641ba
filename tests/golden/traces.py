"""Golden traces: simulations drawn from a seed, and the hash of every frame of theirs.

A trace covers 60 virtual seconds: topics and calls between members, links with loss, jitter and limits, and faults
(links cut, switches killed, RIBs and members restarted, members moved, nodes frozen). Keys follow from the seed, and
signatures of statements and messages come from an ideal scheme, because ECDSA draws a number for each. So the frames
follow from the seed and the code alone.

    python -m tests.golden.traces --save            # renew traces.json, in a commit of its own
    python -m tests.golden.traces --seed 7 --frames /tmp/seven    # each frame as a line, for a comparison by diff
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import IO, Final

from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.insiders.oracle import signing_oracle
from tests.journeys.flows import Flow, advertise
from tests.journeys.networks import LEASE_S, Plan, short_leases
from tests.journeys.services import Party

__all__ = ["COUNT", "TRACES", "Trace", "record"]

TRACES: Final = Path(__file__).with_name("traces.json")
COUNT: Final = 200
_LENGTH_S, _BEGIN_S = 60.0, 3.0
_FAULTS_S: Final = (12.0, 50.0)
_TICK_S: Final = 0.5
_SWITCHES_MAX: Final = 7


@dataclass(frozen=True, slots=True)
class Trace:
    """Number of the frames that entered a link, and SHA-256 of all: time, both ends, bytes."""

    frames: int
    digest: str


def record(seed: int, out: IO[str] | None = None) -> Trace:
    """Run the simulation of a seed.

    Args:
        out: takes each frame as a line, if given.
    """
    hashed, count = hashlib.sha256(), 0

    def tap(at_s: float, start: str, end: str, frame: bytes) -> None:
        nonlocal count
        count += 1
        head = f"{at_s:.6f} {start} {end} "
        hashed.update(head.encode())
        hashed.update(frame)
        if out is not None:
            out.write(f"{head}{frame.hex()}\n")

    with short_leases(), signing_oracle():
        run = _Run(seed)
        run.world.network.taps.append(tap)
        run.run()
    return Trace(count, hashed.hexdigest())


class _Run:
    """One simulation."""

    def __init__(self, seed: int) -> None:
        self._chance = random.Random(f"golden trace {seed}")
        plan = self._plan(seed)
        topology = plan.topology()
        self.world = Simulation(topology=topology, seed=seed, lease_s=LEASE_S, transits=plan.transits(topology))
        self._parties: list[Party] = []
        self._flows: list[Flow] = []

    def _plan(self, seed: int) -> Plan:
        chance = self._chance
        sizes = [chance.randint(1, 3) for _ in range(chance.randint(1, 3))]
        sizes[0] += max(3 - sum(sizes), 0)
        return Plan(
            sizes=tuple(sizes),
            uppers=tuple(chance.randrange(number) for number in range(1, len(sizes))),
            chords=(),
            joints=tuple(
                (chance.randrange(9), chance.randrange(9), chance.randrange(9), chance.randrange(9))
                for _ in range(chance.randint(0, 2))
            ),
            ribs=tuple(chance.randint(-1, 2) for _ in sizes),
            members=tuple(chance.randrange(_SWITCHES_MAX) for _ in range(chance.randint(2, 3))),
            barred=frozenset(),
            faults=(),
            seed=seed,
        )

    def run(self) -> None:
        """Let 60 s pass."""
        world, chance = self.world, self._chance
        for link in sorted(world.cables, key=sorted):
            if chance.random() < 0.3:
                cable = world.cables[link]
                cable.loss, cable.jitter_s = chance.choice([0.01, 0.05]), chance.choice([0.0, 0.002])
        for at_s in sorted(chance.uniform(*_FAULTS_S) for _ in range(chance.randint(1, 4))):
            world.network.call(at_s, self._draw_fault())
        world.network.run(_BEGIN_S)
        self._begin()
        for number in range(int((_LENGTH_S - _BEGIN_S) / _TICK_S)):
            world.network.call(number * _TICK_S, partial(self._tick, number))
        world.network.run(_LENGTH_S - _BEGIN_S)

    def _begin(self) -> None:
        labels = list(self.world.members)
        for label in labels:
            reliable = self._chance.random() < 0.5
            flow = advertise(self.world, f"/from/{label}", label, reliable=reliable, depth=self._chance.choice([0, 2]))
            for other in labels:
                if other != label:
                    flow.read_by(other)
            self._flows.append(flow)
        self._parties += [Party(self.world, labels[0], Right.SERVE), Party(self.world, labels[-1], Right.CALL)]

    def _tick(self, number: int) -> None:
        size = self._chance.choice([20, 900, 4_000])
        for flow in self._flows:
            flow.publish(number.to_bytes(4, "big") + bytes(size))
        server, client = self._parties
        client.publish(b"%d" % number)
        for label, member in self.world.members.items():
            if label == server.label:
                server.collect()
            else:
                member.poll_messages()

    def _draw_fault(self) -> Callable[[], None]:
        world, chance = self.world, self._chance
        network = world.network
        switch = chance.choice(world.topology.nodes)
        link = chance.choice(sorted(world.cables, key=sorted))
        member = chance.choice(list(world.members))
        rib = chance.choice(list(world.ribs))
        after_s = chance.uniform(0.3, 8.0)

        def cut() -> None:
            network.set_link(world.cables[link], up=False)
            network.call(after_s, partial(network.set_link, world.cables[link], up=True))

        def freeze() -> None:
            network.freeze(switch)
            network.call(after_s, partial(network.thaw, switch))

        def restart_rib() -> None:
            world.kill_rib(rib)
            network.call(after_s, lambda: _ignore(world.restart_rib(rib)))

        def restart_switch() -> None:
            network.stop(switch)
            network.call(after_s, lambda: _ignore(world.restart_switch(switch)))

        def roam() -> None:
            world.roam(member, switch)

        return chance.choice([cut, freeze, restart_rib, restart_switch, roam])


def _ignore(_result: object) -> None:
    """Make a call of any result an action."""


def main() -> None:
    """Record traces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--save", action="store_true", help=f"write all {COUNT} traces to {TRACES.name}")
    parser.add_argument("--seed", type=int, default=0, help="one seed; prints its trace (default: %(default)s)")
    parser.add_argument("--frames", type=Path, help="file for each frame of --seed")
    options = parser.parse_args()
    if options.save:
        with Pool() as pool:
            traces = pool.map(record, range(COUNT), chunksize=1)
        found = {str(seed): (trace.frames, trace.digest) for seed, trace in enumerate(traces)}
        lines = ",\n".join(f"{json.dumps(seed)}: {json.dumps(each)}" for seed, each in found.items())
        TRACES.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        return
    if options.frames is None:
        print(record(options.seed))
        return
    with options.frames.open("w", encoding="ascii") as out:
        print(record(options.seed, out))


if __name__ == "__main__":
    main()
