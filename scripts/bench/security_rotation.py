"""Rotation bench: messages lost while the secrets of their topics change every few seconds.

One process: the ring of five switches on the in-memory network, its clock virtual. The robot publishes one reliable and
one best-effort topic to two readers. Every ``--rotate-s`` each member is granted the next epoch: the readers first, the
publisher half a second later. The epoch before the last is removed from all. At the end every message has to be at
every reader, once and in order. Once nothing is published any more, readers try the epoch before as well; that is
refused.

    .venv/bin/python scripts/bench/security.py rotation                          # 100,000 messages, an epoch each 5 s
    .venv/bin/python scripts/bench/security.py rotation --messages 5000 --loss 0.01 --no-save
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Final

from report import print_table

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher
from gdp.metadata import Metadata
from gdp.simulation.simulation import Simulation
from gdp.simulation.topology import ring5
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right

__all__ = ["add_arguments", "run"]

ROBOT: Final = "nuc1/robot"
READERS: Final = ("nuc5/server", "nuc3/desk")
LEAD_S: Final = 0.5  # lead of the readers over their publisher with a new epoch
DRAIN_S: Final = 30.0


@dataclass(slots=True)
class Stream:
    """Topic, and its deliveries by reader."""

    name: str
    reliable: bool
    publisher: Publisher | None = None
    got: dict[str, list[int]] = field(default_factory=dict)


class Rotation:
    """Ring, its topics, and the epochs that have begun."""

    def __init__(self, loss: float) -> None:
        self.world = Simulation(topology=ring5(), seed=5)
        self.world.add_member("nuc3/desk", "nuc3")
        if not self.world.run_until_attached():
            raise SystemExit("the ring does not come up")
        self.epoch = 1
        self.streams = (Stream("/reliable", reliable=True), Stream("/best_effort", reliable=False))
        robot = self.world.members[ROBOT]
        for stream in self.streams:
            topic = self.topic(stream, ROBOT, Right.PUBLISH)
            stream.publisher = robot.advertise(topic, b"described", reliable=stream.reliable)
            for label in READERS:
                self.world.members[label].subscribe(self.topic(stream, label, Right.READ))
                stream.got[label] = []
        for label in (ROBOT, *READERS):
            self.world.network.send_pending(label)
        if not self.world.network.run(10.0, self._is_read):
            raise SystemExit("the readers do not begin")
        for sim_link in self.world.cables.values():
            sim_link.loss = loss

    def _is_read(self) -> bool:
        return all(each.publisher is not None and each.publisher.readers == len(READERS) for each in self.streams)

    def topic(self, stream: Stream, label: str, right: Right) -> Topic:
        """Return a topic with the secrets of the present epoch and the one before."""
        identity = self.world.identities[label]
        metadata = Metadata({"kind": "topic", "name": stream.name})
        epochs = [each for each in (self.epoch - 1, self.epoch) if each > 0]
        card = NodeDescriptor.from_wire(NodeDescriptor.make(identity))
        given = self.world.owner.delegate(card, metadata, [right], epochs, self.world.validity)
        return Topic(given, {epoch: grant.secret for epoch, grant in given.open(identity).items()})

    def rotate(self) -> None:
        """Begin the next epoch."""
        self.epoch += 1
        for stream in self.streams:
            for label in READERS:
                self.world.members[label].renew(self.topic(stream, label, Right.READ))
            topic = self.topic(stream, ROBOT, Right.PUBLISH)
            self.world.network.call(LEAD_S, partial(self._renew, topic))

    def _renew(self, topic: Topic) -> None:
        self.world.members[ROBOT].renew(topic)
        self.world.network.send_pending(ROBOT)

    def publish(self, number: int) -> None:
        """Publish one message on each topic."""
        for stream in self.streams:
            assert stream.publisher is not None
            stream.publisher.publish(number.to_bytes(8, "big") + bytes(92))
        self.world.members[ROBOT].flush(self.world.network.now.mono_s)
        self.world.network.send_pending(ROBOT)

    def collect(self) -> None:
        """Take the deliveries."""
        by_name = {stream.publisher.topic: stream for stream in self.streams if stream.publisher is not None}
        for label in READERS:
            for message in self.world.members[label].poll_messages():
                by_name[message.topic].got[label].append(int.from_bytes(message.delivered.message[:8], "big"))

    def run(self, messages: int, rate: float, rotate_s: float) -> dict[str, dict[str, int]]:
        """Publish so many messages on all topics together; return the account of each."""
        network, each, said = self.world.network, messages // len(self.streams), 0
        next_s = network.now.mono_s + rotate_s
        while said < each:
            self.publish(said)
            said += 1
            network.run(len(self.streams) / rate)
            if network.now.mono_s >= next_s:
                self.rotate()
                next_s += rotate_s
            if not said % 256:
                self.collect()
        network.run(DRAIN_S)
        self.collect()
        return {stream.name: self._account(stream, each) for stream in self.streams}

    def _account(self, stream: Stream, sent: int) -> dict[str, int]:
        got = stream.got.values()
        return {
            "sent": sent * len(stream.got),
            "delivered": sum(map(len, got)),
            "lost": sum(sent - len(set(each)) for each in got),
            "out of order or twice": sum(a >= b for each in got for a, b in pairwise(each)),
        }

    def refused(self) -> Counter[str]:
        """Return the refusals of the publisher, by reason."""
        return Counter({reason.label: count for reason, count in self.world.members[ROBOT].drops().items()})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--messages", type=int, default=100_000, help="on both topics together, to each reader")
    parser.add_argument("--rate", type=float, default=2_000.0, help="messages a second of virtual time")
    parser.add_argument("--rotate-s", type=float, default=5.0, help="seconds of an epoch")
    parser.add_argument("--loss", type=float, default=0.0, help="share of frames that each link loses")


def run(options: argparse.Namespace, _: object) -> tuple[dict[str, object], bool]:
    """Publish so many messages on all topics together; return the account of each."""
    rotation = Rotation(options.loss)
    accounts = rotation.run(options.messages, options.rate, options.rotate_s)
    columns = list(next(iter(accounts.values())))
    rows = [(name, *(f"{account[column]:,}" for column in columns)) for name, account in accounts.items()]
    print_table(("topic", *columns), rows, title=f"{rotation.epoch} epochs of {options.rotate_s:g} s")
    refused = rotation.refused()
    print(f"refused by the publisher: {dict(refused) or 'nothing'}")
    may_lose = {stream.name for stream in rotation.streams if not stream.reliable and options.loss}
    kept = [account for name, account in accounts.items() if name not in may_lose]
    figures: dict[str, object] = {
        "messages": options.messages, "rotate_s": options.rotate_s, "loss": options.loss, "epochs": rotation.epoch,
        "topics": accounts, "refused": dict(refused),
    }  # fmt: skip
    return figures, not any(account["lost"] or account["out of order or twice"] for account in kept)
